"""Puts the page of a run together: what the run folder holds -> the template's fields."""

import base64
import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import jinja2
import numpy as np
import torch

from swimm3r.io import images
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy, damaged, first_line, guard
from swimm3r.io.view_names import view_stems
from swimm3r.medium import MediumFit, backscatter, transmittances
from swimm3r.prepare import load_frames
from swimm3r.report import charts
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.scene.reconstruction_io import load_reconstruction
from swimm3r.scene.run_folder import open_run
from swimm3r.sfm.medium.plausibility import any_determined, attenuation_is_a_guess

_SHOWN_FRAMES = 8
_SHOWN_TESTS = 4
_KINDS = ("rgb", "clear", "z_depth")
_EMBEDDED_BYTES = 6 << 20  # a video up to this size travels inside the page, a larger one lies beside it


@dataclass(frozen=True)
class Triptych:
    """One frame as data URIs: as filmed, without water, and its depth."""

    name: str
    raw: str
    restored: str | None
    depth: str | None


@dataclass(frozen=True)
class TestRow:
    """One frame that training did not see, as data URIs."""

    name: str
    taken: str
    rgb: str
    clear: str
    depth: str


def write(folder: Path) -> Path:
    """Write RUN/report.html and return its path. Raises InputError where there is no run, or its files are damaged."""
    summary = open_run(folder, "prepare").sections
    remedy = Remedy(f"swimm3r run {folder}, which writes it anew")
    with guard(folder / "settings.yaml", remedy):
        settings = (folder / "settings.yaml").read_text(encoding="utf-8")
    with guard(folder / "versions.json", remedy):
        versions = json.loads((folder / "versions.json").read_text(encoding="utf-8"))
        if not isinstance(versions, dict):
            raise ValueError("names and numbers of versions are expected")
    frames = load_frames(folder / "prepare")
    sfm = folder / "sfm"
    rec = load_reconstruction(sfm, frames) if (sfm / "reconstruction.json").is_file() else None
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True).from_string(
        files("swimm3r.report").joinpath("page.html.j2").read_text(encoding="utf-8")
    )
    fields = dict(
        title=Path(summary["input"]["path"]).name,
        summary=summary,
        warnings=summary.get("warnings", []),
        images=_triptychs(rec, frames, folder) if rec else [],
        tests=_test_rows(frames, folder) if "test" in summary else [],
        flight=_flight(folder / "renders" / "flythrough.mp4"),
        truths=_truth_rows(summary.get("truth")),
        plan=_plan(rec) if rec and rec.cloud is not None and len(rec.cloud.xyz) else None,
        water=_water(rec) if rec and rec.medium else None,
        guessed=rec is not None and rec.medium is not None and attenuation_is_a_guess(rec.medium),
        shown_as=_shown_as(rec.medium) if rec and rec.medium else "",
        missing=[name for name in frames.train.names if rec and name not in set(rec.names)],
        versions=versions,
        settings=settings,
    )
    try:
        page = template.render(fields)
    except (jinja2.UndefinedError, TypeError, ValueError) as error:  # a number is absent, or something else
        raise damaged(folder / "summary.json", first_line(error), remedy) from error
    path = folder / "report.html"
    write_text(path, page)
    return path


def _shown_as(fit: MediumFit) -> str:
    """Difference between the restored and the filmed frames, which depends on the knowledge of the water."""
    if attenuation_is_a_guess(fit):
        return "left as filmed: the water is not determined"
    return "without the water" + (", white-balanced for display" if any_determined(fit) else ", not white-balanced")


def _triptychs(rec: Reconstruction, frames: Frames, folder: Path) -> list[Triptych]:
    """A few registered frames, evenly spread over the dive."""
    chosen = sorted({round(i) for i in np.linspace(0, len(rec.names) - 1, _SHOWN_FRAMES)})
    names = [rec.names[i] for i in chosen]
    depths = {name: rec.depth[name].z_depth.numpy() for name in names if name in rec.depth}
    known = np.concatenate([z[z > 0] for z in depths.values()]) if depths else np.empty(0)
    near, far = np.quantile(known, [0.01, 0.99]) if known.size else (1.0, 2.0)
    rows = []
    for name in names:
        raw = (frames.image(frames.index(name)).numpy() * 255).round().astype(np.uint8)
        restored = folder / "sfm" / "restored" / f"{name}.png"
        rows.append(
            Triptych(
                name,
                images.jpeg_uri(raw),
                images.jpeg_uri(images.read_rgb(restored)) if restored.is_file() else None,
                images.jpeg_uri(charts.depth_image(depths[name], near, far)) if name in depths else None,
            )
        )
    return rows


def _test_rows(frames: Frames, folder: Path) -> list[TestRow]:
    """A few test frames, evenly spread, beside what the map shows from there."""
    names = frames.test.names
    chosen = sorted({round(i) for i in np.linspace(0, len(names) - 1, _SHOWN_TESTS)}) if names else []
    rows, stems = [], view_stems(frames.names)
    for name in (names[i] for i in chosen):
        taken = (frames.image(frames.index(name)).numpy() * 255).round().astype(np.uint8)
        seen = (images.read_rgb(folder / "renders" / "test" / f"{stems[name]}_{kind}.png") for kind in _KINDS)
        rows.append(TestRow(name, images.jpeg_uri(taken, 480), *(images.jpeg_uri(image, 480) for image in seen)))
    return rows


def _flight(path: Path) -> str | None:
    """The fly-through as a data URI, or its place beside the page where it is large; None without one."""
    if not path.is_file():
        return None
    if path.stat().st_size > _EMBEDDED_BYTES:
        return f"renders/{path.name}"
    return "data:video/mp4;base64," + base64.b64encode(path.read_bytes()).decode()


def _truth_rows(truth: dict | None) -> list[tuple[str, str, str]]:
    """Errors against the truth: name, of structure from motion, of the map."""
    if not truth:
        return []

    def text(value: object) -> str:
        match value:
            case float() | int():
                return f"{value:.4f}"
            case list():
                return " ".join("-" if v is None else f"{v:.4f}" for v in value)
            case _:
                return ""

    rows = [(name, text(value), "") for name, value in truth.items() if isinstance(value, float)]
    of_sfm, of_map = truth.get("sfm", {}), truth.get("splat", {})
    both = [name for name in {**of_sfm, **of_map} if not name.endswith("_reason")]
    return rows + [(name, text(of_sfm.get(name)), text(of_map.get(name))) for name in both]


def _plan(rec: Reconstruction) -> dict[str, str]:
    """The map from above, before and after, with the camera path."""
    assert rec.cloud is not None
    view = charts.plan_view(
        rec.cloud.xyz.numpy(),
        rec.cloud.raw.numpy(),
        rec.cloud.shown(rec.white_balance).numpy(),
        rec.cameras.cam2world.numpy(),
    )
    return {
        "raw": images.jpeg_uri(view.raw, 760, 90),
        "restored": images.jpeg_uri(view.restored, 760, 90),
        "overlay": charts.path_overlay(view),
        "unit": "metres" if rec.metric else "scene units",
    }


def _water(rec: Reconstruction) -> dict[str, object]:
    """The two curves a scientist looks for, in the encoding the pipeline fitted, and the open water's color."""
    assert rec.medium is not None
    fit = rec.medium
    unit = "m" if rec.metric else "scene units"
    return {
        "swatch": "rgb({:.0f},{:.0f},{:.0f})".format(*(fit.Binf * 255).tolist()),
        "backscatter": _chart(fit, "B(z), backscatter", unit, lambda z: backscatter(z, fit.at(z))),
        "transmittance": _chart(fit, "T_D(z), direct light kept", unit, lambda z: transmittances(z, fit.at(z))[0]),
        "tables": [_table(f, rec.metric) for f in (rec.medium_linear, rec.medium) if f is not None],
    }


def _table(fit: MediumFit, metric: bool) -> dict[str, object]:
    """The coefficients of one fit with their standard deviations; those the frames leave open are marked."""
    unit = "1/m" if metric else "per scene unit"
    labels = {
        "Binf": "veiling light Binf",
        "beta_D": f"attenuation beta_D at the median depth, {unit}",
        "beta_B": f"backscatter beta_B, {unit}",
    }
    rows = []
    for name, label in labels.items():
        values, errors = getattr(fit, name).tolist(), getattr(fit.std, name).tolist()
        known = fit.identifiable[name].tolist()
        cells = [{"text": f"{v:.3f} \u00b1 {e:.3f}", "known": k} for v, e, k in zip(values, errors, known, strict=True)]
        rows.append({"label": label, "cells": cells})
    return {"title": "in linear light" if fit.encoding == "linear" else "on stored pixel values", "rows": rows}


def _chart(fit: MediumFit, label: str, unit: str, law) -> str:
    z = torch.linspace(0, fit.z_range[1] * 1.25, 60)
    values = law(z).numpy()
    curves = [
        charts.Curve(z.numpy(), values[:, c], charts.CHANNELS[c], "RGB"[c], solid_until=fit.z_range[1])
        for c in range(3)
    ]
    return charts.line_chart(curves, f"ray depth z, {unit}", label)
