"""Lenses behind ports, and fisheyes, against the truth.

    python benchmarks/lenses.py errors              error of the central lens of a port by distance
    python benchmarks/lenses.py bending             bending of level ground under a flat port, 0.5 to 5 m above it
    python benchmarks/lenses.py dive OUT [--kind flat --path loop --treat flat] [--refine]   poses and depth of a dive

`bending` adjusts a straight line of nadir views of rough level ground, whose observations are traced exactly through
the port and have 0.2 px of noise. Bending is the rise of the paraboloid that fits the errors of height best, from the
middle to the ends of the line, in percent of its length. A `dive` is rendered through the port or the fisheye, and
reconstructed with the lens in air known and held (`flat`, `dome`, `fisheye`), or with an unknown one (`none`).
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from swimm3r.cameras import Cameras, project_visible
from swimm3r.geometry import align_similarity
from swimm3r.pipeline.presets import PRESETS
from swimm3r.pipeline.scores.truth import truth_section
from swimm3r.prepare import read_frames
from swimm3r.progress import silent
from swimm3r.refraction.central import CameraInWater, camera_in_water
from swimm3r.refraction.ports import DomePort, FlatPort, Port
from swimm3r.refraction.settings import PortSettings
from swimm3r.scene.ground_truth import GroundTruth, read_ground_truth
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm import reconstruct
from swimm3r.sfm.colmap.adjustment import adjust_through_port, bundle_adjust
from swimm3r.sfm.settings import ColmapSettings
from swimm3r.synthetic.dive import write_dive
from swimm3r.synthetic.optics import lens_of
from swimm3r.synthetic.settings import DiveSettings

WIDTH, HEIGHT = 480, 320
PORTS: dict[str, Port] = {
    "flat, 1 cm away, 3 mm": FlatPort(0.01, 0.003, 1.49, 1.333),
    "flat, 5 cm away, 10 mm": FlatPort(0.05, 0.01, 1.49, 1.333),
    "dome of 5 cm, centered": DomePort(0.05, 0.005, 0.05, 1.49, 1.333),
    "dome of 5 cm, 1 cm too far": DomePort(0.06, 0.005, 0.05, 1.49, 1.333),
}
SETTINGS = {
    "flat": PortSettings(distance=0.05, thickness=0.01),
    "dome": PortSettings(distance=0.06, radius=0.05, thickness=0.005),
}
NOISE = 0.2  # px


def lens(field: float) -> Cameras:
    """A pinhole in air of a horizontal field of view in degrees."""
    return lens_of(DiveSettings(width=WIDTH, height=HEIGHT, fov=field))


def print_errors() -> None:
    """The table of the central lens's error, in pixels of frames 480 wide: root mean square, and largest."""
    distances = torch.tensor([0.3, 0.5, 1.0, 1.5, 3.0, 5.0])
    print("| field in air | port | " + " | ".join(f"{z:g} m" for z in distances.tolist()) + " |")
    for field in (56.0, 90.0):
        for name, port in PORTS.items():
            errors = camera_in_water(lens(field), port, 1.5).errors(distances)
            print(f"| {field:g} | {name} | " + " | ".join(f"{e.rms:.2f} ({e.largest:.2f})" for e in errors) + " |")


def line_over_ground(housed: CameraInWater, altitude: float, folder: Path) -> Reconstruction:
    """A line of 13 nadir views at a height, and points of the ground with exact tracks."""
    rng = torch.Generator().manual_seed(0)
    swath = altitude * housed.central.width / float(housed.central.K[0, 0, 0])
    count, step = 13, 0.25 * swath
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    poses[:, 0, 3] = step * torch.arange(count)
    poses[:, 1, 3] = 0.03 * altitude * torch.randn(count, generator=rng).double()
    cameras = replace(
        housed.central,
        K=housed.central.K.repeat(count, 1, 1),
        distortion=housed.central.distortion.repeat(count, 1),
        cam2world=poses,
    )
    xyz = torch.rand(3000, 3, generator=rng, dtype=torch.float64)
    low, high = torch.tensor([-0.5 * swath, -0.35 * swath]), torch.tensor([count * step + 0.2 * swath, 0.35 * swath])
    xyz[:, :2] = low + xyz[:, :2] * (high - low)
    xyz[:, 2] = altitude * (1 + 0.1 * (xyz[:, 2] - 0.5))
    pixels, z, seen = project_visible(cameras, xyz.expand(count, -1, -1))
    frame, point = torch.nonzero(seen).unbind(-1)
    exact = traced(housed, pixels[frame, point], z[frame, point])
    xy = exact + NOISE * torch.randn(exact.shape, generator=rng).double()
    often = torch.bincount(point, minlength=len(xyz))[point] >= 3
    kept, point = torch.unique(point[often], return_inverse=True)
    colors, none = torch.full((len(kept), 3), 0.5), torch.zeros(0, dtype=torch.int64)
    nowhere = torch.zeros(0, 2)
    return Reconstruction(
        names=tuple(f"{i:04d}.png" for i in range(count)),
        cameras=cameras,
        points=Points(xyz[kept], colors, torch.zeros(len(kept), dtype=torch.float64)),
        tracks=Tracks(point, frame[often], xy[often]),
        matches=Matches(none, none, nowhere, nowhere, torch.zeros(0)),
        depth=DepthMaps(folder),
        backend="colmap",
    )


def traced(housed: CameraInWater, central: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """The pixels whose exact rays meet the points that the central lens has at pixels and depths."""
    pixels = central.clone()
    for _ in range(20):
        pixels = central - housed.shift(pixels, z)
    return pixels


def bending(found: Reconstruction, true: Reconstruction) -> float:
    """Rise of the errors of height over the ground's length, in percent of it."""
    onto = align_similarity(found.points.xyz.double(), true.points.xyz.double())
    x, y = true.points.xyz[:, :2].numpy().T
    half = float(np.ptp(x)) / 2
    x, y = (x - x.mean()) / half, (y - y.mean()) / half
    height = (onto.points(found.points.xyz.double()) - true.points.xyz)[:, 2].numpy()
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    return 100 * abs(float(np.linalg.lstsq(terms, height, rcond=None)[0][3])) / (2 * half)


def self_calibrated(rec: Reconstruction, focal: float) -> Reconstruction:
    """Poses and lens adjusted from a pinhole of the paraxial focal length, as without knowledge of the port."""
    K = rec.cameras.K.clone()
    K[:, [0, 1], [0, 1]] = focal
    cameras = replace(rec.cameras, K=K, distortion=torch.zeros_like(rec.cameras.distortion))
    rec = replace(rec, cameras=cameras)
    for _ in range(6):
        rec = replace(bundle_adjust(rec, lens=True), tracks=rec.tracks)
    return rec


def print_bending() -> None:
    """Bending of the ground in percent of its length, by altitude and treatment."""
    print(
        "| port | altitude | exact refraction | exact, distance given 30 % too large | central lens for 1.5 m |"
        " none, lens refined | none, 1.333 f held |"
    )
    for name in list(PORTS)[:2]:
        for altitude in (0.5, 1.0, 2.0, 5.0):
            housed = camera_in_water(lens(56.0), PORTS[name], 1.5)
            with TemporaryDirectory() as folder:
                true = line_over_ground(housed, altitude, Path(folder))
                focal = 1.333 * float(lens(56.0).K[0, 0, 0])
                held = replace(true.cameras, distortion=torch.zeros_like(true.cameras.distortion))
                held.K[:, [0, 1], [0, 1]] = focal
                away = altitude - housed.outside
                found = [
                    adjust_through_port(true, housed, away, lens=False),
                    adjust_through_port(true, housed, 1.3 * away, lens=False),
                    bundle_adjust(true),
                    self_calibrated(true, focal),
                    bundle_adjust(replace(true, cameras=held)),
                ]
            print(f"| {name} | {altitude:g} m | " + " | ".join(f"{bending(rec, true):.3f} %" for rec in found) + " |")


def dive_settings(kind: str, path: str) -> DiveSettings:
    """A dive of about two dozen frames through a lens of a kind."""
    dive = DiveSettings(frames=28, width=WIDTH, height=HEIGHT, seed=3)
    if path == "transect":
        dive = replace(dive, path="transect", length=3.0, speed=0.3, fps=2.5)
    if kind == "fisheye":
        return replace(dive, fisheye=True, fov=150)
    return replace(dive, housing=kind, port=SETTINGS[kind])


def run_dive(out: Path, kind: str, path: str, treat: str, refine: bool) -> None:
    """Render, reconstruct and compare with the truth."""
    dive = dive_settings(kind, path)
    folder = out / f"{kind}-{path}"
    write_dive(dive, folder)
    frames = read_frames(folder, folder=out / f"{kind}-{path}-frames", progress=silent)
    sfm = PRESETS["fast"].sfm
    assert isinstance(sfm, ColmapSettings)
    focal, intrinsics = float(lens_of(dive).K[0, 0, 0]), "prior" if refine else "fixed"
    if treat == "fisheye":
        sfm = replace(sfm, focal=focal, camera="OPENCV_FISHEYE", intrinsics=intrinsics)
    elif treat != "none":
        sfm = replace(sfm, focal=focal, housing=treat, port=SETTINGS[treat], intrinsics=intrinsics)
    rec = reconstruct(frames, sfm, out / f"{kind}-{path}-{treat}{'-refined' * refine}", progress=silent)
    truth = read_ground_truth(folder / "truth")
    section = truth_section(rec, frames, truth)
    said = ("rotation_deg", "rotation_median_deg", "translation_deg", "ate", "depth_absrel", "depth_coverage")
    print(f"{len(rec.names)} of {len(frames.train)} frames; " + ", ".join(f"{key} {section[key]:.4g}" for key in said))
    for low, high, share, error in by_radius(rec, truth):
        print(f"{low:.2f} to {high:.2f} of the half diagonal: depth of {share:.1%} of the pixels, AbsRel {error:.2%}")


def by_radius(rec: Reconstruction, truth: GroundTruth) -> list[tuple[float, float, float, float]]:
    """From and to a share of the half diagonal: share of the pixels with depth, and its mean relative error."""
    rows = [truth.names.index(name) for name in rec.names]
    scale = float(align_similarity(rec.cameras.centers.double(), truth.cameras.centers[rows].double()).scale)
    y, x = np.mgrid[: rec.cameras.height, : rec.cameras.width] + 0.5
    half = math.hypot(rec.cameras.width, rec.cameras.height) / 2
    radius = np.hypot(x - rec.cameras.width / 2, y - rec.cameras.height / 2) / half
    found = []
    for low, high in ((0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 0.9), (0.9, 1.0)):
        ring, counted, errors = (radius >= low) & (radius < high), 0, []
        for name in rec.names:
            true = truth.z_depth(name)
            assert true is not None
            z, here = scale * rec.depth[name].z_depth.numpy(), ring & (true.numpy() > 0)
            counted += int(here.sum())
            known = here & (z > 0)
            errors.append(np.abs(z[known] / true.numpy()[known] - 1))
        off = np.concatenate(errors)
        found.append((low, high, len(off) / max(counted, 1), float(off.mean()) if len(off) else math.nan))
    return found


def main() -> None:
    """The table that the command names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("errors", "bending", "dive"))
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/lenses"))
    parser.add_argument("--kind", choices=("flat", "dome", "fisheye"), default="flat")
    parser.add_argument("--path", choices=("loop", "transect"), default="loop")
    parser.add_argument("--treat", choices=("none", "flat", "dome", "fisheye"), default="none")
    parser.add_argument("--refine", action="store_true", help="refine the known lens")
    given = parser.parse_args()
    match given.table:
        case "errors":
            print_errors()
        case "bending":
            print_bending()
        case _:
            run_dive(given.out, given.kind, given.path, given.treat, given.refine)


if __name__ == "__main__":
    main()
