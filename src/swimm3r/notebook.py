"""Text and HTML that interpreters and notebooks show for a record, without scripts and links.

Any text may be given: it is escaped.
"""

from collections.abc import Sequence
from html import escape

_CELL = "padding:2px 10px;text-align:left"


def table(title: str, rows: Sequence[Sequence[str]], header: Sequence[str] = ()) -> str:
    """A small table below its title."""
    lines = [_row("th", header)] if header else []
    lines += [_row("td", row) for row in rows]
    return f'<div><b>{escape(title)}</b><table style="border-collapse:collapse">{"".join(lines)}</table></div>'


def image_row(title: str, images: Sequence[tuple[str, str]]) -> str:
    """Images side by side, each a data URI and its caption, below their title."""
    figures = "".join(
        f'<figure style="margin:4px"><img src="{escape(uri)}" alt="{escape(caption)}"/>'
        f'<figcaption style="font-size:small">{escape(caption)}</figcaption></figure>'
        for uri, caption in images
    )
    return f'<div><b>{escape(title)}</b><div style="display:flex;flex-wrap:wrap">{figures}</div></div>'


def shapes(record: object) -> str:
    """A record of arrays in one line: the shape of each, other values as they are."""
    values = ((name, getattr(value, "shape", value)) for name, value in vars(record).items())
    inner = ", ".join(f"{name}={list(value) if isinstance(value, tuple) else value!r}" for name, value in values)
    return f"{type(record).__name__}({inner})"


def channels(values: Sequence[float]) -> str:
    """Three numbers, red, green and blue, to three digits."""
    return "[" + ", ".join(f"{value:.3g}" for value in values) + "]"


def _row(kind: str, cells: Sequence[str]) -> str:
    return "<tr>" + "".join(f'<{kind} style="{_CELL}">{escape(cell)}</{kind}>' for cell in cells) + "</tr>"
