"""Scores in plain words: the map on held-out frames, restored colors, known truth, and the training of the map."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swimm3r.io.files.metrics_log import read_rows
from swimm3r.report import charts
from swimm3r.report.head import Figure

_MISSING = "\u2013"
TRUTH_LABELS = {  # key of summary.json -> name, unit, factor, decimals
    "rotation_deg": ("Rotation between frames, mean error", "\u00b0", 1, 3),
    "rotation_median_deg": ("Rotation of a frame, median error", "\u00b0", 1, 3),
    "translation_deg": ("Direction of translation, mean error", "\u00b0", 1, 3),
    "ate": ("Trajectory, root mean square error", " units of the truth", 1, 4),
    "depth_absrel": ("Depth, mean relative error", " %", 100, 2),
    "depth_coverage": ("Pixels with a depth", " %", 100, 1),
    "clear_psnr": ("Colors without the water, PSNR", " dB", 1, 1),
    "clear_psnr_observed": ("The same, of what training frames saw", " dB", 1, 1),
    "T_D_abs": ("Share of light kept T_D, mean error (red, green, blue)", "", 1, 3),
    "B_abs": ("Backscatter B, mean error (red, green, blue)", "", 1, 3),
    "Binf_abs": ("Veiling light Binf, error (red, green, blue)", "", 1, 3),
    "beta_D_rel": ("Attenuation beta_D, relative error (red, green, blue)", " %", 100, 1),
    "beta_B_rel": ("Backscatter rate beta_B, relative error (red, green, blue)", " %", 100, 1),
    "psnr_moving": ("Where something moves, PSNR", " dB", 1, 1),
    "psnr_still": ("Where nothing moves, PSNR", " dB", 1, 1),
}
_SMOOTHED = 0.02  # of the training, over which the loss is averaged


@dataclass(frozen=True)
class TruthRow:
    """One score against the truth, of structure from motion and of the map; text is empty where it does not apply."""

    label: str
    of_sfm: str
    of_map: str


def test_figures(summary: dict[str, Any]) -> list[Figure]:
    """The scores of the frames that training did not see."""
    test, splat = summary["test"], summary["splat"]
    made = Figure(f"{splat['primitives']:,}", "Primitives", f"{splat['iterations']:,} steps, recipe {splat['recipe']}")
    if not test["views"]:
        return [Figure(_MISSING, "Scores of test frames", test["psnr_reason"]), made]
    blurred = f"blurring the frames by 4 px would score {_number(test['blur4_psnr'], 1)} dB"
    return [
        Figure(f"{_number(test['psnr'], 1)} dB", "PSNR, higher is better", blurred + _unplaced(test)),
        Figure(_number(test["ssim"], 3), "SSIM, at most 1"),
        Figure(_number(test["lpips"], 3), "LPIPS, lower is better", test.get("lpips_reason") or ""),
        Figure(f"{_number(test['sharpness'], 0, 100)} %", "Sharpness of the frames kept"),
        *_observed_figures(test),
        *_registration_figures(test),
        made,
    ]


def _unplaced(test: dict[str, Any]) -> str:
    """The test frames that no registered frame tells the place of."""
    count = len(test.get("unplaced", ()))
    return f"; {count} of {count + test['views']} test frames could not be placed and are not scored" if count else ""


def _observed_figures(test: dict[str, Any]) -> list[Figure]:
    """The score of what training frames saw, and how much that is; nothing of maps that do not know."""
    if not isinstance(test.get("observed"), float):
        return []
    sharp = test.get("sharpness_observed")
    detail = "" if sharp is None else f", {_number(sharp, 0, 100)} % as sharp as these"
    rest = f"{_number(test['observed'], 0, 100)} % of the test frames{detail}; the rest is hatched in the pictures"
    return [Figure(f"{_number(test['psnr_observed'], 1)} dB", "PSNR of what training frames saw", rest)]


def _registration_figures(test: dict[str, Any]) -> list[Figure]:
    """Displacement and colors apart; nothing of runs that were scored before both were taken."""
    if "flow_px" not in test:
        return []
    far = f"a tenth of the ground is off by more than {_number(test['flow_px_p90'], 2)} px"
    colors = "on measured ground, after each view's colors were fitted to its frame"
    return [
        Figure(f"{_number(test['flow_px'], 2)} px", "Displacement, median", test.get("flow_px_reason") or far),
        Figure(f"{_number(test['psnr_affine'], 1)} dB", "PSNR, recolored", test.get("psnr_affine_reason") or colors),
    ]


def appearance_note(summary: dict[str, Any]) -> str:
    """A sentence on exposure and white balance of the frames; empty of maps without the decision."""
    decided = summary.get("splat", {}).get("appearance")
    if not decided:
        return ""
    means = "Every frame has a color map of its own" if decided["on"] else "Frames have no color maps of their own"
    return f"{means}: {decided['reason']}."


def restored_notes(summary: dict[str, Any]) -> list[str]:
    """One sentence per set of restored images on their scores without a reference."""
    sets = (("sfm", "restored frames"), ("splat", "the map's views without the water"))
    found = []
    for part, of in sets:
        scores = summary["restored"].get(part)
        if scores is None or scores["uiqm"] is None:
            continue
        shown = scores["shown"]
        balanced = ""
        if shown["uiqm"] is not None:
            balanced = f"; white-balanced, as displayed here, {shown['uiqm']:.3f} and {shown['uciqe']:.2f}"
            balanced += ", which do not compare between methods"
        found.append(
            f"Scores without reference, {of}: in physical colors UIQM {scores['uiqm']:.3f}, UCIQE"
            f" {scores['uciqe']:.2f}{balanced}."
        )
    return found


def other_notes(summary: dict[str, Any]) -> list[str]:
    """One sentence per further protocol that the map was scored by."""
    return [
        f"By another protocol, {name}: PSNR {_number(other['test']['psnr'], 1)} dB, SSIM"
        f" {_number(other['test']['ssim'], 3)}; {other['test']['protocol']}."
        for name, other in summary.get("other_protocols", {}).items()
    ]


def truth_rows(truth: dict[str, Any] | None) -> list[TruthRow]:
    """Errors against the truth, in plain words."""
    if not truth:
        return []
    of_sfm, of_map = truth.get("sfm", {}), truth.get("splat", {})
    rows = [
        TruthRow(TRUTH_LABELS[key][0], _truth_text(key, truth.get(key)), "") for key in TRUTH_LABELS if key in truth
    ]
    for key in TRUTH_LABELS:
        if key in of_sfm or key in of_map:
            rows.append(
                TruthRow(TRUTH_LABELS[key][0], _truth_text(key, of_sfm.get(key)), _truth_text(key, of_map.get(key)))
            )
    refined = truth.get("refined_poses", {})
    rows += [
        TruthRow(f"{TRUTH_LABELS[key][0]}, poses refined with the map", "", _truth_text(key, refined[key]))
        for key in TRUTH_LABELS
        if key in refined
    ]
    return rows


def training_charts(metrics: Path) -> list[str]:
    """SVGs of the loss and of the number of primitives over the training; none without its record."""
    rows = [row for row in read_rows(metrics) if all(_is_number(row.get(key)) for key in ("loss", "primitives"))]
    if len(rows) < 3:
        return []
    steps, loss, count = (np.array([float(row[key]) for row in rows]) for key in ("step", "loss", "primitives"))
    width = min(len(rows), max(1, round(_SMOOTHED * len(rows))) * 2 + 1)
    smooth = np.convolve(np.pad(loss, width // 2, mode="edge"), np.ones(width) / width, "valid")[: len(rows)]
    accent = "var(--accent)"
    return [
        charts.line_chart([charts.Curve(steps, smooth, accent, "loss, averaged")], "training step", "loss, no unit"),
        charts.line_chart(
            [charts.Curve(steps, count / 1000, accent, "primitives")], "training step", "primitives, thousands"
        ),
    ]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _truth_text(key: str, value: object) -> str:
    _, unit, factor, decimals = TRUTH_LABELS[key]
    match value:
        case float() | int():
            return f"{value * factor:.{decimals}f}{unit}"
        case list():
            numbers = ", ".join(_number(each, decimals, factor) for each in value)
            return f"{numbers}{unit}" if any(each is not None for each in value) else "not determined"
        case _:
            return _MISSING


def _number(value: float | None, decimals: int, factor: float = 1.0) -> str:
    return _MISSING if value is None else f"{value * factor:.{decimals}f}"
