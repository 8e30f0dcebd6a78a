"""`swimm3r localize`: camera poses of images in a run's map."""

from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import Positional, arg

from swimm3r.cli.terminal.console import drawn_progress, outcome_console
from swimm3r.cli.terminal.options import FLAT, OutOrDefault, Run
from swimm3r.localization.settings import LocalizationSettings
from swimm3r.splat.settings import MapDevice


def localize(
    run: Run,
    images: Positional[Annotated[tuple[Path, ...], arg(metavar="[IMAGE ...]", help_behavior_hint="(optional)")]] = (),
    /,
    lens: Path | None = None,
    out: OutOrDefault = None,
    map_device: MapDevice = "auto",
    settings: Annotated[LocalizationSettings, FLAT] = LocalizationSettings(),  # noqa: B008
) -> None:
    """Find the camera poses of images in a run's map; without images, those of its test frames.

    Args:
        run: Run folder with a finished map.
        images: Images of the same place.
        lens: File cameras.json whose first camera took the images; by default they share the run's lens.
        out: Folder for poses.json, poses.tum and the match images; RUN/localization by default.
        map_device: Device that renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present.
        settings: The localization protocol.
    """
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.localization.batch import localize_run
    from swimm3r.localization.settings import with_checkpoint_of
    from swimm3r.pipeline.presets import from_yaml
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    settings = with_checkpoint_of(settings, from_yaml(run / "settings.yaml").sfm)
    with output_folder(out or run / "localization"), drawn_progress() as progress:
        answers, folder = localize_run(run, images, lens, out, settings, progress, map_device=map_device)
    table = Table("image", "pose", "inliers", "median error, px", "seconds")
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
