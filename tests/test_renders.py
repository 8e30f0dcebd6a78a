"""How a map's views are shown: like the restored frames of the same dive."""

from pathlib import Path

import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.cli.main import main
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.medium import Medium
from swimm3r.renders import Look, shown_clear, write_view
from swimm3r.sfm.settings import RestoreSettings
from swimm3r.splat.rendering import RenderOutput

H, W = 6, 8
CAMERA = Cameras(
    torch.tensor([[[5.0, 0, 4], [0, 5, 3], [0, 0, 1]]], dtype=torch.float64),
    torch.zeros(1, 0, dtype=torch.float64),
    torch.eye(4, dtype=torch.float64)[None],
    W,
    H,
)
GAINS = torch.tensor([1.5, 0.9, 0.75])
LOOK = Look(GAINS, (1.0, 4.0), RestoreSettings())


def view(z: float, alpha: float, beta_D: float) -> RenderOutput:
    """A grey surface of 0.4 in water, straight ahead and everywhere."""
    every = torch.ones(H, W, 3)
    medium = Medium(0.3 * every, beta_D * every, beta_D * every)
    rgb = torch.rand(H, W, 3)
    return RenderOutput(rgb, 0.4 * every, 0.1 * every, torch.full((H, W), z), torch.full((H, W), alpha), medium)


def test_what_the_water_lets_through_is_white_balanced():
    shown = shown_clear(view(z=0.01, alpha=1.0, beta_D=0.1), CAMERA, LOOK)
    assert (shown - 0.4 * GAINS).abs().max() < 2e-3


@pytest.mark.parametrize(
    "unseen",
    [dict(z=0.0, alpha=0.0, beta_D=0.1), dict(z=50.0, alpha=1.0, beta_D=0.5)],
    ids=["open water", "too far for any channel"],
)
def test_the_horizon_keeps_the_colour_it_has(unseen: dict[str, float]):
    out = view(**unseen)
    assert (shown_clear(out, CAMERA, LOOK) - out.rgb).abs().max() < 1e-6


def test_one_channel_that_sees_is_enough():
    out = view(z=10.0, alpha=1.0, beta_D=0.5)
    out.medium.beta_D[..., 2] = 0.01
    assert (shown_clear(out, CAMERA, LOOK) - 0.4 * GAINS).abs().max() < 5e-3


def test_pictures_show_it_and_the_output_stays_physical(tmp_path: Path):
    out = view(z=0.01, alpha=1.0, beta_D=0.1)
    write_view(tmp_path, "a", out, CAMERA, LOOK)
    written = torch.from_numpy(images.read_rgb(tmp_path / "a_clear.png")).float() / 255
    assert (written - 0.4 * GAINS).abs().max() < 5e-3
    assert (out.clear == 0.4).all()


def test_a_folder_that_holds_no_run_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["render", str(tmp_path)])
    assert ended.value.code == InputError.exit_code
    assert f"{tmp_path} holds no run" in capsys.readouterr().err
