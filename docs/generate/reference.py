"""Pages of the site that are made and not written: the API reference, and the two documents of the repository's root.

Run by mkdocs-gen-files. The reference has one page per package of the source tree, made from the docstrings of its
modules by mkdocstrings; `reference/nav.md` lists them for mkdocs-literate-nav.
"""

from pathlib import Path

import mkdocs_gen_files

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "swimm3r"


def write(page: str, text: str) -> None:
    """Add a page to the site."""
    with mkdocs_gen_files.open(page, "w") as file:
        file.write(text)


def modules(package: Path) -> list[str]:
    """The dotted names of a package and of the modules directly in it."""
    name = ".".join(("swimm3r", *package.relative_to(PACKAGE).parts))
    files = sorted(package.glob("*.py"))
    return [name, *(f"{name}.{file.stem}" for file in files if not file.stem.startswith("__"))]


index = []
for package in sorted({file.parent for file in PACKAGE.rglob("__init__.py")}):
    names = modules(package)
    write(f"reference/{names[0]}.md", f"# {names[0]}\n\n" + "\n\n".join(f"::: {name}" for name in names) + "\n")
    depth = names[0].count(".")
    index.append(f"{'    ' * max(0, depth - 1)}* [{names[0].removeprefix('swimm3r.')}]({names[0]}.md)\n")
write("reference/nav.md", "".join(index))

for document in ("CONTRIBUTING.md", "CHANGELOG.md"):
    write(document.lower(), (ROOT / document).read_text(encoding="utf-8").replace("](docs/", "]("))
