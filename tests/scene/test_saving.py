"""Records come back from disk with the same bits, and a folder in use is not written to."""

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import swimm3r
from swimm3r.errors import InputError, StorageError
from swimm3r.geometry import so3_exp
from swimm3r.io import ply
from swimm3r.io.images import write_mask, write_rgb
from swimm3r.medium import AttenuationCurve
from swimm3r.scene.frames import Frame
from swimm3r.scene.reconstruction import DenseCloud, DepthMap, DepthMaps, Matches, Points, QualityWarning, Tracks
from swimm3r.scene.white_balance import WhiteBalance

NAMES = ("a/0.png", "a/1.png", "b/2.png")
RNG = np.random.default_rng(0)


def random(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.from_numpy(RNG.random(shape)).to(dtype)


def same(a: Any, b: Any) -> bool:
    """Return whether two records are equal to the last bit, types included."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return a == b


@pytest.fixture
def frames(tmp_path: Path) -> swimm3r.Frames:
    """Three images in two folders, one with a mask, one held back."""
    listed = []
    for i, name in enumerate(NAMES):
        path, mask = tmp_path / "given" / name, tmp_path / "masks" / f"{i}.png"
        write_rgb(path, RNG.integers(0, 255, (6, 8, 3)).astype(np.uint8))
        write_mask(mask, RNG.random((6, 8)) > 0.5)
        split = "test" if i == 0 else "train"
        listed.append(Frame(name, path, i / 3, 100 * RNG.random(), split, mask if i == 1 else None))
    return swimm3r.Frames(tuple(listed), 8, 6, ordered=True, warnings=("one is <dark>",), unused_masks=2)


@pytest.fixture
def cameras() -> swimm3r.Cameras:
    """Three cameras of different focal lengths, with distortion."""
    K = torch.eye(3, dtype=torch.float64).repeat(3, 1, 1)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = 7 + random(3), 7 + random(3), 4.1, 3.2
    pose = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    pose[:, :3, :3], pose[:, :3, 3] = so3_exp(random(3, 3)), random(3, 3)
    return swimm3r.Cameras(K, 0.01 * random(3, 4), pose, 8, 6, "OPENCV")


@pytest.fixture
def fit() -> swimm3r.MediumFit:
    Binf, beta_D, beta_B, a, b, c, d, *std = (random(3, dtype=torch.float32) for _ in range(10))
    return swimm3r.MediumFit(
        Binf, beta_D, beta_B, AttenuationCurve(a, -b, c, -d), swimm3r.Medium(*std),
        {name: torch.tensor([True, False, True]) for name in ("Binf", "beta_D", "beta_B")}, (0.3, 1 / 3 + 4), "srgb",
    )  # fmt: skip


@pytest.fixture
def rec(tmp_path: Path, cameras: swimm3r.Cameras, fit: swimm3r.MediumFit) -> swimm3r.Reconstruction:
    depth = DepthMaps(tmp_path / "work" / "z_depth")
    for name in NAMES[1:]:
        depth.write(name, DepthMap(random(6, 8, dtype=torch.float32), torch.ones(6, 8)))
    bytes_ = torch.from_numpy(RNG.integers(0, 256, (5, 3)))
    index = torch.tensor([0, 1, 1, 2, 2, 0])
    xyz = random(5, 3, dtype=torch.float32)
    return swimm3r.Reconstruction(
        names=NAMES,
        cameras=cameras,
        points=Points(random(5, 3), bytes_.float() / 255, random(5)),
        tracks=Tracks(torch.tensor([0, 0, 1, 1, 2, 2]), index, 6 * random(6, 2)),
        matches=Matches(index, index.flip(0), random(6, 2), random(6, 2), random(6)),
        depth=depth,
        backend="by <hand>",
        metric=True,
        medium=fit,
        medium_linear=replace(fit, encoding="linear"),
        cloud=DenseCloud(xyz, bytes_.float() / 255, bytes_.flip(0).float() / 255),
        warnings=(QualityWarning("little & far", "go <nearer>"),),
        white_balance=WhiteBalance((1.25, 1.0, 0.7)),
        points_found=17,
    )


def test_frames_come_back(frames: swimm3r.Frames, tmp_path: Path):
    frames.save(tmp_path / "copy")
    again = swimm3r.load_frames(str(tmp_path / "copy"))
    assert [replace(f, path=Path(), mask=None) for f in again] == [replace(f, path=Path(), mask=None) for f in frames]
    assert replace(again, frames=()) == replace(frames, frames=())
    for i in range(3):
        assert torch.equal(again.image(i), frames.image(i))
        assert torch.equal(again.mask(i), frames.mask(i))
        assert again.frames[i].path.is_relative_to(tmp_path / "copy")


def test_cameras_come_back(cameras: swimm3r.Cameras, tmp_path: Path):
    cameras.save(tmp_path / "cameras.json")
    assert same(swimm3r.load_cameras(tmp_path / "cameras.json"), cameras)
    shared = replace(cameras, K=cameras.K[:1].repeat(3, 1, 1), distortion=torch.zeros(3, 0).double(), model="PINHOLE")
    shared.save(str(tmp_path / "cameras.json"), NAMES, units="metres")
    assert same(swimm3r.load_cameras(tmp_path / "cameras.json"), shared)
    with pytest.raises(ValueError, match="poses are a rotation"):
        replace(cameras, cam2world=2 * cameras.cam2world).save(tmp_path / "other.json")
    assert not (tmp_path / "other.json").exists()


def test_the_water_comes_back(fit: swimm3r.MediumFit, tmp_path: Path):
    path = tmp_path / "medium.json"
    for water in (fit, replace(fit, encoding="linear"), fit.std):
        water.save(path)
        assert same(swimm3r.load_medium(path), water)
    with pytest.raises(InputError, match="no medium named linear"):
        swimm3r.load_medium(path, "linear")
    with pytest.raises(ValueError, match="3 values per coefficient"):
        fit.at(torch.ones(2, 2)).save(tmp_path / "per_pixel.json")


@pytest.mark.parametrize("text", ["{}", "[]", "{", '{"Binf": [0, 0, 1]}', '{"stored": {}}'])
def test_a_file_without_water_is_refused(text: str, tmp_path: Path):
    (tmp_path / "medium.json").write_text(text)
    with pytest.raises(InputError, match=r"medium\.json is not a medium\.json \("):
        swimm3r.load_medium(tmp_path / "medium.json")


def test_a_reconstruction_comes_back(rec: swimm3r.Reconstruction, frames: swimm3r.Frames, tmp_path: Path):
    rec.save(tmp_path / "copy", frames)
    again = swimm3r.load_reconstruction(tmp_path / "copy")
    assert {p.name for p in (tmp_path / "copy").iterdir()} >= {"trajectory.tum", "cameras.json", "medium.json"}
    assert NAMES[0] not in again.depth
    for name in NAMES[1:]:
        assert same(again.depth[name], rec.depth[name])
    placed = replace(again, depth=rec.depth)
    for f in fields(rec):
        assert same(getattr(placed, f.name), getattr(rec, f.name)), f.name
    both = swimm3r.load_medium(tmp_path / "copy" / "medium.json", "linear")
    assert same(both, rec.medium_linear)


def test_saved_twice_a_reconstruction_has_the_same_bits(rec: swimm3r.Reconstruction, tmp_path: Path):
    rec.save(tmp_path / "one")
    swimm3r.load_reconstruction(tmp_path / "one").save(str(tmp_path / "two"))
    for path in sorted((tmp_path / "one").rglob("*.*")):
        if path.is_file() and path.suffix != ".npz":  # which carry times
            assert path.read_bytes() == (tmp_path / "two" / path.relative_to(tmp_path / "one")).read_bytes(), path


def test_a_cloud_is_saved_as_shown_as_restored_and_as_filmed(rec: swimm3r.Reconstruction, tmp_path: Path):
    assert rec.cloud is not None
    cloud = rec.cloud
    for source in ("restored", "filmed"):
        folder = tmp_path / source
        replace(rec, white_balance=WhiteBalance((1.25, 1.0, 0.7), source)).save(folder)
        balanced = (cloud.restored * torch.tensor([1.25, 1.0, 0.7])).clamp(0, 1)
        expected = {"points": balanced if source == "restored" else cloud.raw, "points_physical": cloud.restored}
        for stem, rgb in {**expected, "points_raw": cloud.raw}.items():
            assert np.abs(ply.read_points(folder / f"{stem}.ply")[1] - rgb.numpy()).max() <= 0.5 / 255 + 1e-6


def test_points_brighter_than_white_keep_their_colors_where_they_are_shown_darker(
    rec: swimm3r.Reconstruction, tmp_path: Path
):
    assert rec.cloud is not None
    bright = torch.linspace(0.9, 1.9, len(rec.cloud.xyz))[:, None].expand(-1, 3).contiguous()
    one = replace(rec, cloud=replace(rec.cloud, restored=bright), white_balance=WhiteBalance((0.6, 0.5, 0.8)))
    one.save(tmp_path / "one")
    again = swimm3r.load_reconstruction(tmp_path / "one")
    assert again.cloud is not None
    rounded = 0.51 / 255 / torch.tensor([0.6, 0.5, 0.8])
    seen = bright * one.white_balance.factors <= 1
    assert ((again.cloud.restored - bright).abs() < rounded)[seen].all()
    again.save(tmp_path / "two")
    for stem in ("points", "points_physical"):
        assert (tmp_path / "one" / f"{stem}.ply").read_bytes() == (tmp_path / "two" / f"{stem}.ply").read_bytes()
    assert ply.read_points(tmp_path / "one" / "points_physical.ply")[1].max() == 1


@pytest.mark.parametrize("gains", ["[1, 1]", "[1, 0, 1]", "[1, -1, 1]", "[1, NaN, 1]", "[1, 1e9, 1]", '"gray"'])
def test_a_white_balance_that_is_none_is_refused_by_name(gains: str, rec: swimm3r.Reconstruction, tmp_path: Path):
    rec.save(tmp_path / "one")
    (tmp_path / "one" / "white_balance.json").write_text(f'{{"gains": {gains}}}')
    with pytest.raises(InputError, match=r"white_balance\.json is damaged \("):
        swimm3r.load_reconstruction(tmp_path / "one")


def test_a_lost_white_balance_is_missed_and_an_early_run_without_any_is_read(
    rec: swimm3r.Reconstruction, tmp_path: Path
):
    rec.save(tmp_path / "one")
    (tmp_path / "one" / "white_balance.json").unlink()
    with pytest.raises(InputError, match=r"white_balance\.json is missing"):
        swimm3r.load_reconstruction(tmp_path / "one")
    (tmp_path / "one" / "points_physical.ply").replace(tmp_path / "one" / "points.ply")
    early = swimm3r.load_reconstruction(tmp_path / "one")
    assert early.white_balance == WhiteBalance()
    assert same(early.cloud, rec.cloud)


def test_a_folder_in_use_is_not_written_to(rec: swimm3r.Reconstruction, frames: swimm3r.Frames, tmp_path: Path):
    used = tmp_path / "used"
    used.mkdir()
    (used / "cameras.json").write_text("mine")
    for record in (rec, frames):
        with pytest.raises(StorageError, match="other things lie in it"):
            record.save(used)
    assert [path.name for path in used.iterdir()] == ["cameras.json"]
    assert (used / "cameras.json").read_text() == "mine"


def test_a_reconstruction_saves_again_where_it_was_made(rec: swimm3r.Reconstruction):
    folder = rec.depth.folder.parent
    for metric in (True, False):
        replace(rec, metric=metric).save(folder)
        assert swimm3r.load_reconstruction(folder).metric == metric
