"""The repository's documents and text files, and how links in them are read."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCUMENTS = tuple(
    sorted(
        [
            *ROOT.glob("*.md"),
            *ROOT.glob("docs/**/*.md"),
            *ROOT.glob("benchmarks/**/*.md"),
            *ROOT.glob("examples/**/*.md"),
            *ROOT.glob(".github/**/*.md"),
        ]
    )
)
_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`[^`\n]*`")
_LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#+ +(.+?) *#*$", re.MULTILINE)


def links(document: Path) -> list[str]:
    """The targets of a document's links and images, outside code."""
    return _LINK.findall(_CODE.sub("", _FENCE.sub("", document.read_text(encoding="utf-8"))))


def anchors(document: Path) -> set[str]:
    """The anchors of a document's headings, as GitHub and the site make them."""
    headings = _HEADING.findall(_FENCE.sub("", document.read_text(encoding="utf-8")))
    return {anchor(heading) for heading in headings}


def anchor(heading: str) -> str:
    """The anchor of one heading: lower case, without punctuation, hyphens for spaces."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
    return re.sub(r"[^\w\- ]", "", text.lower()).strip().replace(" ", "-")


def broken(target: str, document: Path) -> str | None:
    """The reason why a relative link leads nowhere; None for one that is right or leaves the repository."""
    if re.match(r"[a-z]+:", target):
        return None
    name, _, fragment = target.partition("#")
    path = (document.parent / name).resolve() if name else document
    if not path.is_relative_to(ROOT):
        return f"{target} leaves the repository"
    if not path.exists():
        return f"{target}: no such file"
    if fragment and fragment not in anchors(path):
        return f"{target}: no such heading"
    return None
