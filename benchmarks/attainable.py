"""Held-out frames as the other frames of a clip predict them, with all that can be known of the way, beside maps.

    python benchmarks/attainable.py RUN... [--tables DIR] [--recipes NAME ...]

RUN are finished run folders; DIR is the --out of `swimm3r bench render RUN...`. Each of the training frames nearest in
time is drawn from the test camera by the map's depth, moved onto the test frame by dense flow, and given the affine map
of colors that fits it best. All three use the test frame, which no map may. That tells what frames have in common; it
is an estimate and no bound, for drawing a frame blurs it and flow is not exact, which a map need not pay for:

    share   of the test frame's pixels, those that two of them show; every column is over them alone
    one     the training frame that comes closest
    mean    all of them averaged
    limit   the error that they have in common, the mean product of the errors of two: what endlessly many of them
            would leave, as is their own noise's share of the errors of one and of their mean
    detail  sqrt(g(I) . g(T) / g(T) . g(T)), g the gradients of the channels' mean over all pixels, T the test frame, I
            the training frame that has most of it, then the own map, moved by the flow: noise of a frame is in no other
    lead    the limit over the best map of another recipe

Columns of maps are PSNR in dB after an affine map of colors, and in brackets after being moved by the flow as well.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, pixel_grid, project, unproject
from swimm3r.evaluate.images import as_8_bit, psnr
from swimm3r.evaluate.registration import fit_colors, flow_between
from swimm3r.imaging.undistortion import undistorted
from swimm3r.pipeline.finished_sfm import FinishedSfm, open_finished_sfm
from swimm3r.pipeline.scores.held_out import HeldOutView, cut, in_axes_of, score_views
from swimm3r.splat.map_file import load_map
from swimm3r.splat.rendering import SplatMap

NEAREST = 16  # training frames that are asked for each test frame
SAME_DEPTH = 0.05  # relative difference up to which a frame shows the surface and not one before it
LEAST_SHARE = 0.15  # of the pixels, fewer of which say little of a frame
_MAPS = 6  # columns of a row before those of maps
BORDER = 7  # px, taken off what a frame shows: flow there is a guess
SMOOTH = 2.0  # px, sigma that flow is smoothed by: single pixels' noise is no displacement


@dataclass(frozen=True)
class Target:
    """A held-out frame on its canvas, and what the map says of the place."""

    camera: Cameras
    image: Float[Tensor, "h w 3"]
    counted: Bool[Tensor, "h w"]
    points: Float[Tensor, "1 p 3"]  # of its pixels, by the map's depth


def target_of(sfm: FinishedSfm, scene: SplatMap, view: HeldOutView) -> Target:
    """The frame of a scored view."""
    f, camera = sfm.frames.index(view.name), cut(view.canvas, view.window)
    image, seen = undistorted(sfm.frames.image(f), sfm.frames.mask(f), view.lens, view.canvas)
    image, seen = image[view.window.rows, view.window.columns], seen[view.window.rows, view.window.columns]
    out = scene.render(camera, view.time)
    pixels = pixel_grid(camera.height, camera.width).reshape(1, -1, 2).to(camera.K)
    points = unproject(camera, pixels, out.z_depth.reshape(1, -1).to(camera.K))
    return Target(camera, as_8_bit(image), seen if out.observed is None else seen & out.observed, points)


def drawn_from(
    name: str, sfm: FinishedSfm, scene: SplatMap, target: Target
) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]] | None:
    """A training frame as the test camera sees it, and where it shows the same surface; None where that is hardly so.

    Placed by the map, then by flow; recolored before and after.
    """
    f, lens = sfm.frames.index(name), sfm.rec.cameras[sfm.rec.index(name)]
    canvas = lens.drawn(scene.settings.long_side)
    image, seen = undistorted(sfm.frames.image(f), sfm.frames.mask(f), lens, canvas)
    pixels, z = project(canvas, target.points.to(canvas.K))
    at = pixels[0].reshape(*target.counted.shape, 2).float().numpy() - 0.5
    z = z[0].reshape(target.counted.shape)
    surface = _sampled(scene.render(canvas, sfm.frames.frames[f].time).z_depth, at)
    shown = target.counted & _within(at, seen.shape) & (_sampled(seen.float(), at) > 0.99) & (z > 0)
    shown &= ((z / surface.clamp(min=1e-6)) - 1).abs() < SAME_DEPTH
    if float(shown.float().mean()) < LEAST_SHARE:
        return None
    placed = _recolored(_sampled(image, at), target.image, shown)
    there = _sampled(torch.from_numpy(at), _grid(shown) + smooth_flow(target.image, placed)).numpy()
    moved = _sampled(image, there)  # resampled once
    inner = cv2.erode(shown.numpy().astype(np.uint8), np.ones((BORDER, BORDER), np.uint8))
    shown = torch.from_numpy(inner) > 0
    return None if not bool(shown.any()) else (_recolored(moved, target.image, shown), shown)


def smooth_flow(source: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"]) -> Float[np.ndarray, "h w 2"]:
    """The flow between two images without what single pixels' noise makes of it."""
    flow = flow_between(*(each.float().mean(-1).numpy() for each in (source, target)))
    return cv2.GaussianBlur(flow, (0, 0), SMOOTH)


def _grid(like: Tensor) -> np.ndarray:
    row, column = np.mgrid[: like.shape[0], : like.shape[1]].astype(np.float32)
    return np.stack([column, row], -1)


def _within(at: np.ndarray, shape: tuple[int, ...]) -> Tensor:
    """Mask of the places that lie in an image; beyond it `_sampled` repeats its border."""
    height, width = shape
    return torch.from_numpy(((at >= 0) & (at <= (width - 1, height - 1))).all(-1))


def _sampled(values: Tensor, at: np.ndarray) -> Tensor:
    x, y = (np.ascontiguousarray(part, dtype=np.float32) for part in np.moveaxis(at, -1, 0))
    drawn = cv2.remap(values.float().numpy(), x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(drawn)


def _recolored(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], where: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """In the colors of the target where both show the same; elsewhere the target, so that flow finds nothing there."""
    return torch.where(where[..., None], fit_colors(image[where], target[where])(image), target)


Rendered = tuple[SplatMap, dict[str, HeldOutView]]  # a map, and its scored views by the names of their frames


def rendered(sfm: FinishedSfm, path: Path) -> Rendered:
    """A map with the poses of its test frames refined on it."""
    scene = load_map(path)
    start = in_axes_of(scene, sfm.rec, sfm.first_poses())
    with TemporaryDirectory() as folder:
        views = score_views(scene, sfm.rec, sfm.frames, start, Path(folder), sfm.settings.test)
    return scene, {view.name: view for view in views}


def row_of(name: str, sfm: FinishedSfm, maps: list[Rendered]) -> list[float] | None:
    """Share, one, mean, limit, detail of both, then two columns per map; None where no two frames show the test frame.

    The first map places the training frames.
    """
    scene, view = maps[0][0], maps[0][1][name]
    target = target_of(sfm, scene, view)
    f = sfm.frames.index(name)
    trained = {frame.name for frame in sfm.frames.train}
    near = sorted((n for n in sfm.rec.names if n in trained), key=lambda n: abs(sfm.frames.index(n) - f))[:NEAREST]
    found = [each for other in near if (each := drawn_from(other, sfm, scene, target)) is not None]
    if len(found) < 2:
        return None
    drawn, shown = (torch.stack(parts) for parts in zip(*found, strict=True))
    where = shown.sum(0) >= 2
    if not bool(where.any()):
        return None

    def score(image: Float[Tensor, "h w 3"], over: Bool[Tensor, "h w"] = where) -> float:
        fitted = fit_colors(image[over], target.image[over])(image[over])
        return psnr(as_8_bit(fitted.clamp(0, 1)), target.image[over])

    mean = (drawn * shown[..., None]).sum(0) / shown.sum(0).clamp(min=1)[..., None]
    one = max(score(image, where & there) for image, there in zip(drawn, shown, strict=True) if (where & there).any())
    renderings = []
    # rendered anew, for the pictures of a table mark what the map's own training frames did not see
    for scene, views in maps:
        image = as_8_bit(scene.render(cut(views[name].canvas, views[name].window), views[name].time).rgb)
        image = _recolored(image, target.image, where)
        renderings += [image, _sampled(image, _grid(where) + smooth_flow(target.image, image))]
    detail = max(common_detail(image, target.image, where & there) for image, there in zip(drawn, shown, strict=True))
    row = [float(where.float().mean()), one, score(mean), _common_psnr(drawn - target.image, shown, where)]
    row += [detail, common_detail(renderings[1], target.image, where)]
    return row + [score(image) for image in renderings]


def common_detail(image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], over: Bool[Tensor, "h w"]) -> float:
    """Root mean square share of the target's gradients that an image has as well; 0 over no pixel."""
    if not bool(over.any()):
        return 0.0
    shown, asked = (torch.stack(torch.gradient(each.double().mean(-1)))[:, over] for each in (image, target))
    return float(((shown * asked).sum() / (asked**2).sum()).clamp(min=0).sqrt())


def _common_psnr(errors: Float[Tensor, "n h w 3"], shown: Bool[Tensor, "n h w"], where: Bool[Tensor, "h w"]) -> float:
    """PSNR, dB, of the error that the frames share: the mean over pixels of the products of the errors of two."""
    errors = errors * shown[..., None]
    count = shown.sum(0)[where][:, None]
    products = (errors.sum(0) ** 2 - (errors**2).sum(0))[where] / (count * (count - 1))
    return float(-10 * torch.log10(products.mean()))


def main() -> None:
    """Print a row per clip, means over its test frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--tables", type=Path)
    parser.add_argument("--recipes", nargs="*", default=["watersplatting"])
    a = parser.parse_args()
    torch.set_num_threads(1)
    others = a.recipes if a.tables else []
    print("| clip | frames | share | one | mean | limit | detail | " + " | ".join(["own map", *others]) + " | lead |")
    print("| --- " * (8 + len(others) + 1) + "|")
    for run in a.runs:
        sfm, paths = open_finished_sfm(run), [run / "splat" / "map.safetensors"]
        paths += [next((a.tables / run.name).glob(f"*/{recipe}/0/map.safetensors")) for recipe in others]
        maps = [rendered(sfm, path) for path in paths]
        rows = [row for name in maps[0][1] if (row := row_of(name, sfm, maps)) is not None]
        if not rows:
            print(f"| {run.name} | 0 |" + " |" * (7 + len(others)), flush=True)
            continue
        share, one, mean, limit, frame, own, *scores = np.mean(rows, 0).tolist()
        told = [f"{scores[i]:.2f} ({scores[i + 1]:.2f})" for i in range(0, len(scores), 2)]
        lead = f"{np.mean([row[3] - max(row[_MAPS + 2 :: 2]) for row in rows]):.2f}" if others else ""
        cells = [run.name, str(len(rows)), f"{share:.2f}", f"{one:.2f}", f"{mean:.2f}", f"{limit:.2f}"]
        cells += [f"{frame:.2f}, {own:.2f}", *told, lead]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
