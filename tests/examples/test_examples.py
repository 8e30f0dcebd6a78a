"""The examples run, in a small size, and find what the synthetic dive's truth says."""

import json
import re
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from tests.imaging.test_rectification import stretching_lens

import swimm3r
from swimm3r.evaluate.images import psnr
from swimm3r.geometry import align_poses, rotation_angle
from swimm3r.imaging.rectification import rectification_of
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.images import read_rgb
from swimm3r.scene.ground_truth import read_ground_truth

EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = swimm3r.DiveSettings(frames=10, width=240, height=160)
SIZE = ("--steps", "40", "--primitives", "2000", "--long-side", "120")


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("examples") / "dive"
    swimm3r.write_dive(SMALL, folder)
    return folder


@pytest.fixture(scope="module")
def example() -> Callable[[str], ModuleType]:
    """Loads an example by its name."""

    def load(name: str) -> ModuleType:
        spec = spec_from_file_location(name, EXAMPLES / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="module")
def work(dive: Path, example: Callable[[str], ModuleType]) -> Path:
    """The folder that reconstruct_and_train leaves."""
    folder = dive.parent / "work"
    example("reconstruct_and_train").main([str(dive / "images"), "--out", str(folder), *SIZE])
    return folder


def test_reconstruct_and_train_leaves_poses_cloud_map_and_views(work: Path):
    for name in ("sfm/cameras.json", "sfm/points.ply", "splat/map.safetensors"):
        assert (work / name).stat().st_size > 0
    assert read_rgb(work / "with_water.png").shape == read_rgb(work / "without_water.png").shape == (160, 240, 3)


def test_restore_images_comes_near_the_clear_image(dive: Path, example: Callable[[str], ModuleType], tmp_path: Path):
    images = [dive / "images" / name for name in ("0003.png", "0004.png")]
    given = ["--depth", str(dive / "truth" / "z_depth"), "--cameras", str(dive / "truth" / "cameras.json")]
    example("restore_images").main([*map(str, images), *given, "--out", str(tmp_path)])
    truth = read_ground_truth(dive / "truth")
    for image in images:
        restored, raw = (torch.from_numpy(read_rgb(path)) / 255 for path in (tmp_path / image.name, image))
        clear, z_depth = truth.clear(image.name), truth.z_depth(image.name)
        assert clear is not None
        assert z_depth is not None
        near = (z_depth > 0) & (z_depth < 3)  # farther, red is lost in noise
        assert psnr(restored[near], clear[near]) > 28 > psnr(raw[near], clear[near]) + 8
    with pytest.raises(SystemExit, match=r"no depth map of 0003\.png"):
        example("restore_images").depth_map_of(images[0], tmp_path / "nowhere")


def test_localize_image_finds_a_test_frame(dive: Path, work: Path, example: Callable[[str], ModuleType]):
    (pose,) = example("localize_image").main([str(work), str(dive / "images" / "0008.png")])
    found, truth = read_cameras(work / "sfm" / "cameras.json"), read_ground_truth(dive / "truth")
    rows = [truth.names.index(name) for name in found.names]
    axes = align_poses(truth.cameras.cam2world[rows], torch.from_numpy(found.cam2world))
    true = axes.poses(truth.cameras.cam2world[[truth.names.index("0008.png")]])[0]
    assert torch.rad2deg(rotation_angle(true[:3, :3].mT @ pose[:3, :3])) < 2


def test_localize_image_rectifies_images_where_the_run_is_of_rectified_frames(
    dive: Path, example: Callable[[str], ModuleType], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    way, run, seen = rectification_of(stretching_lens(240, 160)), tmp_path / "run", []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    swimm3r.rectify_frames(swimm3r.read_frames(dive / "images"), way, run / "sfm" / "rectified")

    class Localizer:
        def __init__(self, _: None, rec: None, frames: swimm3r.Frames) -> None:
            seen.append((frames.height, frames.width))

        def locate(self, image: torch.Tensor, time: float | None) -> SimpleNamespace:
            seen.append(tuple(image.shape[:2]))
            return SimpleNamespace(cam2world=torch.eye(4), stage="refined", candidates=())

        def in_axes_of_sfm(self, pose: torch.Tensor) -> torch.Tensor:
            return pose

    localize_image = example("localize_image")
    monkeypatch.setattr(localize_image, "Localizer", Localizer)
    monkeypatch.setattr(swimm3r, "load_map", lambda _: None)
    rec = SimpleNamespace(still=lambda frames: frames)
    monkeypatch.setattr(swimm3r, "load_reconstruction", lambda *_: rec)
    localize_image.main([str(run), str(dive / "images" / "0008.png")])
    assert seen == [(way.pinhole.height, way.pinhole.width)] * 2
    assert seen[0] != (160, 240)


def test_the_notebook_runs_cell_by_cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    notebook = json.loads((EXAMPLES / "synthetic_dive.ipynb").read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    monkeypatch.chdir(tmp_path)
    small = {"FRAMES": 10, "WIDTH": 240, "HEIGHT": 160, "STEPS": 40, "PRIMITIVES": 2000, "LONG_SIDE": 120}
    names: dict = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        assert (cell["outputs"], cell["execution_count"]) == ([], None)
        exec(compile("".join(cell["source"]), "synthetic_dive.ipynb", "exec"), names)
        if "parameters" in cell["metadata"].get("tags", ()):
            assert names.keys() > small.keys()
            names.update(small)
    assert names["pose_errors"].rotation_deg < 1
    assert names["view"].rgb.shape == (80, 120, 3)
    assert float(names["angle"]) < 2


def test_every_example_is_listed_in_its_readme():
    listed = set(re.findall(r"\]\((\w+\.\w+)\)", (EXAMPLES / "README.md").read_text(encoding="utf-8")))
    assert listed == {path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb")}
