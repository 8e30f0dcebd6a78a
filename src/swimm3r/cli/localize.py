"""`swimm3r localize`: camera poses of images, or of a stream of images, in a run's map."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.table import Table
from tyro.conf import Positional, arg

from swimm3r.cli.terminal.console import drawn_progress, outcome_console, print_line
from swimm3r.cli.terminal.options import FLAT, OutOrDefault, Run
from swimm3r.cli.terminal.output_level import is_quiet
from swimm3r.errors import UsageError
from swimm3r.localization.settings import LocalizationSettings, StreamSettings, TrackingSettings
from swimm3r.splat.settings import MapDevice

if TYPE_CHECKING:
    from swimm3r.localization.batch import Answer


def localize(
    run: Run,
    images: Positional[Annotated[tuple[Path, ...], arg(metavar="[IMAGE ...]", help_behavior_hint="(optional)")]] = (),
    /,
    stream: Path | None = None,
    lens: Path | None = None,
    rig_camera: str | None = None,
    out: OutOrDefault = None,
    tum: bool = False,
    map_device: MapDevice = "auto",
    settings: Annotated[LocalizationSettings, FLAT] = LocalizationSettings(),  # noqa: B008
    source: Annotated[StreamSettings, FLAT] = StreamSettings(),  # noqa: B008
    tracking: TrackingSettings = TrackingSettings(),  # noqa: B008
) -> None:
    """Find the camera poses of images or of a stream in a run's map; without either, those of its test frames.

    Args:
        run: Run folder with a finished map; structure from motion is enough for a stream.
        images: Images of the same place.
        stream: Folder of images (--follow if it is being written), video or ROS bag: a line of JSON per image.
        lens: File cameras.json whose first camera took the images; by default they share the run's lens.
        rig_camera: Camera of the run's rig that took the images; needed where its cameras have different lenses.
        out: Folder for poses.json, poses.tum and the match images; RUN/localization by default.
        tum: Write the poses of a stream to stream.tum, too.
        map_device: Device that renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present.
        settings: The localization protocol.
        source: The images of a stream.
        tracking: Localization of a stream.
    """
    if lens is not None and rig_camera is not None:
        raise UsageError(
            "both --lens and --rig-camera are given",
            cause="each says which lens the images were taken through",
            hint="one of the two",
        )
    if stream is not None:
        if images:
            raise UsageError(
                "both images and --stream are given",
                cause="single images are placed one by one, those of a stream each from the last pose",
                hint="one of the two",
            )
        _refuse(_changed(settings), "of single images, and --stream is given")
        if not source.follow:
            _refuse([word for word in _changed(source) if word in ("--idle", "--latest")], "of --follow")
        _stream(run, stream, lens, rig_camera, out or run / "localization", source, tracking, tum=tum)
        return
    _refuse([*_changed(source), *_changed(tracking, "tracking."), *["--tum"] * tum], "of --stream")
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.localization.batch import localize_run
    from swimm3r.localization.settings import with_checkpoint_of
    from swimm3r.pipeline.presets import from_yaml
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    settings = with_checkpoint_of(settings, from_yaml(run / "settings.yaml").sfm)
    with output_folder(out or run / "localization"), drawn_progress() as progress:
        answers, folder = localize_run(
            run, images, lens, out, settings, progress, map_device=map_device, rig_camera=rig_camera
        )
    outcome_console().print(_table(answers))
    print(f"Poses: {folder}")


def _changed(given: Any, prefix: str = "") -> list[str]:
    """The options of a record that are not as by default, as they are typed."""
    default = type(given)()
    names = [one.name for one in fields(given) if getattr(given, one.name) != getattr(default, one.name)]
    return [f"--{prefix}{name.replace('_', '-')}" for name in names]


def _refuse(options: Sequence[str], kind: str) -> None:
    """Raises UsageError for options that would change nothing."""
    if options:
        raise UsageError(
            f"{', '.join(options)}: only an option {kind}",
            cause="single images, streams and followed folders are localized with options of their own",
            hint="swimm3r localize --help-all, which lists them",
        )


def _table(answers: "Sequence[Answer]") -> Table:
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
    return table


def _stream(
    run: Path,
    stream: Path,
    lens: Path | None,
    rig_camera: str | None,
    out: Path,
    source: StreamSettings,
    tracking: TrackingSettings,
    *,
    tum: bool,
) -> None:
    """Localize a stream: its lines on stdout, everything else on stderr."""
    from swimm3r.cameras import cameras_of
    from swimm3r.io import cameras_json
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.localization.lenses import lens_of_camera
    from swimm3r.localization.online.images import stream_images
    from swimm3r.localization.online.landmark_file import landmarks_of_run
    from swimm3r.localization.online.stream import localize_stream
    from swimm3r.localization.online.tracker import Tracker
    from swimm3r.pipeline.presets import from_yaml
    from swimm3r.scene.reconstruction_io import load_reconstruction
    from swimm3r.scene.run_folder import open_run
    from swimm3r.sfm.rectified.run import run_frames

    open_run(run, "sfm")
    own = None if lens is None else cameras_of(cameras_json.read_cameras(lens))[0]
    images = stream_images(stream, source)
    with output_folder(out):
        if rig_camera is not None:
            frames = run_frames(run)
            own = lens_of_camera(load_reconstruction(run / "sfm", frames), frames, rig_camera)
        with drawn_progress() as progress:
            landmarks = landmarks_of_run(run, from_yaml(run / "settings.yaml").sfm.features, progress)
        say = (lambda _: None) if is_quiet() else (lambda line: print(line, flush=True))
        tracker = Tracker(landmarks, tracking)
        outcome = localize_stream(tracker, images, out, own, say, live=source.follow, tum=tum)
    print_line(f"{outcome}. Poses: {out / 'stream.jsonl'}")
    if outcome.interrupted and not source.follow:
        raise KeyboardInterrupt
