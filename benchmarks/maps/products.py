"""Map products of a synthetic survey against the true view from above.

    python benchmarks/maps/products.py DIVE RUN            the run as it was reconstructed, placed by its camera centers
    python benchmarks/maps/products.py DIVE RUN --truth    the true cameras, depth and clear images in its place

DIVE is a folder of `swimm3r.synthetic.dive.write_dive`, RUN a run of its images. Printed: errors of height over the
cells, PSNR of the orthophoto without water, and shifts of patches of 48 cells by phase correlation.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from swimm3r.evaluate.images import psnr
from swimm3r.geometry import align_similarity
from swimm3r.products import elevation as elevation_model
from swimm3r.products.frame_colors import Points, blended
from swimm3r.products.grid import Grid, Window, grid_of
from swimm3r.products.habitat.figures import figures
from swimm3r.products.survey import Colors, Survey, open_survey
from swimm3r.scene.georeference import Georeference
from swimm3r.scene.ground_truth import GroundTruth, read_ground_truth
from swimm3r.scene.reconstruction import DepthMap, DepthMaps
from swimm3r.settings_document import from_document
from swimm3r.synthetic.dive import Dive, make_dive
from swimm3r.synthetic.settings import DiveSettings
from swimm3r.synthetic.top_view import top_view

PATCH, STEP = 48, 24  # cells
LEAST_RESPONSE = 0.3  # of the phase correlation, below which a patch has no texture


@dataclass(frozen=True)
class TrueImages(Survey):
    """A survey whose images without water are the true ones."""

    truth: GroundTruth | None = None

    def image(self, colors: Colors, i: int) -> np.ndarray | None:
        assert self.truth is not None
        clear = self.truth.clear(self.rec.names[i])
        return super().image(colors, i) if colors == "filmed" or clear is None else clear.numpy()


def placed(survey: Survey, truth: GroundTruth, scale: float | None = None) -> Survey:
    """The run in the truth's frame, by a similarity of the camera centers; of a given scale, by a motion."""
    reference = truth.cameras[[truth.names.index(name) for name in survey.rec.names]]
    own, true = survey.rec.cameras.centers.double(), reference.centers.double()
    fit = align_similarity(own, true)
    scale = float(fit.scale) if scale is None else scale
    shift = true.mean(0) - scale * fit.R @ own.mean(0)
    away = (scale * own @ fit.R.T + shift - true).norm(dim=1)
    print(f"camera centers: {1e3 * float(away.pow(2).mean().sqrt()):.2f} mm rms")
    rows = [tuple(row) for row in fit.R.tolist()]
    place = Georeference(None, tuple(shift.tolist()), (rows[0], rows[1], rows[2]), scale)
    return replace(survey, place=place)


def with_truth(survey: Survey, truth: GroundTruth, folder: Path) -> Survey:
    """The true cameras, depth and images in the place of the run's."""
    depth = DepthMaps(folder)
    for name in survey.rec.names:
        z = truth.z_depth(name)
        if z is not None:
            depth.write(name, DepthMap(z, torch.ones_like(z)))
    cameras = truth.cameras[[truth.names.index(name) for name in survey.rec.names]]
    place = Georeference(None, (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 1.0)
    rec = replace(survey.rec, cameras=cameras, depth=depth)
    return TrueImages(survey.folder, rec, survey.frames, place, truth)


@dataclass(frozen=True)
class MapErrors:
    """Errors of the maps of a survey against the true view from above; lengths in metres."""

    grid: Grid
    seconds: float  # of the processor
    distance: float  # median z depth
    height: Float[np.ndarray, "rows columns"]  # found less true; NaN in holes
    views: Int[np.ndarray, "rows columns"]
    rugosity: dict[float, tuple[float, float]]  # distance of the heights: of the map, and of the truth
    psnr: float
    shifts: Float[np.ndarray, " patches"]  # cells

    def rms(self, views: int = 1) -> float:
        """Root mean square error of the heights that at least so many depth maps show."""
        return float(np.sqrt((self._shown_by(views) ** 2).mean()))

    def _shown_by(self, views: int) -> Float[np.ndarray, " n"]:
        return self.height[~np.isnan(self.height) & (self.views >= views)]

    def show(self) -> None:
        """Print all of them."""
        grid = self.grid
        print(f"{grid.columns} x {grid.rows} cells of {1e3 * grid.gsd:g} mm, {self.seconds:.1f} CPU-s")
        for views in (1, 2, 3, 5):
            kept, rms = self._shown_by(views), self.rms(views)
            print(
                f"heights, at least {views} views: {len(kept) / self.height.size:.0%} of the cells, {1e3 * rms:.2f} mm"
                f" rms = {rms / self.distance:.2%} of the range, median {1e3 * np.median(np.abs(kept)):.2f} mm"
            )
        for spacing, (found, true) in self.rugosity.items():
            print(
                f"rugosity of heights every {1e3 * spacing:g} mm: {found:.3f}, {found / true - 1:+.1%} from the truth"
            )
        print(f"orthophoto: {self.psnr:.1f} dB")
        print(
            f"place: median {np.median(self.shifts):.2f} cells of {len(self.shifts)} patches,"
            f" 90 % {np.quantile(self.shifts, 0.9):.2f}"
        )


def compare(survey: Survey, dive: Dive) -> MapErrors:
    """The errors of height, color and place of a survey in the frame of the truth."""
    grid = grid_of(survey)
    window = Window(0, 0, grid.rows, grid.columns)
    started = time.process_time()
    frames = elevation_model.frames_over(survey, grid, window)
    found = elevation_model.elevation(survey, grid, window, frames)
    x, y = grid.centers(window)
    rows, columns = np.nonzero(~np.isnan(found.height))
    points = Points(np.stack([x[columns], y[rows], found.height[rows, columns]], -1), size=grid.gsd)
    colors = blended(survey, points, frames, ["physical"])["physical"]
    seconds = time.process_time() - started
    image = np.full((grid.rows, grid.columns, 3), np.nan)
    image[rows, columns] = colors
    origin = np.array(survey.place.origin)
    clear, height = top_view(dive, x + origin[0], y + origin[1])
    error = found.height + origin[2] - height
    shown = np.logical_not(np.isnan(image).any(-1))
    medians = [np.median(one.z_depth[one.usable]) for one in map(survey.points, survey.overview)]
    return MapErrors(
        grid=grid,
        seconds=seconds,
        distance=float(np.median(medians)),
        height=error,
        views=found.views,
        rugosity=rugosities(found.height, np.where(np.isnan(error), np.nan, height), grid.gsd),
        psnr=float(psnr(torch.from_numpy(image[shown]), torch.from_numpy(clear[shown]))),
        shifts=patch_shifts(image, clear, shown, grid),
    )


def rugosities(height: np.ndarray, truth: np.ndarray, gsd: float) -> dict[float, tuple[float, float]]:
    """Rugosity of heights and of the true ones, by the distance of the heights."""
    found = {}
    for block in (1, 2, 5, 10):
        one, other = (figures(means(values, block), block * gsd) for values in (height, truth))
        if one is not None and other is not None:
            found[block * gsd] = (one.rugosity, other.rugosity)
    return found


def means(values: np.ndarray, block: int) -> np.ndarray:
    """Means over blocks of cells that are known to half at least."""
    rows, columns = (n // block for n in values.shape)
    blocks = values[: rows * block, : columns * block].reshape(rows, block, columns, block).transpose(0, 2, 1, 3)
    blocks = blocks.reshape(rows, columns, -1)
    count = (~np.isnan(blocks)).sum(-1)
    return np.where(2 * count >= block**2, np.nansum(blocks, -1) / np.maximum(count, 1), np.nan)


def patch_shifts(image: np.ndarray, truth: np.ndarray, shown: np.ndarray, grid: Grid) -> np.ndarray:
    """Distances in cells between patches of two maps."""
    one, other = (cv2.cvtColor(np.nan_to_num(a).astype(np.float32), cv2.COLOR_RGB2GRAY) for a in (image, truth))
    hanning, found = cv2.createHanningWindow((PATCH, PATCH), cv2.CV_64F), []
    for row in range(0, grid.rows - PATCH, STEP):
        for column in range(0, grid.columns - PATCH, STEP):
            patch = np.s_[row : row + PATCH, column : column + PATCH]
            if shown[patch].mean() > 0.98:
                shift, response = cv2.phaseCorrelate(
                    one[patch].astype(np.float64), other[patch].astype(np.float64), hanning
                )
                found += [float(np.linalg.norm(shift))] if response > LEAST_RESPONSE else []
    return np.array(found)


def dive_of(folder: Path) -> Dive:
    """The dive that was written into a folder."""
    stored = json.loads((folder / "truth" / "dive.json").read_text(encoding="utf-8"))
    return make_dive(from_document({name: value for name, value in stored.items() if name != "whole"}, DiveSettings))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dive", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--truth", action="store_true")
    given = parser.parse_args()
    survey, truth = open_survey(given.run), read_ground_truth(given.dive / "truth")
    with TemporaryDirectory() as folder:
        survey = with_truth(survey, truth, Path(folder)) if given.truth else placed(survey, truth)
        compare(survey, dive_of(given.dive)).show()


if __name__ == "__main__":
    main()
