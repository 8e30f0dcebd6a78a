"""Links between documents: every one leads somewhere, and every file that a text names exists."""

import ast
import re
from pathlib import Path

import pytest
from tests.docs.documents import DOCUMENTS, ROOT, anchor, broken, links

TEXTS = tuple(
    path
    for folder in ("src", "tests", "benchmarks", "docs", "examples", ".github")
    for path in sorted((ROOT / folder).rglob("*"))
    if path.suffix in (".py", ".md", ".yml", ".toml", ".ipynb", ".j2") and path != Path(__file__)
) + tuple(path for path in sorted(ROOT.iterdir()) if path.is_file() and path.suffix in (".md", ".toml", ".yml", ""))
CITED = re.compile(r"(?<![\w./-])((?:[\w.-]+/)+[\w.-]+\.(?:md|py|toml|yml|ipynb))(?:#([\w-]+))?(?![\w/])")
DOCUMENT = re.compile(r"(?<![\w./<-])([\w-]+\.md)(?!\w)")
TABLES = ("NAME", "ablation", "ablation-sfm", "flsea", "localization", "render", "restoration", "scale", "sfm")
MADE = {f"{name}.md" for name in TABLES} | {"nav.md", "contributing.md", "changelog.md"}
"""Documents that `swimm3r bench` and the site's build write."""
HOMES = (ROOT, ROOT / "src" / "swimm3r", ROOT / "tests", ROOT / "docs", ROOT / "benchmarks")


def citations(text: str) -> list[tuple[str, str]]:
    """Files that a text names by path, with the heading that it names, if any."""
    return CITED.findall(text)


def missing(path: str, fragment: str, home: Path) -> bool:
    """Return whether no file of the repository has this path, seen from a text's folder or one that paths begin at."""
    found = [base / path for base in (home, *HOMES) if (base / path).is_file()]
    return not found or (bool(fragment) and broken(f"{found[0]}#{fragment}", found[0]) is not None)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file_and_a_heading(document: Path):
    assert [reason for target in links(document) if (reason := broken(target, document))] == []


def test_every_file_that_a_text_names_is_in_the_repository():
    assert len(TEXTS) > 400
    known, wrong = MADE | {document.name for document in DOCUMENTS}, []
    for source in TEXTS:
        text = source.read_text(encoding="utf-8")
        for path, fragment in citations(text):
            if missing(path, fragment, source.parent) and not _of_a_user(path):
                wrong.append(f"{source.relative_to(ROOT)}: {path}{'#' * bool(fragment)}{fragment}")
        wrong += [f"{source.relative_to(ROOT)}: {name}" for name in DOCUMENT.findall(text) if name not in known]
    assert wrong == []


def test_no_text_names_the_folders_that_only_its_authors_have():
    outside = re.compile(r"\.\./shared|(?<![\w/-])(?:spec|paper)/|\b(?:DESIGN|HOUSE|STYLE)\b")
    assert [str(source.relative_to(ROOT)) for source in TEXTS if outside.search(source.read_text("utf-8"))] == []


def _of_a_user(path: str) -> bool:
    """Files that commands, tests or users make, in folders of their own, and placeholders."""
    return Path(path).stem == "NAME" or path.split("/")[0] in ("RUN", "OUT", "DIR", "runs", "tables", "reference")


def test_a_broken_link_and_a_missing_file_are_seen(tmp_path: Path):
    document = ROOT / "README.md"
    assert broken("docs/nowhere.md", document)
    assert broken("docs/method.md#nowhere", document)
    assert broken("../elsewhere.md", document)
    assert broken("docs/method.md#the-map", document) is None
    assert broken("https://example.org/nowhere", document) is None
    assert citations("derived in (docs/derivations/compositing.md#the-adjoint-of-alpha).") == [
        ("docs/derivations/compositing.md", "the-adjoint-of-alpha")
    ]
    assert missing("docs/derivations/compositing.md", "nowhere", ROOT)
    assert missing("sfm/elsewhere.py", "", ROOT)
    assert not missing("sfm/settings.py", "", ROOT)
    assert anchor("Are `identifiable` coefficients right?") == "are-identifiable-coefficients-right"


def test_every_underscored_name_in_the_sources_backticks_exists():
    sources = sorted((ROOT / "src").rglob("*.py"))
    known = {source.stem for source in sources} | {"from_pretrained"}  # Hugging Face's
    for source in sources:
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            match node:
                case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name) | ast.Name(id=name):
                    known.add(name)
                case ast.Attribute(attr=name) | ast.keyword(arg=str(name)):
                    known.add(name)
                case ast.Constant(value=str(text)):
                    known |= set(re.findall(r"^\w+$", text))
    wrong = {
        f"{source.relative_to(ROOT)}: {name}"
        for source in sources
        for name in re.findall(r"`(\w+_\w+)`", source.read_text(encoding="utf-8"))
        if name not in known
    }
    assert wrong == set()
