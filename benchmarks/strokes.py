"""Fine grain that a map draws as strokes: how much of one direction the texture of renderings has, beside the frames'.

    python benchmarks/strokes.py RUN ...

RUN are run folders with a finished map. Sand and gravel have no direction over a few pixels; a map of too few
primitives gives them one. Coherence, (l1 - l2) / (l1 + l2) of the eigenvalues of the structure tensor (Gaussian of
2.5 px), is 0 where gradients point everywhere and 1 where they are parallel. Asked for is grain: observed pixels of
test frames, and of every second training frame, where the frame has contrast and its own coherence, averaged by a
Gaussian of 12 px, is below 0.35. Training frames by the ground that they show: measured; or of guessed depth, seen by
several of them or by one alone, by the map's depth.

    share       of the frame's pixels
    frame       mean coherence there in the frames ..
    map         .. and in the renderings
    sharpness   mean gradient there, renderings : frames
    dB          PSNR there, after an affine fit of colors
    px          pixels for each primitive whose center shows there
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch
from dive_runs import dive_run
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, pixel_grid, project, unproject
from swimm3r.evaluate import NotComputed
from swimm3r.evaluate.images import as_8_bit, sharpness
from swimm3r.evaluate.registration import psnr_affine
from swimm3r.imaging.undistortion import nearest_pixels, undistorted
from swimm3r.pipeline.finished_sfm import FinishedSfm
from swimm3r.pipeline.scores.held_out import in_axes_of, score_views
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import SplatMap

EVERY = 2  # training frames
TENSOR = 2.5  # px, sigma of the structure tensor: about the width of a stroke's surroundings
AROUND = 12.0  # px, sigma of the surroundings whose mean coherence tells grain from edges
GRAIN = 0.35  # mean coherence below which texture has no direction
CONTRAST = 0.01  # pixel value, the least deviation of grain within the surroundings
OPAQUE = 0.5
SAME_DEPTH = 0.05  # relative difference up to which two depths are of one surface
LEAST = 300  # px, fewer of which say nothing of a frame


@dataclass(frozen=True)
class View:
    """A frame on its pinhole, and what the map shows there."""

    frame: Float[Tensor, "h w 3"]
    render: Float[Tensor, "h w 3"]
    grain: Bool[Tensor, "h w"]
    primitives: Float[Tensor, "h w"]  # whose centers a pixel shows


def coherence(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """The share of one direction in the gradients of an image's mean channel, 0 to 1."""
    gray = image.mean(-1).numpy().astype(np.float32)
    x, y = cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    xx, yy, xy = (cv2.GaussianBlur(part, (0, 0), TENSOR) for part in (x * x, y * y, x * y))
    return torch.from_numpy(np.hypot(xx - yy, 2 * xy) / np.maximum(xx + yy, 1e-12))


def is_grain(image: Float[Tensor, "h w 3"]) -> Bool[Tensor, "h w"]:
    """Mask of the texture without a direction."""
    gray = image.mean(-1)
    deviation = (_around(gray * gray) - _around(gray).square()).clamp(min=0).sqrt()
    return (_around(coherence(image)) < GRAIN) & (deviation > CONTRAST)


def _around(values: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    return torch.from_numpy(cv2.GaussianBlur(values.numpy(), (0, 0), AROUND))


def view_of(sfm: FinishedSfm, scene: SplatMap, name: str, lens: Cameras, canvas: Cameras) -> View:
    """The map beside a frame."""
    f = sfm.frames.index(name)
    image, seen = undistorted(sfm.frames.image(f), sfm.frames.mask(f), lens, canvas)
    out, image = scene.render(canvas, sfm.frames.frames[f].time), as_8_bit(image)
    ground = out.alpha > OPAQUE if out.observed is None else out.observed & (out.alpha > OPAQUE)
    pixels, z = project(canvas, torch.cat([part.xyz for part in scene.parts()])[None].to(canvas.K))
    (column, row), z = pixels[0].floor().long().unbind(-1), z[0]
    inside = (z > 0) & (column >= 0) & (column < canvas.width) & (row >= 0) & (row < canvas.height)
    row, column, z = row[inside], column[inside], z[inside]
    shows = z < (1 + SAME_DEPTH) * out.z_depth[row, column].to(z)
    count = torch.zeros(image.shape[:2]).index_put_((row[shows], column[shows]), torch.ones(1), accumulate=True)
    return View(image, as_8_bit(out.rgb), is_grain(image) & seen & ground, count)


def training_views(sfm: FinishedSfm, scene: SplatMap) -> Iterator[tuple[str, View, Bool[Tensor, "h w"]]]:
    """Kind of ground, a training frame, and the mask of such ground in it."""
    rec, long_side = sfm.rec, scene.settings.long_side
    canvases = [rec.cameras[i].drawn(long_side) for i in range(len(rec.names))]
    times = [sfm.frames.frames[sfm.frames.index(name)].time for name in rec.names]
    surfaces = [
        scene.render(canvas, time, backscatter=False, observed=False).z_depth
        for canvas, time in zip(canvases, times, strict=True)
    ]
    for i in range(0, len(rec.names), EVERY):
        lens, canvas, name = rec.cameras[i], canvases[i], rec.names[i]
        view = view_of(sfm, scene, name, lens, canvas)
        pixels = pixel_grid(canvas.height, canvas.width).reshape(1, -1, 2).to(canvas.K)
        points = unproject(canvas, pixels, surfaces[i].reshape(1, -1).to(canvas.K))
        frames = torch.zeros(view.grain.shape)
        for other, surface in zip(canvases, surfaces, strict=True):
            frames += _shown(other, surface, points).reshape(frames.shape)
        row, column = nearest_pixels(lens, canvas)
        measured = rec.depth[name].z_depth[row, column] > 0
        yield "measured", view, measured
        yield "guessed, several frames", view, ~measured & (frames > 1)
        yield "guessed, one frame", view, ~measured & (frames <= 1)


def _shown(camera: Cameras, surface: Float[Tensor, "h w"], points: Float[Tensor, "1 p 3"]) -> Bool[Tensor, " p"]:
    """Points that a camera shows on its surface."""
    pixels, z = project(camera, points.to(camera.K))
    (column, row), z = pixels[0].floor().long().unbind(-1), z[0]
    inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    there = surface[torch.where(inside, row, 0), torch.where(inside, column, 0)].to(z)
    return inside & ((z / there.clamp(min=1e-9) - 1).abs() < SAME_DEPTH)


def test_views(sfm: FinishedSfm, scene: SplatMap) -> Iterator[tuple[str, View, Bool[Tensor, "h w"]]]:
    """The held-out frames at their refined poses, with all that they show."""
    with TemporaryDirectory() as folder:
        start = in_axes_of(scene, sfm.rec, sfm.first_poses())
        scored = score_views(scene, sfm.rec, sfm.frames, start, Path(folder), sfm.settings.test)
    for each in scored:
        view = view_of(sfm, scene, each.name, each.lens, each.canvas)
        yield "test frames", view, torch.ones_like(view.grain)


def figures(view: View, ground: Bool[Tensor, "h w"]) -> list[float] | None:
    """The table's figures of one frame's ground; None where it is hardly any."""
    at = view.grain & ground
    if int(at.sum()) < LEAST:
        return None
    sharp, decibel = sharpness(view.render, view.frame, at), psnr_affine(view.render, view.frame, at)
    if isinstance(sharp, NotComputed) or isinstance(decibel, NotComputed):
        return None
    return [
        float(at.float().mean()),
        float(coherence(view.frame)[at].mean()),
        float(coherence(view.render)[at].mean()),
        sharp,
        decibel,
        float(at.sum() / view.primitives[at].sum().clamp(min=1)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=dive_run, metavar="RUN")
    options = parser.parse_args()
    print("| run | ground | frames | share | frame | map | sharpness | dB | px |\n" + "| --- " * 9 + "|")
    for sfm in options.runs:
        scene = load_map(sfm.folder / "splat" / "map.safetensors")
        found: dict[str, list[list[float]]] = defaultdict(list)
        for views in (training_views, test_views):
            for kind, view, ground in views(sfm, scene):
                if (row := figures(view, ground)) is not None:
                    found[kind].append(row)
        for kind, rows in found.items():
            share, own, drawn, sharp, decibel, pixels = np.mean(rows, axis=0)
            cells = [f"{share:.2f}", f"{own:.3f}", f"{drawn:.3f}", f"{sharp:.2f}", f"{decibel:.1f}", f"{pixels:.1f}"]
            print(f"| {sfm.folder.name} | {kind} | {len(rows)} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
