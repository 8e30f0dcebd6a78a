"""FLSea's protocol on a tree in its layout: one set of frames, a reference of the restored ones, depth and poses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from swimm3r.bench.protocols import flsea
from swimm3r.bench.protocols.flsea import chosen_sequences, compare_on_flsea, sequence_depth_scores
from swimm3r.bench.settings import ABLATION, SfmMethods
from swimm3r.datasets import read_tree
from swimm3r.errors import InputError, RegistrationError
from swimm3r.evaluate import NotComputed
from swimm3r.io.images import read_rgb
from swimm3r.pipeline.finished_sfm import open_finished_sfm
from swimm3r.prepare import load_frames
from swimm3r.scene.frames import Frames
from swimm3r.scene.ground_truth import FOLDER, GroundTruth, read_ground_truth
from swimm3r.scene.reconstruction import DepthMap, DepthMaps, Reconstruction
from swimm3r.sfm.colmap import poses as colmap
from swimm3r.sfm.settings import ColmapSettings, Mast3rSettings

FIRST = 16233051861828957
ONLY_COLMAP = SfmMethods(("colmap-incremental", "colmap-global", "vggt", "mast3r"))


@pytest.fixture(scope="module")
def truth(run: Path) -> GroundTruth:
    return read_ground_truth(run.parent / "dive" / FOLDER)


@pytest.fixture(scope="module")
def tree(run: Path, truth: GroundTruth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dive as the Kaggle archive unpacks: doubled folders, tenths of microseconds for names."""
    root = tmp_path_factory.mktemp("archive")
    folder = root / "red_sea" / "sub_pier" / "sub_pier"
    for name in ("imgs", "seaErra", "depth"):
        (folder / name).mkdir(parents=True)
    for i, name in enumerate(truth.names):
        stamp, z_depth = FIRST + i * 1_000_000, truth.z_depth(name)
        assert z_depth is not None
        tifffile.imwrite(folder / "imgs" / f"{stamp}.tiff", read_rgb(run.parent / "dive" / "images" / name))
        tifffile.imwrite(folder / "seaErra" / f"{stamp}_SeaErra.tiff", read_rgb(truth.folder / "clear" / f"{name}.png"))
        tifffile.imwrite(folder / "depth" / f"{stamp}_SeaErra_abs_depth.tif", z_depth.numpy().astype(np.float32))
    return root


def known(frames: Frames, truth: GroundTruth, rec: Reconstruction, folder: Path) -> Reconstruction:
    """The result of perfect structure from motion, at another scale."""
    rows = [(int(Path(name).stem) - FIRST) // 1_000_000 for name in frames.names]
    depth = DepthMaps(folder / "z_depth")
    for name, row in zip(frames.names, rows, strict=True):
        z = truth.z_depth(truth.names[row])
        assert z is not None
        depth.write(name, DepthMap(3 * z, (z > 0).float()))
    return replace(rec, names=frames.names, cameras=truth.cameras[rows], depth=depth)


@pytest.fixture
def perfect(run: Path, truth: GroundTruth, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """COLMAP finds everything in whatever it is given, but nothing in the global way; the list says what was asked."""
    monkeypatch.setenv("SWIMM3R_WEIGHTS_DIR", str(tmp_path / "no weights"))
    monkeypatch.setenv("SWIMM3R_CACHE", str(tmp_path / "no cache"))
    rec, asked = open_finished_sfm(run).rec, []

    def reconstruct(frames, settings, folder, progress):
        asked.append(settings.mapping.method)
        if settings.mapping.method == "global":
            raise RegistrationError("nothing", cause="", hint="")
        assert {frame.split for frame in frames} == {"train"}
        return known(frames, truth, rec, folder)

    def reference(frames, settings, folder, progress, lens):
        asked.append("reference")
        assert lens is None  # no distortion of this camera was published
        assert settings.focal == pytest.approx(1296.67 * 192 / 968, abs=0.01)
        first = truth.clear(truth.names[0])
        assert first is not None
        assert float(frames.image(0).mean()) == pytest.approx(float(first.mean()), abs=1e-3)  # the restored image
        return known(frames, truth, rec, folder)

    monkeypatch.setattr(flsea, "reconstruct", reconstruct)
    monkeypatch.setattr(colmap, "reconstruct", reference)
    return asked


def test_perfect_depth_and_poses_score_full_marks_and_failures_fail(tree: Path, tmp_path: Path, perfect: list[str]):
    table = compare_on_flsea(tree, tmp_path, ONLY_COLMAP, ColmapSettings(), Mast3rSettings(), stride=2)
    found, lost, vggt, mast3r = table.cells
    assert found.scene == "red_sea/sub_pier"
    assert found.scores == {
        "absrel_median": pytest.approx(0, abs=1e-5),
        "delta125_median": pytest.approx(100),
        "rmselog_median": pytest.approx(0, abs=1e-5),
        "depth_coverage_pct": pytest.approx(100),
        "rra15": 100,
        "rta15": 100,
        "maa30": pytest.approx(100),
        "registered_pct": 100,
        "reference_pct": 100,
    }
    assert (lost.scores["rra15"], lost.scores["registered_pct"], lost.scores["depth_coverage_pct"]) == (0, 0, 0)
    assert isinstance(lost.scores["absrel_median"], NotComputed)
    assert "--imports" in vggt.not_run
    assert "weights" in mast3r.not_run
    assert perfect == ["reference", "incremental", "global"]
    again = compare_on_flsea(tree, tmp_path, ONLY_COLMAP, ColmapSettings(), Mast3rSettings(), stride=2)
    assert again.cells == table.cells
    assert perfect == ["reference", "incremental", "global"]
    prepared = [load_frames(path.parent) for path in (tmp_path / "frames").rglob("frames.json")]
    assert [len(frames) for frames in prepared] == [5, 5]  # raw and restored, every second of nine


def test_a_frame_without_depth_lowers_the_coverage_not_the_scores(run: Path, truth: GroundTruth, tree: Path):
    sequence = read_tree(tree).sequences[0]
    names = [f"{shot.name}.tiff" for shot in sequence.shots]
    whole = open_finished_sfm(run).rec
    rec = known(_named(names), truth, whole, run.parent / "depth")
    (rec.depth.path(names[0])).unlink()
    scores = sequence_depth_scores(rec, sequence, names)
    assert scores["absrel_median"] == pytest.approx(0, abs=1e-5)
    assert isinstance(scores["depth_coverage_pct"], float)
    assert 80 < scores["depth_coverage_pct"] < 95


def _named(names: list[str]) -> Frames:
    from swimm3r.scene.frames import Frame

    return Frames(tuple(Frame(name, Path(name), 0.0, 1.0, "train") for name in names), 192, 128, True)


def test_the_ablated_trainings_are_rows_of_their_own(tree: Path, tmp_path: Path, perfect: list[str]):
    given = SfmMethods(ABLATION)
    table = compare_on_flsea(tree, tmp_path, given, ColmapSettings(), Mast3rSettings(), name="ablation-sfm")
    assert [c.method for c in table.cells] == list(ABLATION)
    assert all("weights" in c.not_run for c in table.cells)
    assert table.name == "ablation-sfm"


def test_sequences_are_the_papers_unless_others_are_named(tree: Path):
    assert chosen_sequences(tree) == ["red_sea/sub_pier"]
    assert chosen_sequences(tree, ["sub_pier"]) == ["red_sea/sub_pier"]
    with pytest.raises(InputError, match="u_canyon"):
        chosen_sequences(tree, ["u_canyon"])


def test_poses_beside_the_images_are_the_reference(tree: Path, tmp_path: Path, truth: GroundTruth):
    sequence = read_tree(tree).sequences[0]
    poses = {shot.name: truth.cameras.cam2world[k].numpy() for k, shot in enumerate(sequence.shots[:4])}
    frames = _named([f"{shot.name}.tiff" for shot in sequence.shots[1:6]])
    posed = replace(sequence, cam2world=poses)
    found = flsea.reference_of(posed, sequence.shots[1:6], frames, ColmapSettings(), tmp_path)
    assert isinstance(found, GroundTruth)
    assert found.names == frames.names[:3]
    torch.testing.assert_close(found.cameras.cam2world, truth.cameras.cam2world[1:4].double())
    beyond = sequence.shots[5:]
    none = flsea.reference_of(posed, beyond, _named([f"{s.name}.tiff" for s in beyond]), ColmapSettings(), tmp_path)
    assert isinstance(none, NotComputed)
    assert "none of these frames" in none.reason


def test_without_restored_images_there_is_no_reference(tree: Path, tmp_path: Path):
    sequence = read_tree(tree).sequences[0]
    bare = replace(sequence, shots=tuple(replace(shot, clean=None) for shot in sequence.shots))
    frames = _named([f"{shot.name}.tiff" for shot in bare.shots])
    found = flsea.reference_of(bare, bare.shots, frames, ColmapSettings(), tmp_path)
    assert isinstance(found, NotComputed)
