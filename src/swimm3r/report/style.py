"""The look of pages."""

import re
from importlib.resources import files

import jinja2
from markupsafe import Markup, escape


def style_sheet() -> str:
    """The CSS that every page of the package carries inside."""
    return files("swimm3r.report").joinpath("page.css").read_text(encoding="utf-8")


def page_template(source: str) -> jinja2.Template:
    """A page from its source; what is put in is escaped, and `x | commands` sets what x has in backticks as code."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["commands"] = _commands
    return environment.from_string(source)


def _commands(text: str) -> Markup:
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))
