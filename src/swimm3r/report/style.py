"""The look of pages."""

from importlib.resources import files


def style_sheet() -> str:
    """The CSS that every page of the package carries inside."""
    return files("swimm3r.report").joinpath("page.css").read_text(encoding="utf-8")
