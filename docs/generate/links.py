"""Links that differ between the repository and the site; a hook of mkdocs.

A name in backticks that begins with the package's own, as in `swimm3r.medium.add_water`, becomes a cross-reference into
the API reference. The build is strict, so a name that the reference does not hold fails it. Links to the documents of
the repository's root lead to their pages of the site.
"""

import re
from typing import Any

FENCE = re.compile(r"^(```.*?^```$)", re.MULTILINE | re.DOTALL)
ROOT_DOCUMENT = re.compile(r"\]\(((?:\.\./)*)\.\./(CONTRIBUTING|CHANGELOG)\.md")
NAME = re.compile(r"`(swimm3r(?:\.\w+)+)`")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The text of a page with its links; names in code blocks and in the reference itself stay as they are."""
    if page.file.src_uri.startswith("reference/"):
        return markdown
    markdown = ROOT_DOCUMENT.sub(lambda link: f"]({link[1]}{link[2].lower()}.md", markdown)
    parts = FENCE.split(markdown)
    return "".join(part if part.startswith("```") else NAME.sub(r"[`\1`][\1]", part) for part in parts)
