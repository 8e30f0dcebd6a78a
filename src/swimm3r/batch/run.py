"""A batch: every dive a run of its own below one folder, with results.csv and results.html kept current beside them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from swimm3r.batch.dive import Dive, check_names
from swimm3r.batch.dives import FoundDives
from swimm3r.batch.results import Row, check_ours, is_finished, row_of, write_csv
from swimm3r.errors import Swimm3rError
from swimm3r.io.files.folder_lock import folder_lock
from swimm3r.io.files.outputs import output_folder
from swimm3r.progress import Progress, silent
from swimm3r.splat.settings import MapDevice
from swimm3r.tasks import EngineSettings, Failure, run_tasks

_SEVERAL = 8


class BatchError(Swimm3rError):
    """Some dives of a batch failed; the exit code is that of the failures where they have one in common, else 8."""

    def __init__(self, what: str, *, cause: str, hint: str, exit_code: int = _SEVERAL) -> None:
        super().__init__(what, cause=cause, hint=hint)
        self.exit_code = exit_code


def run_batch(
    found: FoundDives,
    out: Path,
    engine: EngineSettings = EngineSettings(),  # noqa: B008 - records are frozen
    *,
    redo: bool = False,
    last_stage: str = "eval",
    map_device: MapDevice = "auto",
    progress: Progress = silent,
    on_end: Callable[[Row], None] = lambda row: None,
) -> tuple[Row, ...]:
    """Run every dive that is not finished into `out`/NAME, each in a process of its own, and return all rows.

    A dive that fails leaves the others alone; those that were finished with the same settings are not touched.
    results.csv and results.html in `out` are written anew after every dive, logs are in `out`/logs. `on_end` is told
    of every dive that has ended. Raises UsageError where `out` cannot be used or the engine is not there.
    """
    check_names(found.dives)
    with output_folder(out), folder_lock(out):
        check_ours(out / "results.csv")
        table = _Table(found, out)
        to_do = [dive for dive in found.dives if not is_finished(dive, out, last_stage)]
        for dive in found.dives:
            table.set(row_of(dive, out, "waiting" if dive in to_do else "finished"))
        table.write()
        by_name = {dive.name: dive for dive in to_do}

        def ended(name: str, failure: Failure | None) -> None:
            row = row_of(by_name[name], out, "finished" if failure is None else "failed", failure)
            table.set(row)
            table.write()
            on_end(row)

        work = partial(run_dive, out=out.resolve(), last_stage=last_stage, redo=redo, map_device=map_device)
        run_tasks(work, to_do, engine, progress, "dives", logs=out / "logs", isolated=True, on_end=ended)
        return table.rows


def run_dive(dive: Dive, *, out: Path, last_stage: str, redo: bool, map_device: MapDevice) -> None:
    """The task of one dive: its run, which goes on from what its folder holds."""
    from swimm3r.pipeline.run import run_pipeline

    run_pipeline(
        dive.source,
        out / dive.name,
        dive.settings,
        redo=redo,
        reference=dive.reference,
        last_stage=last_stage,
        map_device=map_device,
        progress=silent,
    )


def check_outcome(rows: Sequence[Row], out: Path) -> None:
    """Raise BatchError where dives failed."""
    failed = [row for row in rows if row.status == "failed"]
    if not failed:
        return
    codes = {row.exit_code for row in failed}
    code = codes.pop() if len(codes) == 1 else None
    raise BatchError(
        f"{len(failed)} of {len(rows)} dives failed: {', '.join(row.name for row in failed)}",
        cause="; ".join(dict.fromkeys(row.error for row in failed)),
        hint=f"{out / 'results.html'} has the advice for each; the same command tries them again and leaves the others",
        exit_code=_SEVERAL if code is None else code,
    )


class _Table:
    """The rows of all dives, in their order, and the files that show them."""

    def __init__(self, found: FoundDives, out: Path) -> None:
        from swimm3r.batch import page

        self._page = page
        self._found, self._out = found, out
        self._shown: dict[str, page.Shown] = {}

    @property
    def rows(self) -> tuple[Row, ...]:
        return tuple(self._shown[dive.name].row for dive in self._found.dives)

    def set(self, row: Row) -> None:
        self._shown[row.name] = self._page.shown_row(row, self._out)

    def write(self) -> None:
        write_csv(self.rows, self._out / "results.csv")
        shown = [self._shown[dive.name] for dive in self._found.dives]
        self._page.write_page(shown, self._found.skipped, self._out)
