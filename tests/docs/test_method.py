"""The method page and the numbers of equations: every function named exists, every number is one of the paper's."""

import re
from importlib import import_module
from pathlib import Path

import pytest
from tests.docs.documents import DOCUMENTS, ROOT
from tests.docs.test_links import TEXTS

LAST = 18
NAME = re.compile(r"`(swimm3r(?:\.\w+)+)`")
EQUATION = re.compile(r"\bEqs?\.(?: (\d+)(?: ?(?:-|to|and|,) ?(?:Eq\. )?(\d+))?)?")
METHOD = ROOT / "docs" / "method.md"


def resolved(name: str) -> object:
    """The module, class, function or attribute that a dotted name is. Raises AttributeError or ImportError."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: object = import_module(".".join(parts[:end]))
        except ModuleNotFoundError as error:
            if not ".".join(parts[:end]).startswith(str(error.name)):
                raise
            continue
        for attribute in parts[end:]:
            found = getattr(found, attribute)
        return found
    raise ImportError(name)


def equations(text: str) -> list[int | None]:
    """The numbers of equations that a text cites, both ends of ranges; None for a citation without a number."""
    return [
        int(n) if n else None for first, last in EQUATION.findall(text) for n in ([first, last] if last else [first])
    ]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_name_of_the_package_in_a_document_exists(document: Path):
    for name in sorted(set(NAME.findall(document.read_text(encoding="utf-8")))):
        resolved(name)


def test_every_equation_has_its_function():
    rows = [
        line.split("|") for line in METHOD.read_text(encoding="utf-8").splitlines() if re.match(r"\|.*Eq\. \d", line)
    ]
    with_function = {number for row in rows if NAME.search(row[3]) for number in equations(row[2])}
    assert with_function == set(range(1, LAST + 1))


def test_every_equation_cited_is_one_of_the_papers():
    wrong = {
        str(source.relative_to(ROOT)): numbers
        for source in TEXTS
        if source != Path(__file__)
        and (numbers := [n for n in equations(source.read_text("utf-8")) if n is None or not 1 <= n <= LAST])
    }
    assert wrong == {}


def test_a_wrong_name_and_a_wrong_number_are_seen():
    with pytest.raises(AttributeError):
        resolved("swimm3r.medium.nowhere")
    with pytest.raises((ImportError, AttributeError)):
        resolved("swimm3r.nowhere.add_water")
    assert equations("Eq. 3, Eqs. 2-4 and Eqs. 5 to 19; Eq. geom; Eqs. 11 and 12") == [3, 2, 4, 5, 19, None, 11, 12]
