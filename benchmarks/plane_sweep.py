"""Accuracy and speed of the plane sweep on clips of known depth; images of its depth maps on any clip.

    python benchmarks/plane_sweep.py CLIP [CLIP ...] [--every N] [--frames N] [--out DIR] [--set min_ncc=0.5 ...]

CLIP is a folder with images/ and one of: truth/ (a synthetic dive), depth_mm/ with cameras.json or
reference_cameras.json, or sparse/0 (a COLMAP model, then nothing is scored). Printed per clip: CPU and wall-clock
seconds per frame, the share of pixels with true depth that are kept, the median and mean relative error on them, the
share beyond 5 %, and the share of pixels without a surface (open water) that were given one. --water goes on to the
restored cloud and images and prints the CPU seconds of that. Kernels are compiled before the clock starts where they
are in Numba's cache.
"""

import argparse
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from swimm3r.cameras import cameras_of, project, unproject
from swimm3r.io import cameras_json, images
from swimm3r.io.colmap import model as colmap
from swimm3r.scene.frames import Frame, Frames
from swimm3r.scene.reconstruction import DepthMaps, Matches, Points, Reconstruction, Tracks
from swimm3r.sfm.medium.apply import with_water
from swimm3r.sfm.plane_sweep.estimate import estimate_depth
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.settings import ColmapSettings


def frames_of(clip: Path, names: tuple[str, ...]) -> Frames:
    """The images of a clip under their own names."""
    frames = tuple(Frame(name, clip / "images" / name, float(k), 0.0, "train") for k, name in enumerate(names))
    height, width = images.read_rgb(frames[0].path).shape[:2]
    return Frames(frames, width, height, ordered=True)


def true_depth(clip: Path, name: str) -> np.ndarray | None:
    """z depth in the units of the poses, 0 where unknown."""
    if (clip / "truth").is_dir():
        with np.load(clip / "truth" / "z_depth" / f"{name}.npz") as stored:
            return stored["z_depth"].astype(np.float64)
    if (clip / "depth_mm").is_dir():
        path = clip / "depth_mm" / Path(name).with_suffix(".png").name
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        return None if stored is None else stored / 1000.0
    return None


def sampled_reconstruction(clip: Path, table: cameras_json.CameraTable, per_frame: int = 400) -> Reconstruction:
    """True poses with sparse points taken from the true depth, seen by every frame whose depth agrees with them."""
    cameras = cameras_of(table)
    rng = np.random.default_rng(0)
    depths = [known for name in table.names if (known := true_depth(clip, name)) is not None]
    if len(depths) != len(table.names):
        raise ValueError(f"{clip} has frames without true depth")
    points, track_point, track_frame, track_xy = [], [], [], []
    for i, depth in enumerate(depths):
        rows, columns = np.nonzero(depth)
        pick = rng.choice(len(rows), min(per_frame, len(rows)), replace=False)
        xy = torch.from_numpy(np.stack([columns[pick], rows[pick]], -1) + 0.5)[None]
        xyz = unproject(cameras[i], xy, torch.from_numpy(depth[rows[pick], columns[pick]])[None])[0]
        pixels, z = project(cameras, xyz.expand(len(cameras), -1, -1))
        for j, other in enumerate(depths):
            at = pixels[j].floor().long().numpy()
            ok = (z[j].numpy() > 0) & (at >= 0).all(-1) & (at < (table.width, table.height)).all(-1)
            seen = np.nonzero(ok)[0]
            expected = other[at[seen, 1], at[seen, 0]]
            seen = seen[np.abs(expected - z[j].numpy()[seen]) < 0.02 * z[j].numpy()[seen]]
            track_point.append(seen + sum(map(len, points)))
            track_frame.append(np.full(len(seen), j))
            track_xy.append(pixels[j].numpy()[seen])
        points.append(xyz.numpy())
    xyz = np.concatenate(points)
    return Reconstruction(
        table.names,
        cameras,
        Points(torch.from_numpy(xyz), torch.zeros(len(xyz), 3), torch.zeros(len(xyz))),
        Tracks(*(torch.from_numpy(np.concatenate(a)) for a in (track_point, track_frame, track_xy))),
        no_matches(),
        DepthMaps(Path()),
        "truth",
    )


def no_matches() -> Matches:
    """Matches of a reconstruction that has none."""
    frame, pixel = torch.zeros(0, dtype=torch.long), torch.zeros(0, 2)
    return Matches(frame, frame, pixel, pixel, torch.zeros(0))


def colmap_reconstruction(folder: Path) -> Reconstruction:
    """A COLMAP model on disk."""
    sparse = colmap.read_model(folder)
    return Reconstruction(
        sparse.names,
        cameras_of(sparse),
        Points(
            torch.from_numpy(sparse.xyz), torch.from_numpy(sparse.rgb / 255).float(), torch.from_numpy(sparse.error)
        ),
        Tracks(*(torch.from_numpy(a) for a in (sparse.track_point, sparse.track_frame, sparse.track_xy))),
        no_matches(),
        DepthMaps(Path()),
        "colmap",
    )


def read_clip(clip: Path, every: int, count: int | None) -> Reconstruction:
    """Poses and sparse points of every n-th frame of a clip."""
    for path in (clip / "truth" / "cameras.json", clip / "reference_cameras.json", clip / "cameras.json"):
        if path.is_file():
            table = cameras_json.read_cameras(path)
            keep = [k for k, name in enumerate(table.names) if true_depth(clip, name) is not None][::every][:count]
            table = replace(
                table,
                names=tuple(table.names[k] for k in keep),
                **{field: getattr(table, field)[keep] for field in ("K", "distortion", "cam2world")},
            )
            return sampled_reconstruction(clip, table)
    return colmap_reconstruction(clip / "sparse")


def score(rec: Reconstruction, clip: Path) -> dict[str, float]:
    """Error of the kept depths against the true ones."""
    errors, surface, kept, open_water, invented = [], 0, 0, 0, 0
    for name in rec.names:
        truth = true_depth(clip, name)
        if truth is None:
            continue
        found = rec.depth[name].z_depth.numpy()
        both = (truth > 0) & (found > 0)
        errors.append(np.abs(found[both] - truth[both]) / truth[both])
        surface += int((truth > 0).sum())
        kept += int(both.sum())
        open_water += int((truth == 0).sum())
        invented += int(((truth == 0) & (found > 0)).sum())
    error = np.concatenate(errors) if errors else np.zeros(0)
    if not surface:
        return {}
    return {
        "kept": kept / surface,
        "median": float(np.median(error)),
        "absrel": float(error.mean()),
        "beyond_5_percent": float((error > 0.05).mean()),
        "invented": invented / max(open_water, 1),
    }


def draw(rec: Reconstruction, frames: Frames, name: str, path: Path) -> None:
    """Image above, inverse depth (near = yellow) below, unknown black."""
    depth = rec.depth[name].z_depth.numpy()
    known = depth > 0
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0)
    low, high = np.quantile(inverse[known], [0.01, 0.99]) if known.any() else (0, 1)
    shown = cv2.applyColorMap(
        (np.clip((inverse - low) / (high - low + 1e-12), 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO
    )
    shown[~known] = 0
    image = (frames.image(frames.index(name)).numpy()[..., ::-1] * 255).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.concatenate([image, shown], 1))


def main() -> None:
    """Run the sweep on each clip and print one line of figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--out", type=Path, default=Path("/tmp/plane_sweep"))
    parser.add_argument("--draw", type=int, default=3, help="depth maps drawn per clip")
    parser.add_argument("--water", action="store_true", help="also fit the water, restore the images and the cloud")
    parser.add_argument("--set", nargs="*", default=[], help="setting=value")
    arguments = parser.parse_args()
    changed = {key: json.loads(value) for key, value in (item.split("=") for item in arguments.set)}
    settings = replace(PlaneSweepSettings(), **changed)
    torch.set_num_threads(1)
    for clip in arguments.clips:
        rec = read_clip(clip, arguments.every, arguments.frames)
        frames = frames_of(clip, rec.names)
        folder = arguments.out / clip.name
        shutil.rmtree(folder, ignore_errors=True)
        rec = replace(rec, depth=DepthMaps(folder / "z_depth"))
        before, start = time.process_time(), time.perf_counter()
        estimate_depth(rec, frames, settings)
        seconds = (time.process_time() - before) / len(rec.names)
        waited = (time.perf_counter() - start) / len(rec.names)

        if arguments.water:
            before = time.process_time()
            made = with_water(rec, frames, ColmapSettings(), folder)
            water = (time.process_time() - before) / len(rec.names)
            print(clip.name, f"water, cloud and restored images: cpu_s_per_frame={water:.4f}",
                  f"cloud={0 if made.cloud is None else len(made.cloud.xyz)}", flush=True)  # fmt: skip
        filled = float(np.mean([(rec.depth[name].z_depth > 0).float().mean() for name in rec.names]))
        figures = {"cpu_s_per_frame": seconds, "wall_s_per_frame": waited, "filled": filled, **score(rec, clip)}
        print(clip.name, f"{len(rec.names)} x {frames.width}x{frames.height}",
              " ".join(f"{key}={value:.4f}" for key, value in figures.items()), flush=True)  # fmt: skip
        for k in np.linspace(0, len(rec.names) - 1, min(arguments.draw, len(rec.names))).round().astype(int):
            draw(rec, frames, rec.names[k], folder / f"{Path(rec.names[k]).stem}.png")


if __name__ == "__main__":
    main()
