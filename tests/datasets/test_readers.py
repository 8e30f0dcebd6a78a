"""Readers of the published layouts, on trees made in them and on real FLSea frames."""

from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from swimm3r.datasets import load, read_tree
from swimm3r.datasets.flsea import REGIONS
from swimm3r.datasets.sequences import Sequence, Survey
from swimm3r.datasets.tree import describe
from swimm3r.errors import InputError
from swimm3r.io.colmap.model import ColmapModel, write_model
from swimm3r.io.depth import read_depth
from swimm3r.io.images import write_rgb
from swimm3r.medium import srgb_from_linear
from swimm3r.synthetic import DiveSettings, write_dive

RNG = np.random.default_rng(0)


def tiff(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, values)


def rgb(height: int = 6, width: int = 8, bits: int = 8) -> np.ndarray:
    return RNG.integers(0, 2**bits, (height, width, 3)).astype(np.uint8 if bits == 8 else np.uint16)


def metres(height: int = 6, width: int = 8) -> np.ndarray:
    return RNG.uniform(1, 5, (height, width)).astype(np.float32)


def flsea_sequence(folder: Path, stamps: list[int], depth_name: str = "{}_SeaErra_abs_depth.tif") -> None:
    for stamp in stamps:
        tiff(folder / "imgs" / f"{stamp}.tiff", rgb())
        tiff(folder / "seaErra" / f"{stamp}_SeaErra.tiff", rgb())
        tiff(folder / "depth" / depth_name.format(stamp), metres())


def stamps(count: int, first: int = 16233051861828957) -> list[int]:
    return [first + k * 1_000_000 for k in range(count)]  # ten a second


def colmap_scene(folder: Path, names: list[str]) -> None:
    n = len(names)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = np.arange(n)
    K = np.tile(np.array([[10.0, 0, 4], [0, 10.0, 3], [0, 0, 1]]), (n, 1, 1))
    empty = np.zeros((0, 3))
    model = ColmapModel(
        tuple(names), "PINHOLE", 8, 6, K, np.zeros((n, 0)), poses, empty, empty.astype(np.uint8), np.zeros(0),
        np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)),
    )  # fmt: skip
    write_model(folder, model)


def by_name(survey: Survey) -> dict[str, Sequence]:
    return {s.name: s for s in survey.sequences}


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """FLSea-VI as Kaggle unpacks it."""
    root = tmp_path / "archive"
    for region, names in REGIONS.items():
        for name in names:
            flsea_sequence(root / region / name / name, stamps(2))
        calibration = root / region / "calibration"
        calibration.mkdir()
        (calibration / "calibration_seaErra_imu_interp-kalibr-results-imucam.txt").write_text("imu\n")
    (root / "canyons" / "flatiron" / "flatiron" / "imu.txt").write_text("0\n")
    return root


def test_flsea_is_found_with_doubled_folders_and_split_as_the_paper_does(archive: Path):
    survey = read_tree(archive)
    assert len(survey.sequences) == 12
    test = {s.name for s in survey.sequences if all(shot.split == "test" for shot in s.shots)}
    assert test == {"canyons/horse_canyon", "canyons/tiny_canyon", "red_sea/sub_pier"}
    assert all(shot.split == "train" for s in survey.sequences if s.name not in test for shot in s.shots)
    assert survey.skipped == ()


def test_flsea_repacked_with_single_folders_is_the_same(archive: Path, tmp_path: Path):
    expected = [(s.name, len(s)) for s in read_tree(archive).sequences]
    flat = tmp_path / "flat"
    for path in archive.glob("*/*/*/*/*"):
        region, name, _, kind, file = path.relative_to(archive).parts
        (flat / region / name / kind).mkdir(parents=True, exist_ok=True)
        path.rename(flat / region / name / kind / file)
    assert [(s.name, len(s)) for s in read_tree(flat).sequences] == expected


def test_a_shot_of_flsea_has_raw_restored_and_depth_of_one_time_stamp(archive: Path):
    sequence = by_name(read_tree(archive))["canyons/u_canyon"]
    shot = sequence.shots[1]
    assert {shot.raw.name, shot.clean.name, shot.depth.name} == {
        f"{shot.name}.tiff", f"{shot.name}_SeaErra.tiff", f"{shot.name}_SeaErra_abs_depth.tif",
    }  # fmt: skip
    assert shot.time == pytest.approx(int(shot.name) / 1e7)
    view = load(sequence, 1)
    np.testing.assert_array_equal((view.raw * 255).round().numpy(), tifffile.imread(shot.raw))
    np.testing.assert_array_equal((view.clean * 255).round().numpy(), tifffile.imread(shot.clean))
    np.testing.assert_array_equal(view.z_depth.numpy(), tifffile.imread(shot.depth))


def test_the_two_regions_have_their_own_calibrated_lens(archive: Path):
    found = by_name(read_tree(archive))
    canyon, red_sea = found["canyons/flatiron"].lens, found["red_sea/dice_path"].lens
    assert (canyon.model, len(canyon.distortion), canyon.K[0, 0]) == ("OPENCV", 4, 1175.3913431656817)
    assert (red_sea.model, red_sea.K[1, 1]) == ("PINHOLE", 1300.831316354508)
    half = found["red_sea/dice_path"].camera(484, 304)
    torch.testing.assert_close(half.K[0, 0, 0].item(), 1296.666758476217 / 2)


@pytest.mark.parametrize("name", ["{}_SeaErra_abs_depth.tif", "{}_abs_depth.tif", "{}.tif"])
def test_every_known_name_of_flseas_depth_is_found(tmp_path: Path, name: str):
    flsea_sequence(tmp_path / "canyons" / "flatiron", stamps(2), name)
    (sequence,) = read_tree(tmp_path).sequences
    assert all(shot.depth is not None for shot in sequence.shots)


def test_the_usual_depth_name_wins_over_the_others(tmp_path: Path):
    flsea_sequence(tmp_path / "canyons" / "flatiron", stamps(1))
    (stamp,) = stamps(1)
    tiff(tmp_path / "canyons" / "flatiron" / "depth" / f"{stamp}.tif", metres())
    survey = read_tree(tmp_path)
    assert survey.sequences[0].shots[0].depth.name == f"{stamp}_SeaErra_abs_depth.tif"
    assert [left.path.name for left in survey.skipped] == [f"{stamp}.tif"]


def test_depth_outside_the_trusted_range_is_unknown(tmp_path: Path):
    flsea_sequence(tmp_path / "canyons" / "flatiron", stamps(1))
    (stamp,) = stamps(1)
    values = metres()
    values[0, :4] = [0.04, 0.06, 20.5, np.nan]
    tiff(tmp_path / "canyons" / "flatiron" / "depth" / f"{stamp}_SeaErra_abs_depth.tif", values)
    (sequence,) = read_tree(tmp_path).sequences
    assert load(sequence, 0).z_depth[0, :4].tolist() == pytest.approx([0, 0.06, 0, 0])


def test_what_does_not_pair_is_reported_and_what_others_added_is_left_alone(tmp_path: Path):
    folder = tmp_path / "red_sea" / "pier_path"
    flsea_sequence(folder, stamps(3))
    first, second, third = stamps(3)
    (folder / "imgs" / f"{first}.tiff").unlink()
    (folder / "depth" / f"{second}_SeaErra_abs_depth.tif").unlink()
    (folder / "seaErra" / f"{third}_SeaErra.tiff").unlink()
    write_rgb(folder / "imgs" / f"{second}_skyMask.png", rgb())
    (folder / "imgs" / "train.csv").write_text("a\n")
    survey = read_tree(tmp_path)
    (sequence,) = survey.sequences
    assert [s.name for s in sequence.shots] == [str(second), str(third)]
    assert sequence.shots[0].depth is None
    assert sequence.shots[1].clean is None
    assert sorted(left.why for left in survey.skipped) == [
        "a depth map without an image", "a restored image without a raw one",
    ]  # fmt: skip
    told = describe(survey)
    assert "1 image without a depth map" in told
    assert "red_sea/pier_path: FLSea-VI, 2 shots (2 raw, 1 clean, 1 depth)" in told


def test_flsea_stereo_is_told_apart(tmp_path: Path):
    flsea_sequence(tmp_path / "Katzaa", stamps(1))
    flsea_sequence(tmp_path / "flatiron", stamps(1))
    survey = read_tree(tmp_path)
    assert [s.name for s in survey.sequences] == ["flatiron"]
    assert "FLSea-Stereo" in survey.skipped[0].why


def test_poses_of_a_colmap_model_made_on_the_restored_frames_are_read(tmp_path: Path):
    folder = tmp_path / "canyons" / "horse_canyon"
    flsea_sequence(folder, stamps(3))
    colmap_scene(folder / "sparse" / "0", [f"{s}_SeaErra.tiff" for s in stamps(3)])
    (sequence,) = read_tree(tmp_path).sequences
    assert [sequence.cam2world[str(s)][0, 3] for s in stamps(3)] == [0, 1, 2]
    assert not sequence.metric


@pytest.mark.shared
def test_real_frames_of_flsea_load_with_their_metric_depth(shared: Path):
    (sequence,) = read_tree(shared / "data" / "flsea_samples").sequences
    assert len(sequence) == 8
    view = load(sequence, 0)
    assert view.raw.shape == (608, 968, 3)
    assert 0.83 < (view.z_depth > 0).float().mean() < 0.84
    assert view.z_depth.max() == pytest.approx(9.746973, abs=1e-5)
    assert load(sequence, 5).z_depth.max() <= 20  # beyond 20 m the set's depth is not trusted


@pytest.mark.shared
def test_real_pairs_of_raw_and_restored_images_are_found(shared: Path):
    (sequence,) = read_tree(shared / "data" / "uieb_pairs").sequences
    assert len(sequence) == 9
    assert load(sequence, 3).clean.shape == load(sequence, 3).raw.shape


def test_sea_thru_of_kaggle_pairs_by_number_and_prefers_the_full_depth(tmp_path: Path):
    for number in (2951, 2955):
        write_rgb(tmp_path / "D1" / "D1" / "linearPNG" / f"T_S0{number}.png", rgb(bits=16))
        tiff(tmp_path / "D1" / "D1" / "depth" / f"depthT_S0{number}.tif", metres())
    write_rgb(tmp_path / "D3" / "D3" / "linearPNG" / "S03082.png", rgb())
    tiff(tmp_path / "D3" / "D3" / "depth_resized" / "depthT_S03082.tif", metres())
    tiff(tmp_path / "D3" / "D3" / "depth_resized" / "depthT_S03099.tif", metres())
    write_rgb(tmp_path / "D4" / "D4" / "linearPNG" / "T_S04857.png", rgb())
    for kind, value in (("depth", 2.0), ("depth_resized", 3.0)):
        tiff(tmp_path / "D4" / "D4" / kind / "depthT_S04857.tif", np.full((6, 8), value, np.float32))
    write_rgb(tmp_path / "D5" / "linearPNG" / "LFT_3375.png", rgb())
    tiff(tmp_path / "D5" / "depth" / "depthLFT_3375.tif", np.array([[0.5, 2.0], [29.0, 31.0]], np.float32))
    survey = read_tree(tmp_path)
    found = by_name(survey)
    assert {name: len(s) for name, s in found.items()} == {"D1": 2, "D3": 1, "D4": 1, "D5": 1}
    assert found["D1"].shots[1].depth.name == "depthT_S02955.tif"
    assert found["D3"].shots[0].depth.name == "depthT_S03082.tif"
    assert [left.path.name for left in survey.skipped] == ["depthT_S03099.tif"]
    assert load(found["D4"], 0).z_depth.unique().tolist() == [2.0]
    assert load(found["D5"], 0).z_depth[[0, 0, 5, 5], [0, 7, 0, 7]].tolist() == [0, 2, 29, 0]  # nearest, 1..30 m


def test_sea_thrus_linear_images_come_out_srgb_encoded(tmp_path: Path):
    image = rgb(bits=16)
    write_rgb(tmp_path / "D1" / "linearPNG" / "T_S02951.png", image)
    tiff(tmp_path / "D1" / "depth" / "depthT_S02951.tif", metres())
    (sequence,) = read_tree(tmp_path).sequences
    expected = srgb_from_linear(torch.from_numpy(image.astype(np.float32) / 65535))
    torch.testing.assert_close(load(sequence, 0).raw, expected)
    assert load(sequence, 0).clean is None


def test_sea_thru_of_the_authors_needs_its_raw_files_developed(tmp_path: Path):
    for scene in ("3148_3248", "D3"):
        raw = tmp_path / scene / "Raw" / "T_S03647.ARW"
        raw.parent.mkdir(parents=True)
        raw.write_bytes(b"raw")
        tiff(tmp_path / scene / "depthMaps" / "depthT_S03647.tif", metres())
    tiff(tmp_path / "3148_3248" / "tifs" / "T_S03647.tif", rgb(bits=16))
    survey = read_tree(tmp_path)
    assert [s.name for s in survey.sequences] == ["3148_3248"]
    assert any("gamma 1" in left.why for left in survey.skipped)
    tiff(tmp_path / "D3" / "T_S03647.tiff", rgb(bits=16))  # the other place where developed images lie
    survey = read_tree(tmp_path)
    assert [len(s) for s in survey.sequences] == [1, 1]
    assert survey.skipped == ()


@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0"])
def test_seathru_nerf_is_found_whatever_the_case_and_place(tmp_path: Path, place: str):
    names = [f"MTN_{k}.png" for k in range(1288, 1306)]
    scenes = {"Curasao": "images_wb", "IUI3-RedSea": "Images_wb", "JapaneseGradens-RedSea": "images_wb"}
    for scene, folder in scenes.items():
        for name in names:
            write_rgb(tmp_path / "SeathruNeRF_dataset" / scene / folder / name, rgb())
        colmap_scene(tmp_path / "SeathruNeRF_dataset" / scene / place, names)
    survey = read_tree(tmp_path)
    assert [s.name.split("/")[1] for s in survey.sequences] == list(scenes)
    for sequence in survey.sequences:
        assert sequence.kind == "SeaThru-NeRF"
        assert [i for i, s in enumerate(sequence.shots) if s.split == "test"] == [0, 8, 16]
        assert sequence.cam2world["MTN_1290"][0, 3] == 2


def test_an_undistorted_copy_is_a_scene_of_images_and_sparse(tmp_path: Path):
    for k in range(3):
        write_rgb(tmp_path / "SaltPond" / "images" / f"{k}.png", rgb())
    colmap_scene(tmp_path / "SaltPond" / "sparse", ["0.png", "1.png"])
    survey = read_tree(tmp_path)
    assert len(survey.sequences[0].cam2world) == 2
    assert [left.path.name for left in survey.skipped] == ["2.png"]


def test_a_synthetic_dive_brings_clear_images_exact_depth_and_poses(tmp_path: Path):
    write_dive(DiveSettings(frames=3, width=48, height=32, noise=0.0), tmp_path / "dive")
    (sequence,) = read_tree(tmp_path).sequences
    assert sequence.kind == "synthetic dive"
    assert sequence.metric
    assert len(sequence.cam2world) == 3
    view = load(sequence, 2)
    assert view.clean.shape == view.raw.shape == (32, 48, 3)
    assert (view.z_depth > 0).float().mean() > 0.9


def test_a_folder_of_triples_pairs_by_name_and_reads_every_kind_of_depth(tmp_path: Path):
    depth = metres()
    for name in ("a", "b", "c", "lonely"):
        write_rgb(tmp_path / "raw" / f"{name}.png", rgb())
    for name in ("a", "b", "c"):
        tiff(tmp_path / "clean" / f"{name}.tiff", rgb())
    tiff(tmp_path / "depth" / "a.tif", depth)
    tiff(tmp_path / "depth" / "b.tif", (1000 * depth).round().astype(np.uint16))
    np.savez(tmp_path / "depth" / "c.npz", z_depth=depth)
    survey = read_tree(tmp_path)
    (sequence,) = survey.sequences
    assert [s.name for s in sequence.shots] == ["a", "b", "c"]
    for i in range(3):
        np.testing.assert_allclose(load(sequence, i).z_depth.numpy(), depth, atol=5.1e-4)
    assert [left.path.name for left in survey.skipped] == ["lonely.png"]


def test_images_taken_in_air_are_clean_ones_without_raw(tmp_path: Path):
    write_rgb(tmp_path / "clean" / "a.png", rgb())
    tiff(tmp_path / "depth_mm" / "a.tif", (1000 * metres()).astype(np.uint16))
    view = load(read_tree(tmp_path).sequences[0], 0)
    assert view.raw is None
    assert view.clean is not None
    assert view.z_depth is not None


def test_a_pair_of_two_sizes_is_refused(tmp_path: Path):
    write_rgb(tmp_path / "raw" / "a.png", rgb(6, 8))
    write_rgb(tmp_path / "clean" / "a.png", rgb(3, 4))
    with pytest.raises(InputError, match="8x6"):
        load(read_tree(tmp_path).sequences[0], 0)


def test_a_folder_without_any_known_layout_says_which_are_known(tmp_path: Path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="known layout") as caught:
        read_tree(tmp_path)
    assert "FLSea-VI" in caught.value.hint
    with pytest.raises(InputError, match="no such folder"):
        read_tree(tmp_path / "nowhere")


def test_one_damaged_scene_does_not_hide_the_others(tmp_path: Path):
    for scene in ("good", "bad"):
        write_rgb(tmp_path / scene / "images" / "0.png", rgb())
        colmap_scene(tmp_path / scene / "sparse", ["0.png"])
    (tmp_path / "bad" / "sparse" / "images.bin").unlink()
    survey = read_tree(tmp_path)
    assert [s.name for s in survey.sequences] == ["good"]
    assert survey.skipped[0].path.name == "bad"


def test_a_image_of_depth_is_no_depth(tmp_path: Path):
    write_rgb(tmp_path / "depth.png", rgb()[..., :1].repeat(3, 2))
    with pytest.raises(InputError, match="8 bits"):
        read_depth(tmp_path / "depth.png")
    (tmp_path / "cut.tif").write_bytes(b"II*\x00abc")
    with pytest.raises(InputError, match="cannot be read"):
        read_depth(tmp_path / "cut.tif")
