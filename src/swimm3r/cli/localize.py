"""`swimm3r localize`: where images were taken, in a run's map."""

from pathlib import Path

from rich.table import Table
from tyro.conf import Positional

from swimm3r.cli.terminal.console import drawn_progress, outcome_console
from swimm3r.localization.settings import LocalizationSettings


def localize(
    run: Positional[Path],
    images: Positional[tuple[Path, ...]] = (),
    /,
    lens: Path | None = None,
    out: Path | None = None,
    settings: LocalizationSettings = LocalizationSettings(),  # noqa: B008
) -> None:
    """Find where images were taken in a run's map; without images, its test frames.

    Args:
        run: the run folder.
        images: images of the same place.
        lens: a cameras.json whose first camera is the images' own; otherwise they share the run's lens.
        out: where poses.json, poses.tum and the match images go; RUN/localization otherwise.
        settings: the protocol.
    """
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.localization.batch import localize_run
    from swimm3r.localization.settings import with_checkpoint_of
    from swimm3r.pipeline.presets import from_yaml
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    settings = with_checkpoint_of(settings, from_yaml(run / "settings.yaml").sfm)
    with output_folder(out or run / "localization"), drawn_progress() as progress:
        answers, folder = localize_run(run, images, lens, out, settings, progress)
    table = Table("image", "place", "inliers", "median error, px", "seconds")
    for a in answers:
        if a.found is None:
            table.add_row(a.name, "not found", "", "", "")
            continue
        inliers = (
            f"{a.found.inliers} of {a.found.matches}" if a.found.stage == "refined" else str(a.found.coarse_inliers)
        )
        error = "" if a.found.reprojection_px is None else f"{a.found.reprojection_px:.2f}"
        table.add_row(a.name, a.found.stage, inliers, error, f"{sum(a.found.seconds.values()):.1f}")
    outcome_console().print(table)
    print(f"Poses: {folder}")
