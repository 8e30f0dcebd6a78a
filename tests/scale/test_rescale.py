"""A run folder in another unit: everything scales together, twice is once, and a killed process leaves no half."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.scale.conftest import SCALE, Survey, lines, survey_along, write_csv
from tests.splat.conftest import make_wall
from tests.splat.cut import in_blocks

from swimm3r.cameras import project, ray_depth_from_z, unproject
from swimm3r.cli.main import main
from swimm3r.errors import InputError, UsageError
from swimm3r.export.settings import FORMATS
from swimm3r.io import ply
from swimm3r.io.cameras_json import read_cameras
from swimm3r.io.images import write_rgb
from swimm3r.io.medium_json import read_fits
from swimm3r.medium import AttenuationCurve, Medium, MediumFit, add_water
from swimm3r.scale import rescale as rescaling
from swimm3r.scale.rescale import finish_rescale, rescale_run
from swimm3r.scale.run import scale_run
from swimm3r.scale.settings import ScaleSettings
from swimm3r.scene.georeference import load_georeference
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run, read_run
from swimm3r.splat.map_file import load_map
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.rendering import SplatMap
from swimm3r.splat.settings import MediumFieldSettings, UwbsSettings

SMALL = 8


def water() -> MediumFit:
    c = [torch.tensor(v) for v in ([0.4, 0.1, 0.05], [-0.3, -0.2, -0.1], [0.2, 0.05, 0.04], [-0.02, -0.01, 0.0])]
    spread = Medium(torch.full((3,), 0.01), torch.full((3,), 0.02), torch.full((3,), 0.03))
    flags = {name: torch.tensor([True, True, False]) for name in ("Binf", "beta_D", "beta_B")}
    betas = torch.tensor([0.5, 0.2, 0.1]), torch.tensor([0.3, 0.2, 0.15])
    return MediumFit(torch.tensor([0.1, 0.5, 0.4]), *betas, AttenuationCurve(*c), spread, flags, (1.0, 9.0), "linear")


def small_map() -> SplatMap:
    rng = torch.Generator().manual_seed(0)
    n = 60
    p = BetaPrimitives(
        xyz=torch.randn(n, 3, generator=rng) * 2,
        query_mean=torch.randn(n, 3, generator=rng),
        rgb=torch.rand(n, 3, generator=rng),
        opacity=torch.randn(n, generator=rng),
        beta=torch.zeros(n, 4),
        scale=torch.cat([torch.full((n, 3), -1.0), torch.ones(n, 3)], -1),
        lower=0.1 * torch.randn(n, 15, generator=rng),
        footprint=0.02 * torch.rand(n, generator=rng),
    )
    field = MediumField(MediumFieldSettings()).requires_grad_(False)
    return SplatMap(p, field, UwbsSettings(), False, length=1.3)


def write_run(folder: Path, survey: Survey) -> Path:
    """A finished run of the survey's cameras, with depth maps, clouds, water and a map."""
    rng = np.random.default_rng(0)
    count = len(survey.rec.names)
    depth = DepthMaps(folder / "sfm" / "z_depth")
    for name in survey.rec.names:
        z = torch.from_numpy(rng.uniform(3, 6, (SMALL, SMALL)).astype(np.float32))
        depth.write(name, DepthMap(z, torch.ones(SMALL, SMALL)))
        write_rgb(folder / "given" / name, rng.uniform(size=(survey.frames.height, survey.frames.width, 3)) * 0 + 0.5)
    listed = tuple(replace(frame, path=folder / "given" / frame.name) for frame in survey.frames)
    frames = replace(survey.frames, frames=listed)
    frames.save(folder / "prepare")
    shutil.rmtree(folder / "given")
    xyz = survey.rec.points.xyz[:500].float()
    cloud = DenseCloud(xyz, torch.rand(500, 3), torch.rand(500, 3))
    rec = replace(survey.rec, depth=depth, cloud=cloud, backdrop=cloud, medium=replace(water(), encoding="srgb"))
    replace(rec, medium_linear=water()).save(folder / "sfm", frames)
    small_map().save(folder / "splat" / "map.safetensors")
    done = {name: {"status": "done", "key": name} for name in ("prepare", "sfm", "splat")}
    fit = water()
    medium = {"beta_D": fit.beta_D.tolist(), "beta_B": fit.beta_B.tolist(), "unit": "per scene unit"}
    summary = {
        "schema": 2, "input": {"path": "dive.mp4", "fingerprint": "none"}, "stages": done,
        "sfm": {"metric": False, "registered": count}, "medium": {"sfm": medium},
    }  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Survey]:
    survey = survey_along(lines(count=2, each=5))
    return write_run(tmp_path_factory.mktemp("rescale") / "run", survey), survey


@pytest.fixture
def run(made, tmp_path) -> Path:
    return Path(shutil.copytree(made[0], tmp_path / "run"))


@pytest.fixture
def survey(made) -> Survey:
    return made[1]


def contents(folder: Path) -> dict[str, bytes]:
    """Every file; of a map the tensors, as the order of the names in its header is chance."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {path.relative_to(folder).as_posix(): _content(path) for path in files}


def _content(path: Path) -> bytes:
    if path.suffix != ".safetensors":
        return path.read_bytes()
    scene = load_map(path)
    assert isinstance(scene.field, MediumField)
    return (
        b"".join(values.numpy().tobytes() for values in (*scene.primitives, scene.field.length)) + repr(scene).encode()
    )


def test_what_the_frames_show_stays_where_it_was(run):
    before = load_reconstruction(run / "sfm")
    rescale_run(run, 0.4, {})
    after = load_reconstruction(run / "sfm")
    assert after.metric
    torch.testing.assert_close(after.cameras.centers, 0.4 * before.cameras.centers)
    points = [rec.points.xyz[None].expand(len(rec.names), -1, -1) for rec in (before, after)]
    seen = [project(rec.cameras, xyz) for rec, xyz in zip((before, after), points, strict=True)]
    torch.testing.assert_close(seen[1][0], seen[0][0], atol=1e-6, rtol=0)
    torch.testing.assert_close(seen[1][1], 0.4 * seen[0][1])
    torch.testing.assert_close(after.cloud.xyz, 0.4 * before.cloud.xyz)
    torch.testing.assert_close(after.backdrop.xyz, 0.4 * before.backdrop.xyz)
    torch.testing.assert_close(after.tracks.xy, before.tracks.xy)


def test_depth_maps_and_poses_scale_together(run):
    def ground(rec):
        pixels = torch.rand(1, 20, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 400
        z = rec.depth[rec.names[3]].z_depth.double().flatten()[:20][None]
        return unproject(rec.cameras[3], pixels, z)

    before = ground(load_reconstruction(run / "sfm"))
    rescale_run(run, 0.4, {})
    torch.testing.assert_close(ground(load_reconstruction(run / "sfm")), 0.4 * before, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["stored", "linear"])
def test_the_water_changes_no_color_and_every_coefficient(run, name):
    before = read_fits(run / "sfm" / "medium.json", rescaling.remake(run))[name]
    rescale_run(run, 0.4, {})
    after = read_fits(run / "sfm" / "medium.json", rescaling.remake(run))[name]
    z, J = torch.linspace(0.5, 12, 40), torch.rand(40, 3)
    torch.testing.assert_close(add_water(J, 0.4 * z, after.at(0.4 * z)), add_water(J, z, before.at(z)))
    for coefficient in "abcd":
        torch.testing.assert_close(getattr(after.curve, coefficient), getattr(before.curve, coefficient) / 0.4)
    torch.testing.assert_close(after.std.beta_D, before.std.beta_D / 0.4)


def test_the_map_renders_the_same_images_at_scaled_depth(run):
    before = load_map(run / "splat" / "map.safetensors")
    rec = load_reconstruction(run / "sfm")
    camera = replace(rec.cameras[4].pinhole(64), cam2world=torch.eye(4, dtype=torch.float64)[None].clone())
    camera.cam2world[0, 2, 3] = -6.0
    first = before.render(camera)
    rescale_run(run, 0.4, {})
    after = load_map(run / "splat" / "map.safetensors")
    camera.cam2world[0, 2, 3] = -2.4
    second = after.render(camera)
    assert after.metric
    assert after.length == pytest.approx(0.4 * before.length)
    torch.testing.assert_close(second.rgb, first.rgb, atol=2e-4, rtol=0)
    torch.testing.assert_close(second.z_depth, 0.4 * first.z_depth, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(second.medium.beta_D, first.medium.beta_D / 0.4, rtol=1e-4, atol=1e-6)
    rays = ray_depth_from_z(first.z_depth, torch.ones(*first.z_depth.shape, 3))
    assert bool((rays > 0).any())


def test_a_map_in_blocks_is_rescaled_block_by_block(run):
    path = run / "splat" / "map.safetensors"
    whole = make_wall(600)
    path.unlink()
    in_blocks(whole, path.parent).save(path)
    before = load_map(path)
    parts = [p.xyz for p in before.parts()]
    boxes = [(entry.low, entry.high, entry.spacing) for entry in before.blocks.entries]
    rescale_run(run, 0.4, {})
    after = load_map(path)
    assert after.blocks is not None
    assert after.metric
    for p, xyz in zip(after.parts(), parts, strict=True):
        torch.testing.assert_close(p.xyz, 0.4 * xyz)
    for entry, (low, high, spacing) in zip(after.blocks.entries, boxes, strict=True):
        np.testing.assert_allclose(entry.low, 0.4 * np.array(low))
        np.testing.assert_allclose(entry.high, 0.4 * np.array(high))
        assert entry.spacing == pytest.approx(0.4 * spacing)
    for one, other in zip(before.blocks.entries, after.blocks.entries, strict=True):
        assert (one.primitives, one.coarse) == (other.primitives, other.coarse)


def test_there_and_back_is_where_it_was(run):
    clouds = [run / "sfm" / name for name in ("points.ply", "points_raw.ply", "backdrop_physical.ply")]
    before = [ply.read_points(path) for path in clouds]
    rescale_run(run, 0.3, {})
    rescale_run(run, 1 / 0.3, {})
    for path, (xyz, rgb) in zip(clouds, before, strict=True):
        again = ply.read_points(path)
        np.testing.assert_allclose(again[0], xyz, rtol=3e-7)
        np.testing.assert_array_equal(again[1], rgb)


def test_the_same_sources_twice_leave_every_byte(run, survey, tmp_path):
    settings = ScaleSettings(nav=write_csv(tmp_path / "nav.csv", survey), nav_offset=0.0)
    first = scale_run(run, settings)
    assert first["metres_per_unit"] == pytest.approx(SCALE, rel=1e-6)
    before = contents(run)
    second = scale_run(run, settings)
    assert second["factor"] == 1.0
    assert second["metres_per_unit"] == pytest.approx(first["metres_per_unit"], rel=1e-12)
    after = contents(run)
    files = [name for name in before if name not in ("scale.json", "summary.json", "georeference.json")]
    assert [name for name in files if after[name] != before[name]] == []
    place, again = (json.loads(text["georeference.json"]) for text in (before, after))
    np.testing.assert_allclose(again["origin"], place["origin"], atol=1e-6)


def test_every_file_with_lengths_changes_and_no_other(run):
    before = contents(run)
    rescale_run(run, 0.4, {})
    after = contents(run)
    changed = {name for name in before if after[name] != before[name]}
    assert set(after) == set(before)
    assert changed >= {
        "sfm/cameras.json", "sfm/trajectory.tum", "sfm/points.ply", "sfm/points_raw.ply", "sfm/points_physical.ply",
        "sfm/backdrop.ply", "sfm/medium.json", "sfm/reconstruction.json", "sfm/sparse/points3D.bin",
        "sfm/sparse/images.bin", "sfm/z_depth/0000.png.npz", "splat/map.safetensors",
    }  # fmt: skip
    kept = {name for name in before if name.startswith("prepare/")} | {"sfm/matches.npz", "sfm/white_balance.json"}
    assert not changed & kept


def test_cameras_of_rendered_views_stay_those_of_their_depth(run):
    views = run / "renders" / "views"
    load_reconstruction(run / "sfm").cameras.save(views / "rendered_cameras.json")
    before = read_cameras(views / "rendered_cameras.json")
    rescale_run(run, 0.4, {})
    after = read_cameras(views / "rendered_cameras.json")
    np.testing.assert_allclose(after.cam2world[:, :3, 3], 0.4 * before.cam2world[:, :3, 3], rtol=1e-6)
    assert after.units == "metres"


@pytest.mark.parametrize("settings", FORMATS.values(), ids=FORMATS)
def test_exports_of_every_format_are_listed_as_of_the_old_unit(run, settings):
    path = run / settings.file_name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    assert settings.file_name in rescale_run(run, 0.4, {})


@pytest.mark.parametrize("after", [0, 1, 7])
def test_a_process_killed_while_files_take_their_places_is_finished_later(run, tmp_path, monkeypatch, after):
    whole = Path(shutil.copytree(run, tmp_path / "whole"))
    rescale_run(whole, 0.4, {"note.json": "{}"})
    moves = iter(range(after))
    real = os.replace

    def replace_some(source, target):
        if rescaling.RESCALING.parent.name in str(source) and "draft" not in str(source):
            next(moves)  # StopIteration stands for the kill
        real(source, target)

    monkeypatch.setattr(rescaling.os, "replace", replace_some)
    with pytest.raises((StopIteration, RuntimeError)):
        rescale_run(run, 0.4, {"note.json": "{}"})
    monkeypatch.undo()
    with pytest.raises(InputError, match="two units"):
        read_run(run)
    assert finish_rescale(run)
    assert contents(run) == contents(whole)
    assert not finish_rescale(run)


def test_a_process_killed_before_has_changed_nothing(run, tmp_path, monkeypatch):
    before = contents(run)

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(rescaling, "_map", killed)
    with pytest.raises(KeyboardInterrupt):
        rescale_run(run, 0.4, {})
    monkeypatch.undo()
    shutil.rmtree(run / rescaling.RESCALING.parent)
    assert contents(run) == before
    read_run(run)


def test_litter_of_a_killed_process_does_not_come_into_the_run(run):
    litter = run / rescaling.RESCALING.parent / "sfm" / "cameras.json"
    litter.parent.mkdir(parents=True)
    litter.write_text("half")
    rescale_run(run, 0.4, {})
    load_reconstruction(run / "sfm")
    assert not litter.exists()


def test_the_summary_and_the_record_are_in_metres(run, survey, tmp_path):
    before = json.loads((run / "summary.json").read_text())["medium"]["sfm"]
    scale_run(run, ScaleSettings(nav=write_csv(tmp_path / "nav.csv", survey), nav_offset=0.0))
    summary = open_run(run, "sfm").sections
    assert summary["sfm"]["metric"]
    assert summary["medium"]["sfm"]["unit"] == "1/m"
    np.testing.assert_allclose(summary["medium"]["sfm"]["beta_D"], np.array(before["beta_D"]) / SCALE, rtol=1e-5)
    table = summary["water"]
    assert table["unit"] == "1/m"
    relative = np.array(table["beta_D"]["std"]) / table["beta_D"]["value"]
    bare = np.array([0.02 / v for v in before["beta_D"]])
    np.testing.assert_allclose(relative, np.hypot(bare, summary["scale"]["std"]), rtol=1e-4)
    assert table["derived"]["jerlov"] is not None
    place = load_georeference(run)
    assert place is not None
    assert place.scale == 1.0
    assert place.sources == ("navigation",)


def test_another_source_later_keeps_the_place_and_replaces_the_scale(run, survey, tmp_path):
    scale_run(run, ScaleSettings(nav=write_csv(tmp_path / "nav.csv", survey), nav_offset=0.0))
    centers = load_reconstruction(run / "sfm").cameras.centers.numpy()
    first = load_georeference(run)
    section = scale_run(run, ScaleSettings(camera_height=2.2, camera_height_std=0.01))
    second = load_georeference(run)
    assert first is not None
    assert second is not None
    assert section["metres_per_unit"] == pytest.approx(SCALE * section["factor"], rel=1e-6)
    assert section["factor"] > 1.02
    assert second.epsg == first.epsg
    again = load_reconstruction(run / "sfm").cameras.centers.numpy()
    np.testing.assert_allclose(second.to_crs(again).mean(0), first.to_crs(centers).mean(0), atol=1e-6)


def test_a_half_trained_map_is_not_rescaled(run):
    summary = json.loads((run / "summary.json").read_text())
    summary["stages"]["splat"]["status"] = "running"
    (run / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(UsageError, match="half trained"):
        scale_run(run, ScaleSettings(camera_height=2.0))


def test_without_sources_and_without_anything_to_finish_the_command_says_so(run):
    with pytest.raises(UsageError, match="no source of scale"):
        scale_run(run, ScaleSettings())


def test_a_refused_source_leaves_every_byte(run, survey, tmp_path):
    before = contents(run)
    with pytest.raises(InputError, match="swapped"):
        scale_run(
            run,
            ScaleSettings(
                nav=write_csv(tmp_path / "n.csv", survey, latitude=np.full(10, 120.0), longitude=np.zeros(10))
            ),
        )
    assert contents(run) == before


def test_the_command_prints_lengths_with_their_standard_deviation(run, survey, tmp_path, capsys):
    main(["scale", str(run), "--nav", str(write_csv(tmp_path / "nav.csv", survey)), "--nav-std", "0.1", "0.1", "0.1"])
    said = capsys.readouterr().out
    assert "A unit of structure from motion is 0.40" in said
    assert "\u00b1" in said
    assert "EPSG:32701" in said
    assert "navigation" in said
