"""summary.json of a run in a few lines of the terminal, section by section (layout: docs/conventions.md)."""

from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.table import Table

from swimm3r.cli.terminal.console import outcome_console


def print_summary(summary: dict[str, Any]) -> None:
    """The outcome of a run: registered frames, the water, scores, and warnings; of stages that it has."""
    console = outcome_console()
    for name, show in _SECTIONS.items():
        if summary.get(name):
            show(console, summary[name])


def _frames(console: Console, taken: dict) -> None:
    if "frames" not in taken:
        return
    masks = f", {taken['masks']['used']} with a mask" if taken.get("masks", {}).get("used") else ""
    between = f", {taken['between']} between keyframes" if taken.get("between") else ""
    kind = "rectified frames" if taken.get("rectified") or taken.get("rows_rectified") else "frames"
    console.print(
        f"{taken['frames']} {kind} of {taken['width']}x{taken['height']} ({taken['train']} for training,"
        f" {taken['test']} for testing{between}{masks})"
    )


def _poses(console: Console, sfm: dict) -> None:
    console.print(
        f"Registered {sfm['registered']} of {sfm['frames']} frames, {sfm['points']:,} points, "
        + (f"{sfm['between_placed']} of {sfm['between']} between keyframes, " if sfm.get("between") else "")
        + ("" if sfm["reprojection_px"] is None else f"reprojection error {sfm['reprojection_px']:.2f} px")
    )


def _scale(console: Console, scale: dict) -> None:
    by = ", ".join(each["source"] for each in scale["sources"] if not each["outlier"])
    place = scale["georeference"]["crs"]
    console.print(f"Lengths in metres, ± {100 * scale['std']:.2g}% by {by}; coordinates: {place}")
    for note in scale["notes"]:
        console.print("!", note, style="yellow")


def _water(console: Console, medium: dict) -> None:
    water = medium.get("sfm")
    if not water:
        return
    table = Table("water", "R", "G", "B", title=f"betas {water['unit']}, {water['encoding']} values")
    for name in ("Binf", "beta_D", "beta_B"):
        cells = (
            f"{value:.3f}" if known else f"({value:.3f})"
            for value, known in zip(water[name], water["identifiable"][name], strict=True)
        )
        table.add_row(name, *cells)
    console.print(table)
    console.print("In brackets: not determined by these frames.", style="dim")


def _scores(console: Console, test: dict) -> None:
    if unplaced := test.get("unplaced"):
        console.print(f"Not scored, as no frame near them is registered: {', '.join(unplaced)}")
    if not test["views"]:
        return
    console.print(
        f"{test['views']} test {'frame' if test['views'] == 1 else 'frames'}: PSNR {_number(test['psnr'], 1)} dB"
        f" (if blurred by 4 px: {_number(test['blur4_psnr'], 1)}), SSIM {_number(test['ssim'], 3)},"
        f" sharpness {_number(test['sharpness'], 2)}"
    )
    if test.get("psnr_observed") is not None and round(100 * test["observed"]) < 100:
        console.print(
            f"Of the test frames, training frames saw {_number(100 * test['observed'], 0)} %: PSNR"
            f" {_number(test['psnr_observed'], 1)} dB, sharpness {_number(test['sharpness_observed'], 2)}"
        )
    if "flow_px" in test:
        console.print(
            f"On measured ground: displacement {_number(test['flow_px'], 2)} px (90 % below"
            f" {_number(test['flow_px_p90'], 2)}), PSNR {_number(test['psnr_covered'], 1)} dB,"
            f" {_number(test['psnr_affine'], 1)} dB with each view's colors fitted to its frame"
        )


def _other_scores(console: Console, protocols: dict) -> None:
    for name, other in protocols.items():
        scores = other["test"]
        console.print(
            f"By the protocol {name}: PSNR {_number(scores['psnr'], 1)} dB, SSIM {_number(scores['ssim'], 3)}"
        )


def _warnings(console: Console, warnings: list) -> None:
    for warning in warnings:
        console.print("!", f"{warning['what']} {warning['advice']}".strip(), style="yellow")


_SECTIONS: dict[str, Callable[[Console, Any], None]] = {  # in the order in which they are printed
    "input": _frames,
    "sfm": _poses,
    "scale": _scale,
    "medium": _water,
    "test": _scores,
    "other_protocols": _other_scores,
    "warnings": _warnings,
}


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
