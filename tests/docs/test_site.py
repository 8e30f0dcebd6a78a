"""The site of the documents: it builds strictly, and describes the tree as it is."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from tests.docs.documents import DOCUMENTS, ROOT
from tests.test_architecture import PACKAGE, ROWS

ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def blocks() -> list[str]:
    return re.findall(r"^```text\n(.*?)^```", ARCHITECTURE, re.MULTILINE | re.DOTALL)


def test_the_site_builds_strictly_and_asks_no_other_server(tmp_path: Path):
    quiet = {"DISABLE_MKDOCS_2_WARNING": "true", "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **quiet}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    front = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="(?:https?:)?//[^"]*"', front) == []
    reference = (tmp_path / "site" / "reference" / "swimm3r" / "index.html").read_text(encoding="utf-8")
    assert 'id="swimm3r.medium.add_water"' in reference


def test_the_installation_page_lists_every_extra():
    page = (ROOT / "docs" / "installation.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    listed = re.findall(r"^\| `pip install '\.\[(\w+)\]'`", page, re.MULTILINE)
    assert {*listed, "dev"} == project["optional-dependencies"].keys()


def test_documents_install_extras_from_the_clone():
    """The package is in no index; only the installation page names the form that needs an installed one."""
    named = [path.name for path in DOCUMENTS if "swimm3r[" in path.read_text(encoding="utf-8")]
    assert named == ["installation.md"]


def test_the_page_lists_every_room():
    listed, above = [], [PACKAGE]
    for line in blocks()[0].splitlines()[1:]:
        indent, name = re.findall(r"^( *)(\w+)/", line)[0]
        above = [*above[: len(indent) // 4], above[len(indent) // 4 - 1] / name]
        listed.append(above[-1])
    assert sorted(listed) == sorted({path.parent for path in PACKAGE.rglob("__init__.py")} - {PACKAGE})


def test_the_page_has_the_import_rows():
    rows, package = {}, ""
    for line in blocks()[1].splitlines():
        if line.endswith(":"):
            package = line[:-1]
            rows[package] = []
        else:
            rows[package].append(set(line.strip().split(", ")))
    assert rows == ROWS
