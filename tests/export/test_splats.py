"""Splat files hold the map's Gaussians, by readers of others: plyfile, gsply and PlayCanvas's splat-transform."""

import os
import shutil
import subprocess
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
from plyfile import PlyData
from tests.export.conftest import BALANCE

from swimm3r.devices import torch_threads
from swimm3r.errors import DeviceError, InputError, UsageError
from swimm3r.export import export_run
from swimm3r.export.formats import splat_file, spz
from swimm3r.export.gaussians import draw_gaussians
from swimm3r.export.settings import (
    FORMATS,
    CompressedPlySettings,
    ExportSettings,
    FormatName,
    SplatFileSettings,
    SplatPlySettings,
    SpzSettings,
)
from swimm3r.export.splats import SplatArrays, SplatSettings, arrays_of, gaussians_of, open_map
from swimm3r.pipeline.renders import display_style
from swimm3r.scene.reconstruction_io import load_reconstruction

SPLATS: tuple[FormatName, ...] = ("ply", "compressed-ply", "splat", "spz")
# median share of the size of a Gaussian's covariance that its rounding may change, and largest error of position in
# shares of the scene, of color and of opacity, each by the bits that the format has
ROUNDING = {
    "ply": (1e-5, 1e-6, 1e-5, 1e-5),
    "compressed-ply": (0.01, 2e-3, 0.03, 0.005),
    "splat": (0.03, 1e-6, 0.008, 0.003),
    "spz": (0.08, 1e-4, 0.009, 0.003),
}
C0 = 0.28209479177387814


def expected(run: Path, settings: ExportSettings) -> SplatArrays:
    """The numbers that the file should hold, before any rounding."""
    assert isinstance(settings, SplatSettings)
    return open_map(run, settings).arrays()


def covariances(log_scale: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """By the usual formula, written out: R S S^T R^T, quaternions w, x, y, z."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)).astype(np.float64).T
    R = np.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ], -1,
    ).reshape(-1, 3, 3)  # fmt: skip
    M = R * np.exp(log_scale)[:, None]
    return M @ M.transpose(0, 2, 1)


def check(found: SplatArrays, wanted: SplatArrays, rounding: tuple[float, float, float, float]) -> None:
    """The same Gaussians in any order, within the rounding of the format."""
    shape, position, color, opacity = rounding
    extent = float(np.ptp(wanted.xyz, axis=0).max())
    distance = np.linalg.norm(found.xyz[:, None] - wanted.xyz[None], axis=-1)
    mine = distance.argmin(1)
    assert sorted(mine) == list(range(len(wanted.xyz)))
    assert distance.min(1).max() <= position * extent
    C, D = covariances(found.log_scale, found.quaternion), covariances(wanted.log_scale, wanted.quaternion)[mine]
    assert np.median(np.linalg.norm(C - D, axis=(1, 2)) / np.linalg.norm(D, axis=(1, 2))) <= shape
    in_range = np.abs(0.5 + C0 * wanted.color[mine] - 0.5).max(-1) < 0.5  # .splat clips what lies beyond
    assert in_range.mean() > 0.8
    assert C0 * np.abs(found.color - wanted.color[mine])[in_range].max() <= color
    alpha, beta = (1 / (1 + np.exp(-logit)) for logit in (found.logit, wanted.logit[mine]))
    assert np.abs(alpha - beta).max() <= opacity
    if found.harmonics.shape[1]:
        assert np.abs(found.harmonics - wanted.harmonics[mine]).max() <= 0.02


def read_by_plyfile(path: Path) -> SplatArrays:
    """A 3DGS file by its property names, as the paper's own loader takes it."""
    vertices = PlyData.read(path)["vertex"]
    names = [each.name for each in vertices.properties]

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([np.asarray(vertices[name], np.float32) for name in wanted], -1)

    rest = [name for name in names if name.startswith("f_rest_")]
    known = len(rest) // 3
    none = np.zeros((len(vertices.data), 0), np.float32)
    harmonics = columns(*[f"f_rest_{k}" for k in range(len(rest))]) if rest else none
    return SplatArrays(
        columns("x", "y", "z"),
        columns("scale_0", "scale_1", "scale_2"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("opacity")[:, 0],
        columns("f_dc_0", "f_dc_1", "f_dc_2"),
        harmonics.reshape(len(harmonics), 3, known).transpose(0, 2, 1),
    )


def by_splat_transform(path: Path, folder: Path) -> SplatArrays:
    """Any splat file as PlayCanvas's converter reads it, by way of a PLY file that it writes.

    Needs Node and the npm package @playcanvas/splat-transform in the folder $SWIMM3R_NODE_MODULES.
    """
    modules, node = os.environ.get("SWIMM3R_NODE_MODULES"), shutil.which("node")
    tool = Path(modules or "") / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    if not modules or node is None or not tool.is_file():
        pytest.skip("splat-transform is not installed ($SWIMM3R_NODE_MODULES): files were not read by it")
    out = folder / "converted.ply"
    subprocess.run([node, str(tool), "-w", str(path), str(out)], check=True, capture_output=True, timeout=120)
    return read_by_plyfile(out)


def by_gsply(path: Path) -> SplatArrays:
    data = gsply.read_spz(path) if path.suffix == ".spz" else gsply.plyread(path)
    harmonics = np.zeros((len(data.means), 0, 3)) if data.shN is None else data.shN
    fields = (data.means, data.scales, data.quats, data.opacities, data.sh0, harmonics)
    return SplatArrays(*(np.asarray(values, np.float32) for values in fields))


@pytest.mark.parametrize("run", ["wall_run", "harmonic_run"])
def test_a_ply_file_is_read_alike_by_plyfile_and_gsply(run: str, request, tmp_path: Path):
    folder: Path = request.getfixturevalue(run)
    export_run(folder, tmp_path / "g.ply")
    wanted = expected(folder, SplatPlySettings())
    for read in (read_by_plyfile, by_gsply):
        found = read(tmp_path / "g.ply")
        known = wanted.harmonics.shape[1]
        assert not found.harmonics[:, known:].any()
        check(SplatArrays(**{**vars(found), "harmonics": found.harmonics[:, :known]}), wanted, ROUNDING["ply"])


@pytest.mark.parametrize("run", ["wall_run", "harmonic_run"])
@pytest.mark.parametrize("format", SPLATS)
def test_every_splat_file_is_read_by_splat_transform(format: FormatName, run: str, request, tmp_path: Path):
    folder: Path = request.getfixturevalue(run)
    path = tmp_path / Path(FORMATS[format].file_name).name
    export_run(folder, path, FORMATS[format])
    wanted = expected(folder, FORMATS[format])
    found = by_splat_transform(path, tmp_path)
    has_harmonics = wanted.harmonics.shape[1] and format != "splat"
    known = wanted.harmonics.shape[1] if has_harmonics else 0
    assert found.harmonics.shape[1] >= known
    found = SplatArrays(**{**vars(found), "harmonics": found.harmonics[:, :known]})
    check(found, wanted, ROUNDING[format])


@pytest.mark.parametrize("settings", [CompressedPlySettings(), SpzSettings()], ids=["compressed-ply", "spz"])
def test_what_gsply_packs_comes_back_in_the_axes_of_the_run(settings, harmonic_run: Path, tmp_path: Path):
    path = tmp_path / Path(settings.file_name).name
    export_run(harmonic_run, path, settings)
    found = by_gsply(path)
    if isinstance(settings, SpzSettings):
        assert path.read_bytes()[:2] == b"\x1f\x8b"
        found = spz.turned(found)  # the file's y is up
        name = "spz"
    else:
        name = "compressed-ply"
    check(found, expected(harmonic_run, settings), ROUNDING[name])


def test_a_splat_file_has_records_of_32_bytes_largest_first(wall_run: Path, tmp_path: Path):
    export_run(wall_run, tmp_path / "g.splat", SplatFileSettings())
    data, wanted = (tmp_path / "g.splat").read_bytes(), expected(wall_run, SplatFileSettings())
    assert len(data) == 32 * len(wanted.xyz)
    floats = np.frombuffer(data, "<f4").reshape(-1, 8)
    octets = np.frombuffer(data, np.uint8).reshape(-1, 32)
    weight = floats[:, 3:6].prod(-1) * octets[:, 27]
    assert (np.diff(weight) <= 1e-2 * weight[:-1]).all()  # opacity is rounded
    alpha = octets[:, 27].clip(1, 254) / 255
    found = SplatArrays(
        floats[:, :3], np.log(floats[:, 3:6]), (octets[:, 28:32].astype(np.float32) - 128) / 128,
        np.log(alpha / (1 - alpha)).astype(np.float32),
        ((octets[:, 24:27] / 255 - 0.5) / C0).astype(np.float32), np.zeros((len(floats), 0, 3), np.float32),
    )  # fmt: skip
    check(found, wanted, ROUNDING["splat"])


def test_turned_gaussians_look_the_same_to_a_turned_eye(harmonic_run: Path):
    """Colors of 3DGS's harmonics of degree 3 in a direction, before and after half a turn about x."""
    g = arrays_of(open_map(harmonic_run, SplatPlySettings()).gaussians)
    turn, d = np.diag([1.0, -1, -1]), np.array([0.48, -0.6, 0.64])

    def basis(x: float, y: float, z: float) -> np.ndarray:
        """As 3DGS writes them down, without constants: each has one parity."""
        return np.array([
            -y, z, -x, x * y, -y * z, 2 * z * z - x * x - y * y, -x * z, x * x - y * y,
            -y * (3 * x * x - y * y), x * y * z, -y * (4 * z * z - x * x - y * y),
            z * (2 * z * z - 3 * x * x - 3 * y * y), -x * (4 * z * z - x * x - y * y), z * (x * x - y * y),
            -x * (x * x - 3 * y * y),
        ])  # fmt: skip

    before = np.einsum("k,nkc->nc", basis(*d), g.harmonics)
    after = np.einsum("k,nkc->nc", basis(*(turn @ d)), spz.turned(g).harmonics)
    np.testing.assert_allclose(after, before, atol=1e-6)
    C, D = (covariances(each.log_scale, each.quaternion) for each in (g, spz.turned(g)))
    np.testing.assert_allclose(turn @ C @ turn, D, atol=1e-9)


def test_arrays_say_the_gaussians_they_were_made_of(harmonic_run: Path):
    g = open_map(harmonic_run, SplatPlySettings()).gaussians
    for name, values in vars(gaussians_of(arrays_of(g))).items():
        torch.testing.assert_close(values, getattr(g, name), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("run", ["wall_run", "harmonic_run"])
def test_shown_colors_are_the_physical_ones_times_the_gains_of_the_dive(run: str, request, tmp_path: Path):
    folder: Path = request.getfixturevalue(run)
    for colors in ("shown", "physical"):
        export_run(folder, tmp_path / f"{colors}.ply", SplatPlySettings(colors=colors))
    shown, physical = (read_by_plyfile(tmp_path / f"{colors}.ply") for colors in ("shown", "physical"))
    gains = np.array(BALANCE.gains)
    np.testing.assert_allclose(0.5 + C0 * shown.color, gains * (0.5 + C0 * physical.color), atol=1e-5)
    np.testing.assert_allclose(shown.harmonics, gains * physical.harmonics, atol=1e-5)
    assert (shown.xyz == physical.xyz).all()
    assert SplatPlySettings(colors="physical").file_name == "splat/gaussians_physical.ply"


@pytest.mark.parametrize("run", ["wall_run", "harmonic_run"])
def test_a_splat_drawn_by_a_3dgs_viewer_has_the_mean_color_of_the_maps_clear_views(run: str, request, tmp_path: Path):
    """The gray-world check: balanced as the restored frames are, within 5 %."""
    folder: Path = request.getfixturevalue(run)
    export_run(folder, tmp_path / "g.ply")
    found = open_map(folder, SplatPlySettings())
    drawn_from = gaussians_of(read_by_plyfile(tmp_path / "g.ply"))
    rec = load_reconstruction(folder / "sfm")
    style = display_style(found.scene, rec)
    assert style.gains.tolist() == pytest.approx(BALANCE.gains)
    theirs, own = [], []
    for i in range(len(rec.cameras)):
        view = rec.cameras[i].pinhole()
        drawn, shown = draw_gaussians(drawn_from, view, 0.01), found.scene.render(view)
        covered = (drawn.alpha > 0.95) & (shown.alpha > 0.95)
        theirs.append(drawn.clear.permute(1, 2, 0)[covered])
        own.append((shown.clear * style.gains)[covered])
    a, b = (torch.cat(values).mean(0) for values in (theirs, own))
    assert (a / b - 1).abs().max() < 0.05
    assert (a / b * torch.tensor(BALANCE.gains) - 1).abs().max() > 0.15  # without the balance it would not be


@pytest.mark.parametrize("format", SPLATS)
def test_what_is_lost_is_measured_on_the_file(format: FormatName, harmonic_run: Path, tmp_path: Path):
    done = export_run(harmonic_run, tmp_path / "file", FORMATS[format])
    psnr = float(done.loss.split(":")[1].split()[0])
    assert {"ply": 60, "compressed-ply": 30, "splat": 20, "spz": 30}[format] < psnr
    assert psnr < {"ply": 1000, "compressed-ply": 60, "splat": 50, "spz": 60}[format]
    assert f"{len(expected(harmonic_run, FORMATS[format]).xyz)} Gaussians of 400 primitives" in str(done)


@pytest.mark.parametrize("format", SPLATS)
def test_its_own_kind_is_replaced_and_another_is_not(format: FormatName, wall_run: Path, tmp_path: Path):
    path = tmp_path / "file"
    for _ in range(2):
        export_run(wall_run, path, FORMATS[format])
    path.write_text("notes of mine, of no length that any format has")
    with pytest.raises(UsageError, match="exists and is no"):
        export_run(wall_run, path, FORMATS[format])
    assert path.read_text().startswith("notes")


@pytest.mark.parametrize("format", SPLATS)
def test_without_a_map_the_message_says_so(format: FormatName, sfm_run: Path, tmp_path: Path):
    with pytest.raises(InputError, match="finished map"):
        export_run(sfm_run, tmp_path / "file", FORMATS[format])
    assert not (tmp_path / "file").exists()


@pytest.mark.parametrize("format", ["compressed-ply", "spz"])
def test_a_missing_package_is_named_with_what_installs_it(format, wall_run: Path, tmp_path: Path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsply", None)
    with pytest.raises(DeviceError) as refused:
        export_run(wall_run, tmp_path / "file", FORMATS[format])
    assert "swimm3r[export]" in refused.value.hint


def test_opacities_at_both_ends_survive_the_splat_file():
    ends = np.array([-12.0, 12.0], np.float32)
    arrays = SplatArrays(
        np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32), np.eye(4, dtype=np.float32)[:2], ends,
        np.zeros((2, 3), np.float32), np.zeros((2, 0, 3), np.float32),
    )  # fmt: skip
    back = splat_file.unpacked(splat_file.packed(arrays))
    assert np.isfinite(back.logit).all()
    assert back.logit[0] > 5
    assert back.logit[1] < -5


@pytest.mark.parametrize("settings", [CompressedPlySettings(), SpzSettings()])
def test_an_export_leaves_torch_its_threads(wall_run: Path, tmp_path: Path, settings: ExportSettings):
    """gsply's parallel kernels set OpenMP's number, which is torch's, too; other threads mean other roundings."""
    with torch_threads(3):
        export_run(wall_run, tmp_path / "map", settings)
        assert torch.get_num_threads() == 3
