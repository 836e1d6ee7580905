"""First lines of docstrings are sentences with a verb, and not noun clauses."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent.parent / "openmm_sier"
MODULES = sorted(PACKAGE.rglob("*.py"))

#: What begins a clause or a noun phrase, and no sentence that says what a function does.
NOUN_CLAUSES = {"What", "Which", "Whether", "How", "Why", "By", "Of", "Somebody", "As"}
NOUN_PHRASES = {"A", "An", "The", "All", "For", "One", "Number", "Their", "Those", "That", "Its"}


def wrong_first_lines(source: str) -> list[str]:
    """Names of functions and classes whose docstrings begin with a noun clause, or functions with a noun phrase."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and (text := ast.get_docstring(node)):
            refused = NOUN_CLAUSES if isinstance(node, ast.ClassDef) else NOUN_CLAUSES | NOUN_PHRASES
            if text.split()[0] in refused:
                found.append(node.name)
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_first_lines_begin_with_a_verb(path):
    assert wrong_first_lines(path.read_text()) == []


def test_noun_clauses_are_found():
    function = 'def {}():\n    """{}"""\n'
    source = 'class A:\n    """What is kept."""\n' + function.format("f", "The sum.") + function.format("g", "Add.")
    assert wrong_first_lines(source) == ["A", "f"]
