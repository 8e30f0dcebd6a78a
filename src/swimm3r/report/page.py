"""Puts the page of a run together: contents of the run folder -> fields of the template -> one file."""

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from swimm3r.io import images
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy, damaged, first_line, guard
from swimm3r.io.video import Video
from swimm3r.report import frames as shown_frames
from swimm3r.report import head, outputs, scale, scores, verdict, water
from swimm3r.report.maps import map_section
from swimm3r.report.plan_view import path_overlay, plan_view
from swimm3r.report.rig import rig_section
from swimm3r.report.scene import pack_scene, shown_points
from swimm3r.report.style import page_template, style_sheet
from swimm3r.scene.frames import Frames, rows_of_one_camera
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.rectified.run import has_rectified_rows, is_rectified, run_frames
from swimm3r.weights.manifest import MANIFEST

_EMBEDDED_BYTES = 6 << 20  # a video up to this size travels inside the page, a larger one lies beside it
_DEEP = (8, 29, 38)  # background of the view from above
_STAGES = {
    "prepare": "Frames",
    "sfm": "Structure from motion, depth and water",
    "splat": "Map",
    "eval": "Scores, flight and report",
}


def write(folder: Path) -> Path:
    """Write RUN/report.html and return its path. Raises InputError where there is no run, or its files are damaged."""
    summary = open_run(folder, "prepare").sections
    remedy = Remedy(f"swimm3r run {folder}, which writes it anew")
    frames = run_frames(folder)
    sfm = folder / "sfm"
    rec = load_reconstruction(sfm, frames) if (sfm / "reconstruction.json").is_file() else None
    fields = _made_with(folder, remedy) | _of_dive(frames, rec, folder)
    if "test" in summary:
        fields["tests"] = shown_frames.test_frames(frames, folder, summary["test"].get("unplaced", ()))
    try:
        fields |= _of_summary(summary, folder) | {"rig": rig_section(summary, frames)}
        page = page_template(_part("page.html.j2")).render(fields)
    except (jinja2.UndefinedError, TypeError, ValueError, KeyError, AttributeError) as error:
        raise damaged(folder / "summary.json", first_line(error), remedy) from error
    path = folder / "report.html"
    write_text(path, page)
    return path


def _of_summary(summary: dict[str, Any], folder: Path) -> dict[str, object]:
    """Fields that are told by summary.json alone. Raises what a summary of another form causes."""
    sfm = summary.get("sfm")
    return {
        "title": Path(summary["input"]["path"]).name,
        "warnings": [(warning["what"], warning["advice"]) for warning in summary.get("warnings", [])],
        "head_figures": head.head_figures(summary),
        "test_figures": scores.test_figures(summary) if "test" in summary else [],
        "test_protocol": summary["test"]["protocol"] if "test" in summary else "",
        "appearance": scores.appearance_note(summary),
        "notes": [*scores.restored_notes(summary), *scores.other_notes(summary)] if "restored" in summary else [],
        "training": [Markup(svg) for svg in scores.training_charts(folder / "splat" / "metrics.jsonl")],
        "scale": scale.scale_section(summary),
        "metric_water": scale.metric_water(summary),
        "truths": scores.truth_rows(summary.get("truth")),
        "stages": [
            (title, head.clock(stage["seconds"]), head.clock(stage["cpu_seconds"]), _megabytes(stage["peak_mb"]))
            for name, title in _STAGES.items()
            if (stage := summary["stages"].get(name)) is not None and stage["status"] == "done"
        ],
        "weights_license": _weights_license(None if sfm is None else sfm["backend"]),
    }


def _of_dive(frames: Frames, rec: Reconstruction | None, folder: Path) -> dict[str, object]:
    """Fields of the frames and of what structure from motion made of them."""
    rectified, rows_rectified = is_rectified(folder), has_rectified_rows(folder)
    found: dict[str, object] = {
        "size_of_dive": head.size_of_dive(frames, rectified=rectified or rows_rectified),
        "rectified": rectified,
        "rows_rectified": rows_rectified,
        "dated": head.dated(frames, folder),
        "verdict": "The run has no structure from motion yet.",
        "restored_as": "",
        "images": shown_frames.frames_only(frames) if rec is None else [],
        "tests": [],
        "moving": [],
        "bar": None,
        "scene": None,
        "plan": None,
        "maps": map_section(folder),
        "water": None,
        "missing": [],
        "flight": _flight(folder / "renders" / "flythrough.mp4"),
        "outputs": outputs.outputs_of(folder),
    }
    if rec is None:
        return found
    near_far = shown_frames.depth_limits(rec)
    restored_as = "" if rec.medium is None else water.restored_as(rec.medium)
    placed = set(rec.names)
    return found | {
        "verdict": verdict.water_verdict(rec.medium_linear or rec.medium, metric=rec.metric, gray=frames.gray),
        "restored_as": restored_as,
        "images": shown_frames.dive_frames(rec, frames, folder, near_far, restored_as),
        "moving": shown_frames.moving_objects(rec, frames),
        "bar": None if near_far is None else shown_frames.depth_bar(near_far, rec.metric),
        "scene": pack_scene(rec, frames),
        "plan": _plan(rec, frames),
        "water": water.water_section(rec),
        "missing": [name for name in frames.train.names if name not in placed],
    }


def _made_with(folder: Path, remedy: Remedy) -> dict[str, object]:
    """The settings and versions of the run, and the page's own style and scripts."""
    with guard(folder / "settings.yaml", remedy):
        settings = (folder / "settings.yaml").read_text(encoding="utf-8")
    with guard(folder / "versions.json", remedy):
        versions = json.loads((folder / "versions.json").read_text(encoding="utf-8"))
        if not isinstance(versions, dict):
            raise ValueError("names and numbers of versions are expected")
    return {
        "settings": settings,
        "versions": versions,
        "style": Markup(style_sheet()),
        "script": Markup(_part("page.js")),
        "scene_script": Markup(_part("scene.js")),
    }


def _plan(rec: Reconstruction, frames: Frames) -> dict[str, object] | None:
    """The scene from above, as filmed and without the water, with the camera path; None without points."""
    points = shown_points(rec)
    if points is None:
        return None
    restored = points.filmed if points.restored is None else points.restored
    poses, path = rec.cameras.cam2world.numpy(), rows_of_one_camera(rec.names, frames)
    view = plan_view(points.xyz, points.filmed, restored, poses, background=_DEEP, path=path)
    return {
        "filmed": images.jpeg_uri(view.raw, 760, 88),
        "restored": None if points.restored is None else images.jpeg_uri(view.restored, 760, 88),
        "overlay": Markup(path_overlay(view, "m" if rec.metric else "scene units")),
    }


def _flight(path: Path) -> dict[str, str] | None:
    """The fly-through and a poster of it: inside the page, or beside it where it is large; None without one."""
    if not path.is_file():
        return None
    video = Video(path)
    poster = next(video.frames(start=(video.seconds or 0.0) / 3), None) or next(video.frames())
    uri = f"renders/{path.name}"
    if path.stat().st_size <= _EMBEDDED_BYTES:
        uri = "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode()
    return {"uri": uri, "poster": images.jpeg_uri(poster.rgb(), 960, 82)}


def _weights_license(backend: str | None) -> str:
    """The license of the network that placed the frames; empty where none did."""
    if backend not in ("mast3r", "swimm3r"):
        return ""
    return next(entry.license for entry in MANIFEST if entry.name == "mast3r")


def _megabytes(count: float | None) -> str:
    return "\u2013" if count is None else f"{count:,} MB"


def _part(name: str) -> str:
    """A file that lies beside this one."""
    return files("swimm3r.report").joinpath(name).read_text(encoding="utf-8")
