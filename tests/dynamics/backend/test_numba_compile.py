"""Compilation of loops with all that they call."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from openmm_sier.dynamics.backend import numba_loops
from openmm_sier.dynamics.backend.numba_compile import compiled

numba = pytest.importorskip("numba")


def reversing(body_L, rates, h):
    return (0.0, 1.0, 0.0, 0.0), h > 0


def standing(body_L, rates, h):
    return (1.0, 0.0, 0.0, 0.0), h > 0


def test_a_loop_calls_the_formula_that_it_is_given():
    """And the code that the disk keeps of one is not taken for the other's."""
    A, far = np.repeat(np.eye(3)[:, :, None], 3, axis=2), np.empty(3, dtype=bool)
    frame = np.array([3.0, 2.0, 1.0]), np.array([0, 1, 2]), 1.0
    for formula, diagonal in ((reversing, [1, -1, -1]), (standing, [1, 1, 1])):
        rotate, new = compiled(numba_loops.rotate, {numba_loops.rotate_body: formula}), np.empty_like(A)
        assert rotate(0, 3, A, np.ones((3, 3)), 1.0, frame, new, far) == 0
        assert np.array_equal(new, np.diag(diagonal)[:, :, None] * A)
        assert rotate(0, 3, A, np.ones((3, 3)), -1.0, frame, new, far) == 3
        assert far.all()


def test_another_process_finds_the_code_on_disk(tmp_path):
    """Names on disk tell of the code alone, not of the process or its hashes."""
    code = "import numpy as np\nfrom openmm_sier.dynamics import rotation\n"
    code += "rotation.exact(np.ones((3, 3, 1)), np.ones((3, 1)), (1, 2, 3), 0.001)"
    found = []
    for seed in ("1", "2"):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONHASHSEED": seed, "OPENMM_SIER_NUMBA": "1"}
        subprocess.run([sys.executable, "-c", code], check=True, env=environment)
        found.append({(path.name, path.stat().st_mtime_ns) for path in tmp_path.rglob("*.nb*")})
    assert len(found[0]) == 1
    assert found[1] == found[0]


@pytest.mark.slow
def test_code_on_disk_of_a_module_that_has_moved_is_not_taken_up(tmp_path):
    """Numba imports the modules of all functions in the code that it reads."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "loops.py").write_text("from package import formula\n\n\ndef loop(n):\n    return formula(n)\n")
    code = "from package import loops\nfrom openmm_sier.dynamics.backend.numba_compile import compiled\n"
    code += "print(compiled(loops.loop, {})(1))"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path)}
    for module in ("one", "other"):
        (package / "__init__.py").write_text(f"from package.{module} import formula\n")
        (package / f"{module}.py").write_text("import math\n\n\ndef formula(n):\n    return math.sqrt(n)\n")
        found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        assert found.stdout == "1.0\n", found.stderr
        assert any((tmp_path / "cache").rglob("*.nbc"))
        (package / f"{module}.py").unlink()
