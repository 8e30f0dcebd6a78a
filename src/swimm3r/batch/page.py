"""results.html: one row per dive with a frame, its restored version, scores, warnings and the link to its report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from swimm3r.batch.dives import Skipped
from swimm3r.batch.results import Row
from swimm3r.errors import InputError
from swimm3r.io import images
from swimm3r.io.files.atomic import write_text
from swimm3r.report.frames import filmed
from swimm3r.report.head import clock
from swimm3r.report.style import page_template, style_sheet
from swimm3r.scene.run_folder import MARKERS, is_run, read_run
from swimm3r.sfm.rectified.run import run_frames

_LONG_SIDE, _QUALITY = 320, 78  # of thumbnails: pixels, and JPEG's


@dataclass(frozen=True)
class Shown:
    """A row with what the page shows beside its numbers."""

    row: Row
    filmed: str = ""  # data URIs; empty where there is none
    restored: str = ""
    warnings: tuple[tuple[str, str], ...] = ()
    report: str = ""

    @property
    def scores(self) -> dict[str, str]:
        """The numbers by the heads of their columns."""
        row = self.row
        placed = "" if row.registered is None else f"{row.registered:,} placed"
        return {
            "Frames": "" if row.frames is None else f"{row.frames:,}" + (f", {placed}" if placed else ""),
            "PSNR": "" if row.psnr is None else f"{row.psnr:.1f} dB",
            "SSIM": "" if row.ssim is None else f"{row.ssim:.3f}",
            "Sharpness": "" if row.sharpness is None else f"{row.sharpness:.2f}",
            "Processor time": "" if row.cpu_seconds is None else clock(row.cpu_seconds),
            "Peak memory": "" if row.peak_mb is None else f"{row.peak_mb:,} MB",
        }


def shown_row(row: Row, out: Path) -> Shown:
    """The row of a dive with its thumbnails, which are read from its run folder."""
    folder = out / row.name
    if not is_run(folder) or not (folder / MARKERS["prepare"]).is_file():
        return Shown(row)
    try:
        shown = Shown(row, *_thumbnails(folder))
    except InputError:  # damaged: its own run says so, and the others go on
        return Shown(row)
    if (folder / "report.html").is_file():
        shown = replace(shown, report=f"{quote(row.name)}/report.html")
    if row.registered is None:
        return shown
    warnings = read_run(folder).sections.get("warnings", ())
    return replace(shown, warnings=tuple((one["what"], one["advice"]) for one in warnings))


def write_page(rows: Sequence[Shown], skipped: Sequence[Skipped], out: Path) -> Path:
    """Write OUT/results.html, which asks no network, and return its path."""
    count: Mapping[str, int] = {
        status: sum(shown.row.status == status for shown in rows) for status in ("finished", "failed", "waiting")
    }
    template = page_template(files("swimm3r.batch").joinpath("results.html.j2").read_text(encoding="utf-8"))
    path = out / "results.html"
    page = template.render(
        title=out.resolve().name,
        rows=rows,
        count=count,
        skipped=skipped,
        verdict=_verdict(count),
        version=version("swimm3r"),
        style=Markup(style_sheet()),
    )
    write_text(path, page)
    return path


def _verdict(count: Mapping[str, int]) -> str:
    whole = sum(count.values())
    told = f"{count['finished']} of {whole} dive{'s' * (whole != 1)} finished"
    others = [f"{count[status]} {status}" for status in ("failed", "waiting") if count[status]]
    return f"{', '.join([told, *others])}."


def _thumbnails(folder: Path) -> tuple[str, str]:
    """The middle one of the restored frames as filmed and restored; without any, the middle frame of all."""
    frames = run_frames(folder)
    restored = [name for name in frames.names if (folder / "sfm" / "restored" / f"{name}.png").is_file()]
    names = restored or list(frames.names)
    if not names:
        return "", ""
    name = names[len(names) // 2]
    path = folder / "sfm" / "restored" / f"{name}.png"
    return _uri(filmed(frames, name)), _uri(images.read_rgb(path)) if restored else ""


def _uri(image: np.ndarray) -> str:
    return images.jpeg_uri(image, _LONG_SIDE, _QUALITY)
