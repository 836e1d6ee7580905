"""The list of the studies: `python -m studies`."""

from __future__ import annotations

import ast
from importlib.util import find_spec
from pathlib import Path

from openmm_sier.cli.console import table
from studies import STUDIES


def summary(module: str) -> str:
    """Return the first line of a module's docstring, without importing it."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"there is no study {module}")
    return (ast.get_docstring(ast.parse(Path(spec.origin).read_text())) or "").partition("\n")[0]


def main() -> None:
    rows = [[f"python -m {module}", summary(module), cost] for module, cost in STUDIES.items()]
    table("Studies", ("command", "what it shows", "what it takes"), rows, left=3)


if __name__ == "__main__":
    main()
