"""A run whose map lies in blocks is viewed, rendered, exported and searched like any other."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.splat.conftest import make_wall
from tests.splat.cut import in_blocks

from swimm3r.export import export_run
from swimm3r.export.settings import SplatPlySettings
from swimm3r.io import images
from swimm3r.localization.references import rendered
from swimm3r.pipeline.renders import render_run
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.splat.map_file import load_map
from swimm3r.viewer.layers import CropBox, LayerChoice, Painter, ViewCamera
from swimm3r.viewer.panel import about
from swimm3r.viewer.viewed_run import open_viewed_run


@pytest.fixture(scope="module")
def runs(wall_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run whose map is a wall with waves, where no two primitives have one depth; and that map in blocks."""
    scene = replace(make_wall(3000), span=(0.0, 8.0))
    folders = []
    for name in ("plain", "cut"):
        folders.append(tmp_path_factory.mktemp(name) / "wall")
        shutil.copytree(wall_run, folders[-1])
        (folders[-1] / "splat" / "map.safetensors").unlink()
        saved = scene if name == "plain" else in_blocks(scene, folders[-1] / "splat")
        saved.save(folders[-1] / "splat" / "map.safetensors")
    return folders[0], folders[1]


def test_the_viewer_shows_the_same_pictures(runs):
    plain, cut = (Painter(open_viewed_run(folder, "cpu")) for folder in runs)
    assert cut.layers == plain.layers
    assert "3,000 primitives" in about(cut)
    view = ViewCamera(plain.run.cameras.cam2world[3].double(), 0.7, 1.3)
    crop = CropBox((-1.0, -2.0, 0.0), (0.4, 2.0, 9.0))
    for choice in (LayerChoice(), LayerChoice("Without the water"), LayerChoice("Depth"), LayerChoice(crop=crop)):
        a, b = (painter.draw(view, 64, choice) for painter in (plain, cut))
        assert np.abs(a.rgb.astype(int) - b.rgb).max() <= 1, choice
        np.testing.assert_allclose(np.asarray(b.z_depth), np.asarray(a.z_depth), atol=1e-3)


def test_views_exports_and_references_are_the_same(runs, tmp_path):
    outs = []
    for folder in runs:
        out = render_run(folder, ViewSettings(count=2, path="dive"), tmp_path / folder.parent.name, map_device="cpu")
        exported = export_run(folder, tmp_path / f"{folder.parent.name}.ply", SplatPlySettings())
        scene, run = load_map(folder / "splat" / "map.safetensors"), open_viewed_run(folder, "cpu")
        outs.append((out, exported, rendered(scene, run.rec.cameras[2], 64, 0.5)))
    (plain, wrote, reference), (cut, wrote_cut, reference_cut) = outs
    for path in sorted(plain.glob("*_rgb.png")):
        difference = images.read_rgb(path).astype(int) - images.read_rgb(cut / path.name)
        assert np.abs(difference).max() <= 1
    assert wrote_cut.content == wrote.content
    torch.testing.assert_close(reference_cut.rgb, reference.rgb, atol=1e-3, rtol=0)
    assert torch.equal(reference_cut.z_depth > 0, reference.z_depth > 0)
