"""The elevation map of a run against depth maps of another program.

    python benchmarks/maps/reference.py RUN REFERENCE

RUN has products. REFERENCE holds reference_cameras.json (openMVG's pinhole with k1, k2, p1, p2, k3; c2w in metres) and
depth_mm/NAME.png, millimetres along the optical axis. The reference is laid over the run by its camera centers, with
the run's own scale and with the scale that fits, and its depth maps are drawn from above like the run's own.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import torch

from swimm3r.geometry import align_similarity
from swimm3r.products.depth_surface import seen_from_above
from swimm3r.products.geotiff import StoredMap
from swimm3r.products.grid import Grid, Window
from swimm3r.products.record import FOLDER, read_record
from swimm3r.products.survey import SurfacePoints, open_survey


def reference_points(folder: Path) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Name, camera center, points and depth of each frame of the reference, metres."""
    told = json.loads((folder / "reference_cameras.json").read_text(encoding="utf-8"))
    K = np.array([[told["fx"], 0, told["cx"]], [0, told["fy"], told["cy"]], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(told["width"]) + 0.5, np.arange(told["height"]) + 0.5)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, K, np.array(told["dist_k1_k2_p1_p2_k3"])).reshape(*u.shape, 2)
    rays = np.concatenate([straight, np.ones((*u.shape, 1))], -1)
    found = []
    for frame in told["frames"]:
        stem, pose = Path(frame["name"]).stem, np.array(frame["c2w"])
        stored = cv2.imread(str(folder / "depth_mm" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        z = np.zeros(u.shape) if stored is None else stored / 1000.0
        found.append((stem, pose[:3, 3], (rays * z[..., None]) @ pose[:3, :3].T + pose[:3, 3], z))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("reference", type=Path)
    given = parser.parse_args()
    survey, record = open_survey(given.run), read_record(given.run / FOLDER)
    if record is None:
        raise SystemExit(f"swimm3r products {given.run} first")
    g, origin = survey.place.grid_scale, survey.place.origin
    corner = (record.west - origin[0]) / g, (record.north - origin[1]) / g
    grid = Grid(*corner, record.gsd / g, record.rows, record.columns)
    with StoredMap(given.run / FOLDER / "elevation.tif") as stored:
        height = stored.read().astype(np.float64) - origin[2]
    frames = reference_points(given.reference)
    index = {Path(name).stem: i for i, name in enumerate(survey.rec.names)}
    common = [(index[stem], center) for stem, center, _, _ in frames if stem in index]
    own = torch.from_numpy(survey.centers[[i for i, _ in common]])
    other = torch.from_numpy(np.stack([center for _, center in common]))
    fit = align_similarity(other, own)
    away = (fit.points(other) - own).norm(dim=1)
    print(f"{len(common)} cameras, {1e3 * float(away.pow(2).mean().sqrt()):.1f} mm rms; scale {float(fit.scale):.4f}")
    distance = float(np.median(np.concatenate([z[z > 0][::97] for *_, z in frames])))
    for told, scale in (("scale that fits", float(fit.scale)), ("scale of the run", 1.0)):
        R = fit.R.numpy()
        shift = own.mean(0).numpy() - scale * R @ other.mean(0).numpy()
        layers = []
        for _, _, xyz, z in frames:
            points = SurfacePoints(scale * xyz @ R.T + shift, z, np.ones_like(z), z > 0)
            layers.append(seen_from_above(points, grid, Window(0, 0, grid.rows, grid.columns), survey.footprint)[0])
        heights = np.stack(layers)
        common_cells = ~np.isnan(height) & ~np.isnan(heights).all(0)
        error = height[common_cells] - np.nanmedian(heights[:, common_cells], 0)
        median = float(np.median(np.abs(error)))
        print(
            f"{told}: median {1e3 * median:.1f} mm = {median / distance:.2%} of the range, 90 %"
            f" {1e3 * float(np.quantile(np.abs(error), 0.9)):.1f} mm, bias {1e3 * float(np.median(error)):+.1f} mm,"
            f" {len(error):,} cells"
        )


if __name__ == "__main__":
    main()
