import pytest
import torch

from swimm3r.medium import Medium
from swimm3r.water_types import FAMILIES, Family, draw, sample

DRAWS = 300


def draws(family: Family, field: str) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.stack([vars(sample(family, generator))[field] for _ in range(DRAWS)])


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("field", ["Binf", "beta_D"])
def test_draws_fill_the_intervals_of_the_paper_and_never_leave_them(family, field):
    low, high = torch.tensor(getattr(FAMILIES[family], field)).unbind(-1)
    drawn = draws(family, field)
    assert (drawn >= low).all()
    assert (drawn <= high).all()
    assert (drawn.min(0).values < low + 0.05 * (high - low)).all()
    assert (drawn.max(0).values > high - 0.05 * (high - low)).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_backscatter_builds_up_at_a_random_share_of_the_attenuation(family):
    generator = torch.Generator().manual_seed(5)
    shares = torch.stack([(m := sample(family, generator)).beta_B / m.beta_D for _ in range(DRAWS)])
    assert ((shares >= 0) & (shares <= 1)).all()
    torch.testing.assert_close(shares.mean(0), torch.full((3,), 0.5), atol=0.06, rtol=0)
    assert torch.corrcoef(shares.T)[0, 1].abs() < 0.2  # one share per channel, not one per water


def test_only_cyan_water_narrows_red_to_where_it_is_nearly_gone():
    assert FAMILIES["cyan"].beta_D[0] == (0.7, 1.6)
    assert all(FAMILIES[family].beta_D[0] == (0.3, 2.0) for family in ("teal", "green", "warm"))
    assert all(water.beta_D[1:] == ((0.04, 0.85),) * 2 for water in FAMILIES.values())


def test_one_seed_is_one_water():
    first, second = (sample("green", torch.Generator().manual_seed(9)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(vars(first).values(), vars(second).values(), strict=True))


def family_of(water: Medium) -> Family | None:
    """The only family whose red and blue veil both fit; the intervals of the four do not all overlap."""
    fits: list[Family] = [
        name
        for name, kind in FAMILIES.items()
        if all(low <= float(value) <= high for value, (low, high) in zip(water.Binf, kind.Binf, strict=True))
    ]
    return fits[0] if len(fits) == 1 else None


def test_half_of_the_images_get_water_and_every_family_is_drawn_as_often():
    generator = torch.Generator().manual_seed(11)
    drawn = [draw(generator) for _ in range(2000)]
    given = [water for water in drawn if water is not None]
    assert abs(len(given) / len(drawn) - 0.5) < 0.04
    families = [family_of(water) for water in given]
    assert families.count(None) < 0.1 * len(families)
    for name in FAMILIES:
        assert abs(families.count(name) / len(families) - 0.25) < 0.05, name


def test_augmentation_can_be_switched_off_and_always_on():
    generator = torch.Generator().manual_seed(1)
    assert all(draw(generator, 0.0) is None for _ in range(50))
    assert all(draw(generator, 1.0) is not None for _ in range(50))
