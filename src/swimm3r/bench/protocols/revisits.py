"""Repeat visits against the truth: one synthetic seafloor twice, with another water, light and path, after a season.

Each pair of waters is compared twice: after a season (corals grown, bleached, broken or moved, algae, shifted sand),
and after none, where only water, light and path differ (`revisit_dives`). Truth is the seafloor from above. A true
change of height or color counts where it is above three times the deviation that is stated for its cell; a cell that is
reported is right where the truth has changed by more than one such deviation, in the same direction. All cells of
bleached corals that both visits saw count. The first visit's frame is that of the truth, by the camera centers; its own
errors are in the scores of the second.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from swimm3r.bench.cells import ResultKey, Scores, kept_cell
from swimm3r.bench.revisit_dives import pair_of_dives
from swimm3r.bench.scores import columns
from swimm3r.bench.settings import RevisitSettings
from swimm3r.bench.tables import Table
from swimm3r.evaluate import NotComputed
from swimm3r.geometry import align_similarity
from swimm3r.pipeline.presets import RunSettings
from swimm3r.pipeline.run import run_pipeline
from swimm3r.products.geotiff import StoredMap
from swimm3r.products.survey import open_survey
from swimm3r.progress import Progress, silent
from swimm3r.scene.georeference import Georeference, Vector, save_georeference
from swimm3r.synthetic import DiveSettings, make_dive, write_dive
from swimm3r.synthetic.seafloor import outline
from swimm3r.synthetic.season import corals_of
from swimm3r.synthetic.top_view import top_view
from swimm3r.visits import write_visits
from swimm3r.visits.change import LESS, MORE
from swimm3r.visits.color import lab, linear, neutral
from swimm3r.visits.record import VisitsRecord

_THRESHOLD = 3.0
_NOTHING = 5e-4, 0.5  # m and CIELAB below which the truth has not changed at all
_COLOR_LAYERS = "color_change", "color_significance", "color_changed"
COLUMNS = columns(
    "alignment_pct", "height_recall_pct", "height_precision_pct", "volume_error_pct", "bleached_cells",
    "bleached_recall_pct", "paler_precision_pct", "false_area_pct",
)  # fmt: skip


@dataclass(frozen=True)
class Truth:
    """The change of the seafloor at the cells of a map."""

    height: Float[np.ndarray, "h w"]  # m
    lab: Float[np.ndarray, "h w 3"]
    bleached: Bool[np.ndarray, "h w"]  # corals

    @property
    def color(self) -> Float[np.ndarray, "h w"]:
        """CIELAB distance."""
        return np.sqrt((self.lab**2).sum(-1))


def revisit_table(out: Path, revisits: RevisitSettings, settings: RunSettings, progress: Progress = silent) -> Table:
    """Two rows for every pair of waters; dives and runs stay in OUT, and a repeated call goes on with them."""
    cells = []
    for number in range(revisits.water_pairs):
        first, later, same = pair_of_dives(number, revisits)
        for kind, second in (("season", later), ("water only", same)):
            progress("pairs of visits", len(cells), 2 * revisits.water_pairs)
            key = ResultKey(f"{first.family} to {second.family}", kind)

            def make(folder: Path, dives: tuple[DiveSettings, DiveSettings] = (first, second)) -> Scores:
                runs = [_run(out, dive, settings, progress) for dive in dives]
                return scores_of(runs[0], runs[1], dives, folder / "visits", progress)

            cells.append(kept_cell(out, key, [first, second, settings], make))
    progress("pairs of visits", 2 * revisits.water_pairs, 2 * revisits.water_pairs)
    return Table("revisits", "Changes between repeat visits, against the truth", cells, COLUMNS)


def scores_of(
    first: Path, later: Path, dives: tuple[DiveSettings, DiveSettings], out: Path, progress: Progress = silent
) -> dict[str, float | NotComputed]:
    """The scores of two runs of these dives; the first run gets the place that the truth tells."""
    _place_by_truth(first, dives[0])
    record = write_visits([first, later], out, progress=progress)
    layers = out / record.changes[0].folder
    truth = _truth(record, dives)
    return {"alignment_pct": _alignment_error(record, first, later, dives), **_found(record, layers, truth)}


def _run(out: Path, dive: DiveSettings, settings: RunSettings, progress: Progress) -> Path:
    name = f"{dive.seed}-{dive.visit}"
    write_dive(dive, out / "dives" / name, progress)
    run_pipeline(out / "dives" / name, out / "runs" / name, settings, last_stage="sfm", progress=progress)
    return out / "runs" / name


def _true_centers(run: Path, dive: DiveSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Camera centers of a run, in its axes and in those of the truth."""
    rec, known = open_survey(run).rec, _true_path(dive)
    return rec.cameras.centers.double(), torch.stack([known[name] for name in rec.names])


def _true_path(dive: DiveSettings) -> dict[str, torch.Tensor]:
    """The true camera centers of a dive by the names of its frames, m."""
    made = make_dive(dive)
    return dict(zip(made.names, made.cameras.centers.double(), strict=True))


def _place_by_truth(run: Path, dive: DiveSettings) -> None:
    """Write the georeference under which the run's local frame is the truth's, but for its own errors."""
    onto = align_similarity(*_true_centers(run, dive))
    rows: list[Vector] = [(float(x), float(y), float(z)) for x, y, z in onto.R]
    x, y, z = onto.t.tolist()
    place = Georeference(None, (x, y, z), (rows[0], rows[1], rows[2]), float(onto.scale), 0.001, ("truth",))
    save_georeference(run, place)


def _alignment_error(
    record: VisitsRecord, first: Path, later: Path, dives: tuple[DiveSettings, DiveSettings]
) -> float | NotComputed:
    """Root mean square distance of the later cameras from the truth under the similarity, in % of the site's extent."""
    found = record.visits[1].alignment
    if found is None:
        return NotComputed("the visits were not aligned")
    place = open_survey(first).place
    own, true = _true_centers(later, dives[1])
    moved = found.scale * own.numpy() @ np.array(found.rotation).T + np.array(found.shift)
    off = place.to_crs(moved) - true.numpy()
    return 100 * float(np.sqrt((off**2).sum(1).mean()) / np.linalg.norm(np.ptp(true.numpy(), axis=0)))


def _truth(record: VisitsRecord, dives: tuple[DiveSettings, DiveSettings]) -> Truth:
    """The true change at the cells of the map."""
    x = record.west + (np.arange(record.columns) + 0.5) * record.gsd
    y = record.north - (np.arange(record.rows) + 0.5) * record.gsd
    seen = [top_view(make_dive(dive), x, y) for dive in dives]
    light = [linear(color.astype(np.float32)) for color, _ in seen]
    white = neutral(light[0].astype(np.float32))
    before, after = (lab(each * white) for each in light)
    return Truth(seen[1][1] - seen[0][1], after - before, _bleached(x, y, dives[1]))


def _bleached(x: Float[np.ndarray, " w"], y: Float[np.ndarray, " h"], dive: DiveSettings) -> Bool[np.ndarray, "h w"]:
    found = np.zeros((len(y), len(x)), bool)
    for column in range(int(np.floor(x.min())) - 1, int(np.ceil(x.max())) + 1):
        for row in range(int(np.floor(y.min())) - 1, int(np.ceil(y.max())) + 1):
            for coral in corals_of(column, row, dive.corals, dive.season, dive.seed):
                if coral.fate != "bleached":
                    continue
                animal = np.array(coral.after)
                across, along = (np.flatnonzero(np.abs(at - animal[k]) < animal[3]) for at, k in ((x, 1), (y, 2)))
                for i in along.tolist():
                    for j in across.tolist():
                        found[i, j] |= outline(animal, float(x[j] - animal[1]), float(y[i] - animal[2])) < 1
    return found


def _found(record: VisitsRecord, layers: Path, truth: Truth) -> dict[str, float | NotComputed]:
    """Recall, precision and volume of what was reported."""
    maps = {}
    for name in ("height_change", "height_change_std", "height_changed", *_COLOR_LAYERS):
        with StoredMap(layers / f"{name}.tif") as stored:
            maps[name] = stored.read()
    std, kinds, colors = maps["height_change_std"], maps["height_changed"], maps["color_changed"]
    with np.errstate(invalid="ignore", divide="ignore"):
        color_std = np.abs(maps["color_change"] / maps["color_significance"])
    known = kinds > 0
    true = known & (np.abs(truth.height) > _THRESHOLD * std)
    reported = (kinds == MORE) | (kinds == LESS)
    sign = np.where(kinds == MORE, 1, -1)
    right = reported & (sign * truth.height > std)
    paler = colors == MORE
    bleached = truth.bleached & (colors > 0)
    still = known & (np.abs(truth.height) < _NOTHING[0]) & (truth.color < _NOTHING[1])
    volume = float(np.abs(truth.height[reported]).sum())
    missed = float((sign * maps["height_change"])[reported].sum()) - float((sign * truth.height)[reported].sum())
    return {
        "height_recall_pct": _share(true & reported & (sign * truth.height > 0), true, "nothing has changed"),
        "height_precision_pct": _share(right, reported, "nothing was reported"),
        "volume_error_pct": 100 * missed / volume if volume else NotComputed("nothing was reported"),
        "bleached_cells": float(bleached.sum()),
        "bleached_recall_pct": _share(bleached & paler, bleached, "nothing has bleached"),
        "paler_precision_pct": _share(
            paler & (truth.lab[..., 0] > 0) & (truth.color > color_std), paler, "nothing was reported"
        ),
        "false_area_pct": _share(still & (reported | (colors == MORE) | (colors == LESS)), still, "all has changed"),
    }


def _share(part: np.ndarray, whole: np.ndarray, otherwise: str) -> float | NotComputed:
    return 100 * float(part.sum() / whole.sum()) if whole.any() else NotComputed(otherwise)
