"""What an import of the package brings along."""

import subprocess
import sys

import pytest


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


@pytest.mark.parametrize("question", ["--version", "--help"])
def test_a_question_about_the_command_does_not_wait_for_openmm(question):
    check = (
        "import sys\nimport openmm_sier_command\n"
        f"sys.argv = ['openmm-sier', '{question}']\n"
        "try:\n    openmm_sier_command.main()\n"
        "finally:\n    print(*sorted({'openmm', 'numba', 'scipy', 'mdtraj', 'numpy'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True).stdout
    assert "openmm-sier" in result
    assert result.endswith("\n\n")
