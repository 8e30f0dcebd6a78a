"""Docstrings, help strings and messages begin with a noun or a verb and use no metaphors."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import swimm3r

PACKAGE = Path(swimm3r.__file__).parent
ROOTS = (PACKAGE, *(PACKAGE.parents[1] / name for name in ("tests", "benchmarks", "examples")))
AS_SUBJECT = re.compile(r"(What|Who|Whom|Whose|Where|Whether|Which|When|Why|How)\b(?!\?)")
INSIDE = re.compile(r"[.:;] (What|Who|Whom|Whoever|Whatever) ")
METAPHORS = re.compile(
    r"false friend|lottery|witness|strangers?\b|so-manieth|swims? by|what the other defaults aim at", re.I
)


def texts(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Every docstring, and every string under a field or constant, with its line."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                value = statement.value.value
                if isinstance(value, str):
                    yield statement.lineno, value.strip()


def strings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Every string constant with its line: messages among them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


SOURCES = sorted(path for root in ROOTS if root.is_dir() for path in root.rglob("*.py"))


def test_no_docstring_or_help_string_has_a_question_word_as_its_subject():
    found = [
        f"{path}:{line}: {text[:80]}"
        for path in SOURCES
        for line, text in texts(ast.parse(path.read_text()))
        if AS_SUBJECT.match(text) or INSIDE.search(text.replace("\n", " "))
    ]
    assert found == []


def test_no_text_of_the_package_uses_the_metaphors_of_old():
    found = [
        f"{path}:{line}: {text[:80]}"
        for path in SOURCES
        if PACKAGE in path.parents
        for line, text in strings(ast.parse(path.read_text()))
        if METAPHORS.search(text)
    ]
    assert found == []


@pytest.mark.parametrize("text", ["Blocks on disk. What was read stays.", "Two encodings; who wants both: Who asks."])
def test_a_question_word_at_the_head_of_a_later_sentence_is_seen(text: str):
    assert INSIDE.search(text)


@pytest.mark.parametrize("text", ["What swims by is followed.", "Where it lies.", "How many."])
def test_a_planted_question_word_is_seen(text: str):
    ((_, found),) = texts(ast.parse(f'def f():\n    """{text}"""'))
    assert AS_SUBJECT.match(found)
