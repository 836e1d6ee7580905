#!/usr/bin/env python3
"""Execute the notebooks of this directory, in place: `python docs/notebooks/execute.py [NAME ...]`.

Needs the extra `docs`. Only what readers see is stored: times of execution and versions of the kernel are left out.
"""

import argparse
import resource
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
LONGEST = 1800  #: seconds for a cell, on the busiest machine


def execute(path: Path) -> tuple[float, float]:
    """Seconds that the notebook took, by the clock and of a processor; it is stored with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    began = time.monotonic(), processor_time()
    NotebookClient(notebook, timeout=LONGEST, resources={"metadata": {"path": HERE}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    nbformat.write(notebook, path)
    return time.monotonic() - began[0], processor_time() - began[1]


def processor_time() -> float:
    """Seconds that ended kernels have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="notebooks without .ipynb (default: all)")
    names = parser.parse_args().names or sorted(path.stem for path in HERE.glob("*.ipynb"))
    for name in names:
        elapsed, used = execute(HERE / f"{name}.ipynb")
        print(f"{name}: {elapsed:.0f} s, {used:.0f} s of a processor", flush=True)


if __name__ == "__main__":
    main()
