"""A run of a fisheye as users get it out: renders, exports and the viewer, each beside the frames themselves."""

import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from tests.splat.conftest import TinyDive, tiny_dive  # noqa: F401 - a fixture
from tests.viewer.conftest import write_summary

from swimm3r.cameras import Cameras
from swimm3r.evaluate.images import psnr
from swimm3r.export.formats import colmap, nerfstudio
from swimm3r.export.settings import ColmapExportSettings, NerfstudioSettings, SplatPlySettings
from swimm3r.export.splats import open_map
from swimm3r.imaging.undistortion import undistorted
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.images import read_rgb, write_rgb
from swimm3r.pipeline.presets import PRESETS, to_yaml
from swimm3r.pipeline.renders import render_run
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.viewer.layers import LayerChoice, Painter, ViewCamera
from swimm3r.viewer.viewed_run import open_viewed_run

FOCAL = 34.0  # 108 degrees across, of which a pinhole of that focal length has 87
LENS = (0.02, -0.01, 0.004, -0.001)
REACH = 3 * 32 / FOCAL + 0.6  # of the pinholes along the wide wall, to the side


@pytest.fixture(scope="module")
def run(tiny_dive: TinyDive, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """A wall wider than pinholes see, filmed by a fisheye, and itself as the map."""
    folder, rec = tmp_path_factory.mktemp("fisheye") / "run", tiny_dive.rec
    p = tiny_dive.truth.primitives
    assert isinstance(p, BetaPrimitives)
    wide = p._replace(xyz=p.xyz * torch.tensor([2.0, 1, 1]), query_mean=p.query_mean)
    scene = replace(tiny_dive.truth, primitives=wide, span=(0.0, 8.0))
    K = rec.cameras.K.clone()
    K[:, 0, 0], K[:, 1, 1] = FOCAL, FOCAL
    k = torch.tensor([LENS], dtype=torch.float64).repeat(len(K), 1)
    cameras = replace(rec.cameras, K=K, distortion=k, model="OPENCV_FISHEYE")
    tiny_dive.frames.save(folder / "prepare")
    replace(rec, cameras=cameras).save(folder / "sfm", tiny_dive.frames)
    for i, name in enumerate(rec.names):
        write_rgb(folder / "prepare" / name, scene.render(cameras[i]).rgb.numpy())
        write_rgb(folder / "sfm" / "restored" / f"{name}.png", torch.full((48, 64, 3), 0.5).numpy())
    scene.save(folder / "splat" / "map.safetensors")
    (folder / "settings.yaml").write_text(to_yaml(PRESETS["fast"]))
    (folder / "versions.json").write_text(json.dumps({"swimm3r": version("swimm3r")}))
    write_summary(folder, ("prepare", "sfm", "splat"))
    return folder


def stored(path: Path) -> torch.Tensor:
    return torch.from_numpy(read_rgb(path).astype(np.float32) / 255)


def test_a_render_is_of_the_camera_of_its_frame_and_says_so(run: Path, tmp_path: Path):
    out = render_run(run, ViewSettings(), tmp_path)
    for name in ("1.png", "4.png", "7.png"):
        shown, frame = stored(out / f"{Path(name).stem}_rgb.png"), stored(run / "prepare" / name)
        assert psnr(shown, frame) > 40
        assert bool(stored(out / f"{Path(name).stem}_clear.png").isfinite().all())
    table = read_cameras(out / "rendered_cameras.json")
    assert (table.model, table.width, table.height) == ("OPENCV_FISHEYE", 64, 48)
    again = render_run(run, ViewSettings(path=out / "rendered_cameras.json", long_side=32), tmp_path / "half")
    half = read_cameras(again / "rendered_cameras.json")
    assert (half.width, half.K[0][0, 0]) == (32, FOCAL / 2)


def test_splats_have_what_the_border_of_the_lens_alone_sees(run: Path):
    found = open_map(run, SplatPlySettings())
    assert found.views.model == "OPENCV_FISHEYE"
    assert float((found.gaussians.xyz[:, 0].abs() > REACH + 0.8).sum()) > 20


def test_data_sets_have_the_lens_and_the_frames_as_they_are(run: Path, tmp_path: Path):
    colmap.export_run(run, tmp_path / "colmap", ColmapExportSettings())
    camera = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0")).cameras[1]
    assert camera.model.name == "OPENCV_FISHEYE"
    np.testing.assert_allclose(camera.params, [FOCAL, FOCAL, 33, 23, *LENS])
    nerfstudio.export_run(run, tmp_path / "nerf", NerfstudioSettings())
    document = json.loads((tmp_path / "nerf" / "transforms.json").read_text())
    assert (document["camera_model"], document["is_fisheye"]) == ("OPENCV_FISHEYE", True)
    assert (document["fl_x"], *(document[k] for k in ("k1", "k2", "k3", "k4"))) == (FOCAL, *LENS)
    for folder in ("colmap", "nerf"):
        assert (tmp_path / folder / "images" / "3.png").read_bytes() == (run / "prepare" / "3.png").read_bytes()


def test_the_viewer_lays_a_frame_onto_the_map_to_its_border(run: Path):
    viewed = open_viewed_run(run, "cpu")
    name = viewed.rec.names[3]
    camera = ViewCamera(viewed.cameras.cam2world[3].double(), fov=1.4, aspect=64 / 48)
    painter = Painter(viewed)
    of_map = painter.draw(camera, 96, LayerChoice()).rgb.astype(float)
    of_frame = painter.draw(camera, 96, LayerChoice(layer="Frame as filmed", frame=name)).rgb.astype(float)
    nothing = np.abs(of_frame - of_frame[0, 0]).max(-1) < 1  # the corner is outside of the frame
    off = np.abs(of_map - of_frame).mean(-1)
    assert np.median(off[~nothing]) < 3
    assert not nothing[36].any()


def test_a_frustum_shows_the_frame_as_a_pinhole_has_it(run: Path):
    viewed = open_viewed_run(run, "cpu")
    name, lens = viewed.rec.names[3], viewed.cameras[3]
    small = torch.from_numpy(viewed.thumbnail(name).astype(np.float32) / 255)
    pinhole: Cameras = lens.pinhole(128)
    frame = stored(run / "prepare" / name)
    straight, _ = undistorted(frame, torch.ones(48, 64, dtype=torch.bool), lens, pinhole)
    assert psnr(small, straight) > 40
    assert psnr(small, frame) < 35
