"""What an import of the package brings along."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import openmm_sier


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        (
            "import openmm_sier",
            {"numba", "matplotlib", "h5py", "rich", "mdtraj", "scipy", "numpy.polynomial", "numpy.random"},
        ),
        ("from openmm_sier.cli import command_line; command_line.parse(['info', 'box.pdb'])", {"numba", "mdtraj"}),
    ],
)
def test_imports_are_lean(code, absent):
    # NumPy imports some of its own modules when they are asked for, and releases before 2.0 at once.
    check = (
        f"import sys, numpy\nbefore = set(sys.modules)\n{code}\nprint(*sorted({absent!r} & set(sys.modules) - before))"
    )
    result = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True).stdout.split()
    assert result == []


def test_quantities_are_read_in_named_units():
    """The number within a quantity is private to OpenMM, and its unit is nowhere to be seen.

    `engines/snapshot.py` says why it reads two of them at each call of `step`, and `system/tables.py` why it reads
    masses, constraints and parameters of all atoms so.
    """
    folder = Path(openmm_sier.__file__).parent
    faster = {folder / "engines" / "snapshot.py", folder / "system" / "tables.py"}
    sources = {path: path.read_text() for path in folder.rglob("*.py") if path not in faster}
    assert [path for path, text in sources.items() if re.search(r"(?<!self)\._value\b", text)] == []
