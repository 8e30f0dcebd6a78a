"""Depth that is filled in where nothing was measured, with and without what the water's color tells of it.

    python benchmarks/guessed_depth.py RUN[:TRUTH] ...

RUN are finished run folders. Beside a TRUTH (of a synthetic dive; the demo's is found) pixels without measured depth
are compared with it, the cloud's depth being used as in a run. Without one, depth along the border of the frames (18 %
of the long side) is hidden and compared with what is filled in there, without the cloud, which saw it. Eight frames of
each run:

    hidden   share of the pixels compared
    error    mean |ln(filled / true)|, without and with color
    far off  share of them that is off by more than a fifth
    beside   error with color beside silhouettes: within 2 % of the long side of what is an eighth nearer
    restored PSNR (dB) of the restored frames there against a TRUTH, times one gain per frame
"""

import argparse
from dataclasses import replace

import numpy as np
import torch
from dive_runs import dive_run, to_truth
from jaxtyping import Float
from scipy.ndimage import minimum_filter
from torch import Tensor

from swimm3r.evaluate.images import psnr
from swimm3r.imaging.depth_completion import fill_z_depth
from swimm3r.imaging.depth_from_color import depth_from_color
from swimm3r.imaging.open_water import sea_share, without_fringe
from swimm3r.imaging.undistortion import frame_directions, frame_rays
from swimm3r.medium import linear_from_srgb, srgb_from_linear
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.scene.point_groups import PointGroups
from swimm3r.sfm.medium.restore import restore_image

FRAMES = 8
BORDER = 0.18  # of the long side
BESIDE, NEARER = 0.02, 0.125  # of the long side; of the depth


def errors(sfm: FinishedSfm) -> Float[np.ndarray, " 7"]:
    """The columns of the table, means over the frames."""
    rec, truth = sfm.rec, sfm.truth
    assert rec.medium is not None
    assert rec.cloud is not None
    cloud, linear = PointGroups(rec.cloud.xyz), rec.medium.encoding == "linear"
    per_unit = 1.0  # of the run, of one of the truth
    if truth is not None:
        per_unit = 1 / float(to_truth(sfm).scale)
    rows = []
    for i in range(0, len(rec.names), max(1, len(rec.names) // FRAMES)):
        camera, name = rec.cameras[i], rec.names[i]
        image, depth = sfm.frames.image(sfm.frames.index(name)), rec.depth[name]
        if not bool((depth.z_depth > 0).any()):
            continue
        veil = rec.medium.open_water(frame_directions(camera))
        veil = srgb_from_linear(veil) if linear else veil
        known = without_fringe(image, depth.z_depth, veil)
        sea = sea_share(image, known, veil)
        true, elsewhere = None if truth is None else truth.z_depth(name), cloud.z_depth(camera)
        if true is not None:
            true = true * per_unit
        else:
            margin = round(BORDER * max(known.shape))
            inner = torch.zeros_like(known)
            inner[margin:-margin, margin:-margin] = known[margin:-margin, margin:-margin]
            true, known, elsewhere = known, inner, None
        asked = (known == 0) & (true > 0) & (sea < 0.5)
        if not bool(asked.any()) or not bool((known > 0).any()):
            continue
        depth = replace(depth, z_depth=known)
        cue = depth_from_color(linear_from_srgb(image) if linear else image, depth, sea, frame_rays(camera), rec.medium)
        off = [_off(fill_z_depth(image, depth, sea, elsewhere, told), true, asked) for told in (None, cue)]
        beside = off[1][_beside_silhouettes(true)[asked]]
        found = [*(float(e.mean()) for e in off), *(_far(e) for e in off)]
        found.append(float(beside.mean()) if len(beside) else np.nan)
        clear = None if truth is None else truth.clear(name)
        if clear is None:
            found.append(np.nan)
        else:
            restored = restore_image(image, depth, frame_rays(camera), rec.medium, elsewhere=elsewhere).clear
            gain = (restored * clear)[known > 0].sum() / restored[known > 0].square().sum()
            found.append(float(psnr(gain * restored[asked], clear[asked])))
        rows.append([float(asked.float().mean()), *found])
    return np.ma.masked_invalid(rows).mean(axis=0).filled(np.nan)


def _beside_silhouettes(true: Tensor) -> Tensor:
    """Mask of the pixels close to which a surface is nearer."""
    depth = torch.where(true > 0, true, torch.inf)
    nearest = minimum_filter(depth.numpy(), 2 * round(BESIDE * max(true.shape)) + 1)
    return torch.from_numpy(nearest) < (1 - NEARER) * depth


def _off(filled: Tensor, true: Tensor, asked: Tensor) -> Tensor:
    return (filled / true.clamp(min=1e-9)).log().abs()[asked]


def _far(off: Tensor) -> float:
    return float((off > np.log(1.2)).float().mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN[:TRUTH]")
    print("| run | hidden | error | with color | far off | with color | beside | restored |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for sfm in parser.parse_args().runs:
        hidden, *rest, decibels = errors(sfm)
        shown = " | ".join([f"{100 * hidden:.0f} %", *(f"{100 * value:.1f} %" for value in rest)])
        restored = f"{decibels:.1f} dB" if np.isfinite(decibels) else "-"
        print(f"| {sfm.folder.name}{', truth' if sfm.truth else ''} | {shown} | {restored} |", flush=True)


if __name__ == "__main__":
    main()
