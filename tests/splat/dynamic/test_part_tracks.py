"""Parts of frames laid over each other, and their pixels followed, where the truth is known."""

import pytest
import torch
from torch.nn.functional import interpolate

from swimm3r.cameras import Cameras, pixel_grid
from swimm3r.splat.dynamic.part_flow import carried, full_size, passages
from swimm3r.splat.dynamic.part_tracks import Part, laid_over, tracks
from swimm3r.splat.views import TrainingView

HEIGHT, WIDTH, SCALE = 54, 80, 3  # of the small images; the frames are three times as large
YELLOW, BLUE = torch.tensor([0.8, 0.7, 0.2]), torch.tensor([0.1, 0.2, 0.5])


def striped(middle: tuple[float, float], size: float = 1.0, turn: float = 0.0, tone: float = 1.0) -> torch.Tensor:
    """[4 h w]: an oval with seven stripes before even ground, and where it is; `middle` and sizes in small pixels."""
    grid = (pixel_grid(SCALE * HEIGHT, SCALE * WIDTH) / SCALE - torch.tensor(middle)) / size
    c, s = torch.cos(torch.tensor(turn)), torch.sin(torch.tensor(turn))
    along, up = c * grid[..., 0] + s * grid[..., 1], c * grid[..., 1] - s * grid[..., 0]
    inside = (along / 18) ** 2 + (up / 7) ** 2 < 1
    stripe = torch.sigmoid(6 * torch.sin(along * 1.2 + 0.1 * up))[..., None]
    fish = tone * (stripe * YELLOW + (1 - stripe) * BLUE) * (1 + 0.02 * along)[..., None]
    rgb = torch.where(inside[..., None], fish.clamp(0, 1), torch.tensor([0.3, 0.5, 0.5]))
    return torch.cat([rgb, inside[..., None].float()], -1).permute(2, 0, 1)


def part(image: torch.Tensor, frame: int) -> Part:
    small = interpolate(image[None], (HEIGHT, WIDTH), mode="area")[0]
    return Part(frame, float(frame), small[3] > 0.5, small[:3])


def view(image: torch.Tensor) -> TrainingView:
    K = torch.tensor([[200.0, 0, 120], [0, 200, 80], [0, 0, 1]], dtype=torch.float64)[None]
    pose = torch.eye(4, dtype=torch.float64)[None]
    camera = Cameras(K, torch.zeros(1, 0, dtype=torch.float64), pose, SCALE * WIDTH, SCALE * HEIGHT)
    nothing = torch.zeros(SCALE * HEIGHT, SCALE * WIDTH)
    return TrainingView("", camera, image[:3], nothing == 0, nothing, nothing > 0)


HERE = (30.0, 24.0)
CASES = [((33.0, 25.0), 1.0, 0.0), ((55.0, 30.0), 1.12, 0.05), ((70.0, 20.0), 1.15, 0.0), ((8.0, 30.0), 0.9, -0.05)]


@pytest.mark.parametrize(("middle", "size", "turn"), CASES)
def test_stripes_are_laid_on_the_same_stripes(middle, size, turn):
    """The parts are five pixels apart; the last two are cut by the border."""
    fit = laid_over(part(striped(HERE), 0), part(striped(middle, size, turn), 1))
    assert fit is not None
    assert (carried(fit.whole, torch.tensor([HERE]))[0] - torch.tensor(middle)).norm() < 2


@pytest.mark.parametrize(("middle", "size", "turn"), CASES)
def test_pixels_are_followed_to_where_they_are(middle, size, turn):
    first, second = striped(HERE), striped(middle, size, turn)
    a, b = part(first, 0), part(second, 1)
    fit = laid_over(a, b)
    assert fit is not None
    there, back = passages(fit, a, b, view(first), view(second))
    pixels = full_size(a.mask, view(first)).nonzero().flip(1) + 0.5
    c, s = torch.cos(torch.tensor(turn)), torch.sin(torch.tensor(turn))
    R = torch.stack([torch.stack([c, -s]), torch.stack([s, c])])
    truth = SCALE * torch.tensor(middle) + size * (pixels - SCALE * torch.tensor(HERE)) @ R.mT
    shown = ((truth > 0) & (truth < torch.tensor([SCALE * WIDTH, SCALE * HEIGHT]))).all(-1)
    off = (there.there(pixels) - truth).norm(dim=-1)
    assert off[shown].median() < 1
    assert off.quantile(0.9) < 4  # what has left the image goes with the rest
    returned = (back.there(truth[shown]) - pixels[shown]).norm(dim=-1)
    assert returned.median() < 1.5


def test_what_looks_otherwise_is_not_the_same():
    assert laid_over(part(striped(HERE), 0), part(striped(HERE, tone=0.3), 1)) is None


def test_two_that_pass_each_other_keep_their_tracks():
    def frame(k: int) -> list[Part]:
        bright, dark = striped((20.0 + 10 * k, 12.0)), striped((60.0 - 10 * k, 40.0), tone=0.5)
        return [part(image, k) for image in ((bright, dark) if k % 2 else (dark, bright))]

    found = tracks([frame(k) for k in range(5)])
    assert len(found) == 2
    for track in found:
        assert [p.frame for p in track.parts] == [0, 1, 2, 3, 4]
        tone = torch.stack([p.rgb[:, p.mask].mean() for p in track.parts])
        assert float(tone.max() - tone.min()) < 0.05


def test_what_is_gone_for_a_frame_begins_a_new_track():
    shown = [[part(striped((20.0 + 5 * k, 24.0)), k)] if k != 2 else [] for k in range(5)]
    assert [[p.frame for p in track.parts] for track in tracks(shown)] == [[0, 1], [3, 4]]


def test_frames_of_one_time_are_not_joined():
    here = part(striped(HERE), 0)
    assert len(tracks([[here], [here]])) == 2
