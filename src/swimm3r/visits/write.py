"""Visits of one site from runs to files: one frame, one grid, each visit's maps, and the layers of each change."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from swimm3r.errors import UsageError
from swimm3r.io.files.outputs import output_folder
from swimm3r.products.grid import Grid
from swimm3r.products.packages import require_packages
from swimm3r.products.survey import Survey, open_survey
from swimm3r.progress import Progress, watched
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sim3 import Sim3
from swimm3r.visits import color
from swimm3r.visits.alignment.misfit import Fit, fits_between, misfit_at
from swimm3r.visits.alignment.place import Placed, place_visits
from swimm3r.visits.change import Change, compare
from swimm3r.visits.ground import Ground, common_grid, observe
from swimm3r.visits.layers import write_change, write_maps
from swimm3r.visits.page import Pair, pair, write_page
from swimm3r.visits.places import Place
from swimm3r.visits.record import AlignmentRecord, ChangeRecord, VisitRecord, VisitsRecord
from swimm3r.visits.renders import Mapped, rendered_views
from swimm3r.visits.settings import VisitSettings


@dataclass(frozen=True)
class Visit:
    """A visit in the frame of the first."""

    name: str
    run: Path
    own: Reconstruction  # in the axes and unit of its own files
    placed: Placed
    ground: Ground

    @property
    def survey(self) -> Survey:
        """The run in the frame of the first."""
        return self.placed.survey

    @property
    def fit(self) -> Fit | None:
        """The way it came onto an earlier visit; None for the first."""
        return self.placed.fit


def write_visits(
    runs: Sequence[Path], out: Path, settings: VisitSettings, progress: Progress | None = None
) -> VisitsRecord:
    """Align the runs, compare each with the one before it, and write everything into `out`."""
    require_packages()
    names = _names(runs)
    surveys = [open_survey(run) for run in runs]
    with watched(progress) as told:
        placed = place_visits(surveys, names, settings, told)
        grid = common_grid([each.survey for each in placed], settings.gsd)
        visits = [
            Visit(name, run, opened.rec, each, observe(each.survey, grid, told))
            for name, run, opened, each in zip(names, runs, surveys, placed, strict=True)
        ]
        with output_folder(out) as folder:
            return _write(visits, grid, folder, settings, told)


def _names(runs: Sequence[Path]) -> list[str]:
    """A name for each run: that of its folder, with a number where several share it."""
    if len(runs) < 2:
        raise UsageError(
            "visits are compared with each other, and one run alone was given",
            cause="the second run was left out",
            hint="swimm3r visits RUN_A RUN_B --out DIR",
        )
    resolved = [run.resolve() for run in runs]
    for k, path in enumerate(resolved):
        if path in resolved[:k]:
            raise UsageError(
                f"{runs[k]} was given twice",
                cause="a slip in the command",
                hint="each run once, in the order of the visits",
            )
    names = [path.name for path in resolved]
    return [name if names.count(name) == 1 else f"{name} ({k})" for k, name in enumerate(names, 1)]


@dataclass(frozen=True)
class _Compared:
    """Two visits that follow each other, and the change between them."""

    earlier: Visit
    later: Visit
    change: Change
    record: ChangeRecord
    places: list[Place]


def _write(
    visits: Sequence[Visit], grid: Grid, folder: Path, settings: VisitSettings, progress: Progress
) -> VisitsRecord:
    """Write layers, maps, page and record."""
    place = visits[0].survey.place
    factors = [color.neutral(visits[0].ground.color)]  # on linear colors, into the light of the first visit
    compared: list[_Compared] = []
    for k, (earlier, later) in enumerate(pairwise(visits), 1):
        fits = fits_between(earlier.name, later.name, {visit.name: visit.fit for visit in visits})
        misfit = misfit_at(fits, earlier.ground, grid, place)
        change = compare(earlier.ground, later.ground, misfit, grid.gsd, factors[-1], settings)
        factors.append(factors[-1] * change.gains)
        names = earlier.name, later.name
        compared.append(
            _Compared(earlier, later, change, *write_change(names, change, grid, place, folder / f"change_{k}_{k + 1}"))
        )
    orthophotos = [
        write_maps(
            visit.survey, visit.ground, factors[k], grid,
            (folder / f"elevation_{k + 1}.tif", folder / f"orthophoto_{k + 1}.tif"), progress,
        )
        for k, visit in enumerate(visits)
    ]  # fmt: skip
    notes = [note for visit in visits for note in visit.placed.notes]
    record = VisitsRecord(
        **vars(grid.on_map(place)),
        threshold=settings.threshold,
        visits=tuple(_visit_record(visit, grid.gsd) for visit in visits),
        changes=tuple(each.record for each in compared),
        notes=(*notes, *(note for each in compared for note in _notes(each))),
    )
    pages = [
        _page_of(each, record, (orthophotos[k], orthophotos[k + 1]), (factors[k], factors[k + 1]), progress)
        for k, each in enumerate(compared)
    ]
    write_page(record, pages, folder)
    record.save(folder)
    return record


def _page_of(
    compared: _Compared,
    record: VisitsRecord,
    orthophotos: tuple[np.ndarray, np.ndarray],
    factors: tuple[np.ndarray, np.ndarray],
    progress: Progress,
) -> Pair:
    earlier, later = compared.earlier, compared.later
    runs = tuple(
        Mapped(each.run, each.own, each.placed.first_from_own, of)
        for each, of in zip((earlier, later), factors, strict=True)
    )
    views = rendered_views(earlier.survey, runs, compared.places, progress)
    return pair(compared.record, compared.places, orthophotos, compared.change, views, record)


def _notes(compared: _Compared) -> list[str]:
    names, found = f"{compared.earlier.name} to {compared.later.name}", []
    if compared.change.color is None:
        found.append(f"no change of color from {names}: a run has no frames without water")
    if not compared.change.comparable.any():
        found.append(f"no ground was seen by both visits from {names}")
    return found


def _visit_record(visit: Visit, gsd: float) -> VisitRecord:
    fit = visit.fit
    return VisitRecord(
        name=visit.name,
        run=str(visit.run),
        frames=len(visit.survey.rec.names),
        area=float(visit.ground.seen.sum()) * gsd**2,
        clear_colors=visit.survey.has("physical"),
        alignment=None if fit is None else _alignment_record(fit, visit.placed.first_from_own),
    )


def _alignment_record(fit: Fit, first_from_own: Sim3) -> AlignmentRecord:
    rows = [(float(x), float(y), float(z)) for x, y, z in first_from_own.R]
    x, y, z = (float(value) for value in first_from_own.t)
    return AlignmentRecord(
        onto=fit.onto,
        source=fit.alignment.source,
        matches=fit.alignment.matched,
        agreeing=int(fit.alignment.inlier.sum()),
        merged=fit.merged,
        error_px=fit.error_px,
        scale=float(first_from_own.scale),
        rotation=tuple(rows),
        shift=(x, y, z),
        check_points=fit.check_points,
        level_std=fit.level,
        up_std=fit.up,
    )
