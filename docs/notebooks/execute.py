#!/usr/bin/env python3
"""Execute the notebooks of this directory, in place, each within two minutes: `python docs/notebooks/execute.py [NAME ...]`.

Needs the extra `docs`. Only what readers see is stored: times of execution and versions of the kernel are left out.
"""

import argparse
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
LONGEST = 120  #: seconds for a notebook


def execute(path: Path) -> float:
    """Seconds that the notebook took; it is stored with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    began = time.monotonic()
    NotebookClient(notebook, timeout=LONGEST, resources={"metadata": {"path": HERE}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    nbformat.write(notebook, path)
    return time.monotonic() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="notebooks without .ipynb (default: all)")
    names = parser.parse_args().names or sorted(path.stem for path in HERE.glob("*.ipynb"))
    for name in names:
        print(f"{name}: {execute(HERE / f'{name}.ipynb'):.0f} s", flush=True)


if __name__ == "__main__":
    main()
