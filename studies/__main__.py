"""The list of the studies: `python -m studies`."""

from __future__ import annotations

import ast
import re
from importlib.util import find_spec
from pathlib import Path

from openmm_sier.cli.console import table
from studies import records

#: The last line of a module that is a command.
IS_COMMAND = re.compile(r"^main = command\(", re.MULTILINE)


def modules() -> list[str]:
    """Return the modules that are studies, as `python -m` takes them."""
    here = Path(__file__).parent
    files = [path for path in here.rglob("*.py") if IS_COMMAND.search(path.read_text())]
    names = [".".join(path.relative_to(here.parent).with_suffix("").parts) for path in files]
    return sorted(name.removesuffix(".__main__") for name in names)


def summary(module: str) -> str:
    """Return the first line of a module's docstring, without importing it."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(f"there is no study {module}")
    return (ast.get_docstring(ast.parse(Path(spec.origin).read_text())) or "").partition("\n")[0]


def times(module: str) -> str:
    """Return what the records of a study took."""
    commands = [item for file in sorted(records.DATA.iterdir()) for item in records.read(file).commands.items()]
    return "; ".join(dict.fromkeys(took for line, took in commands if took and f"-m {module} " in f"{line} "))


def main() -> None:
    rows = [[f"python -m {module}", summary(module), times(module)] for module in modules()]
    table("Studies", ("command", "what it shows", "what it took"), rows, left=3)


if __name__ == "__main__":
    main()
