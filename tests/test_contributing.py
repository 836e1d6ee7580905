"""CONTRIBUTING shows every module with the first line of its docstring."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
FLOORS = ["cli", "studies", "measure", "context", "dynamics"]


def first_line(path: Path) -> str:
    return (ast.get_docstring(ast.parse(path.read_text())) or "").split("\n")[0]


def tree(folder: Path, depth: int = 0) -> list[str]:
    """A line for each module of a package, and its packages after it, the floors from the top down."""
    indent = "    " * (depth + 1)
    lines = [f"{indent}{p.name:<24} {first_line(p)}" for p in sorted(folder.glob("*.py")) if p.name[0] != "_"]
    packages = [p for p in folder.iterdir() if (p / "__init__.py").exists()]
    for package in sorted(packages, key=lambda p: (FLOORS.index(p.name) if p.name in FLOORS else 9, p.name)):
        lines.append(f"{indent}{package.name + '/':<24} {first_line(package / '__init__.py')}")
        lines += tree(package, depth + 1)
    return lines


def test_the_tree_is_the_package():
    """Where this fails, `python tests/test_contributing.py` writes the tree anew."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    shown = [line.rstrip() for line in text.split("-->\n")[1].split("\n## ")[0].strip("\n").splitlines()]
    assert shown == [line.rstrip() for line in tree(ROOT / "openmm_sier")]


if __name__ == "__main__":
    path = ROOT / "CONTRIBUTING.md"
    head, rest = path.read_text().split("-->\n")
    made = "\n".join(line.rstrip() for line in tree(ROOT / "openmm_sier"))
    path.write_text(f"{head}-->\n\n{made}\n\n## {rest.split('## ', 1)[1]}")
