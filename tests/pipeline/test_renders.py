"""Views of a map are displayed like the restored frames of the same dive."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from swimm3r.cameras import Cameras
from swimm3r.cli.main import main
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.depth import read_depth
from swimm3r.medium import Medium
from swimm3r.pipeline.camera_paths import smooth_path
from swimm3r.pipeline.renders import DisplayStyle, marked, shown_clear, write_view
from swimm3r.sfm.medium.settings import RestoreSettings
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
LOOK = DisplayStyle(GAINS, (1.0, 4.0), RestoreSettings())


def view(z: float, alpha: float, beta_D: float) -> RenderOutput:
    """A gray surface of 0.4 in water, straight ahead and everywhere."""
    every = torch.ones(H, W, 3)
    medium = Medium(0.3 * every, beta_D * every, beta_D * every)
    rgb = torch.rand(H, W, 3)
    return RenderOutput(rgb, 0.4 * every, 0.1 * every, torch.full((H, W), z), torch.full((H, W), alpha), medium)


def test_what_the_water_lets_through_is_white_balanced():
    shown = shown_clear(view(z=0.01, alpha=1.0, beta_D=0.1), CAMERA, LOOK)
    assert (shown - 0.4 * GAINS).abs().max() < 2e-3


@pytest.mark.parametrize(
    "unseen",
    [
        dict(z=0.0, alpha=0.0, beta_D=0.1),
        dict(z=0.01, alpha=0.5, beta_D=0.1),
        dict(z=50.0, alpha=1.0, beta_D=0.5),
    ],
    ids=["open water", "half covered", "too far for any channel"],
)
def test_the_horizon_keeps_the_color_it_has(unseen: dict[str, float]):
    out = view(**unseen)
    assert (shown_clear(out, CAMERA, LOOK) - out.rgb).abs().max() < 1e-6


def test_surfaces_fade_into_open_water_as_they_cover_less():
    out = view(z=0.01, alpha=0.75, beta_D=0.1)
    assert (shown_clear(out, CAMERA, LOOK) - (0.4 * GAINS + out.rgb) / 2).abs().max() < 2e-3


def test_one_channel_that_sees_is_enough():
    out = view(z=10.0, alpha=1.0, beta_D=0.5)
    out.medium.beta_D[..., 2] = 0.01
    assert (shown_clear(out, CAMERA, LOOK) - 0.4 * GAINS).abs().max() < 5e-3


def test_images_show_it_and_the_output_stays_physical(tmp_path: Path):
    out = view(z=0.01, alpha=1.0, beta_D=0.1)
    write_view(tmp_path, "a", out, CAMERA, LOOK)
    written = torch.from_numpy(images.read_rgb(tmp_path / "a_clear.png")).float() / 255
    assert (written - 0.4 * GAINS).abs().max() < 5e-3
    assert (out.clear == 0.4).all()


def test_numbers_lie_beside_the_images(tmp_path: Path):
    out = view(z=2.5, alpha=1.0, beta_D=0.001)
    write_view(tmp_path, "dive/a", out, CAMERA, LOOK)
    physical = images.read_rgb(tmp_path / "dive" / "a_clear_physical.png")
    assert physical.dtype == np.uint16
    assert np.abs(physical / 65535 - 0.4).max() < 2e-3  # some of the open water is mixed in
    torch.testing.assert_close(torch.from_numpy(read_depth(tmp_path / "dive" / "a_z_depth.tif")), out.z_depth)


ENCODE = """
import os, sys
from pathlib import Path
import cv2, numpy as np
from swimm3r.pipeline.renders import _encode

folder, cores = Path(sys.argv[1]), int(sys.argv[2])
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
rng = np.random.default_rng(0)
ground = cv2.GaussianBlur(rng.random((212, 640, 3)).astype(np.float32), (0, 0), 6)
ground = 30 + 180 * (ground - ground.min()) / np.ptp(ground)
views = [ground[i : i + 106, 2 * i : 2 * i + 320] + rng.normal(0, 4, (106, 320, 3)) for i in range(24)]
images = [view.clip(0, 255).astype(np.uint8) for view in views]
for again in range(3):
    sizes = np.random.default_rng(again).integers(2_000, 300_000, 100)
    litter = [rng.integers(0, 255, size).astype(np.uint8) for size in sizes]
    del litter  # what freed memory holds is chance
    _encode(folder / f"{cores}-{again}.mp4", iter(images))
"""


@pytest.mark.long
def test_a_flight_has_the_same_bits_on_any_number_of_cores_and_whatever_freed_memory_holds(tmp_path: Path):
    for cores in ("1", "2"):
        subprocess.run([sys.executable, "-c", ENCODE, str(tmp_path), cores], check=True)
    files = list(tmp_path.glob("*.mp4"))
    assert len(files) == 6
    assert len({path.read_bytes() for path in files}) == 1


def test_a_flight_of_one_image_stands_at_the_start():
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.arange(3)
    torch.testing.assert_close(smooth_path(poses, 1), poses[:1])


def test_a_folder_that_holds_no_run_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["render", str(tmp_path)])
    assert ended.value.code == InputError.exit_code
    assert f"{tmp_path} is no run folder" in capsys.readouterr().err


def test_what_no_training_frame_saw_is_hatched_and_named(tmp_path):
    out = view(z=2.0, alpha=1.0, beta_D=0.1)
    observed = torch.ones(H, W, dtype=torch.bool)
    observed[:, 4:] = False
    write_view(tmp_path, "a", replace(out, observed=observed), CAMERA, LOOK)
    write_view(tmp_path, "b", out, CAMERA, LOOK)
    assert not (tmp_path / "b_observed.png").exists()
    mask = cv2.imread(str(tmp_path / "a_observed.png"), cv2.IMREAD_UNCHANGED)
    assert (mask[:, :4] == 65535).all()
    assert (mask[:, 4:] == 0).all()
    for kind in ("rgb", "clear", "z_depth", "clear_physical", "backscatter"):
        marked_view, plain = (images.read_rgb(tmp_path / f"{stem}_{kind}.png").astype(int) for stem in "ab")
        assert (marked_view[:, :4] == plain[:, :4]).all()
        assert (marked_view[:, 4:] != plain[:, 4:]).any() == (kind in ("rgb", "clear", "z_depth"))
    assert torch.equal(marked(out.rgb, None), out.rgb)
