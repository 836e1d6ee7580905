"""Cost of the free-rotation maps alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from openmm_sier.dynamics import backend, rotation
from openmm_sier.dynamics.backend import threads
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.measure.report import Report, Table
from openmm_sier.measure.statistics import median_and_error
from studies.bench.timing import BenchSettings, interleaved

STEP = 1e-3
WATER_MOMENTS = (0.0061, 0.0115, 0.0176)


def time_rotations(settings: BenchSettings, report: Report) -> list[dict[str, Any]]:
    """Nanoseconds per body of each free-rotation map at the thermal motion of water, for several numbers of bodies.

    One thread does the work, however many are used elsewhere.
    """
    rows = []
    for n in settings.bodies:
        repeats = max(1, 20000 // n)
        arguments = (*thermal_rotors(n), repeats)
        actions: dict[str, Callable[[], None]] = {
            name: partial(_by_numpy, rotate, *arguments)
            for name, rotate in (("exact", rotation.exact), ("MRDL", rotation.mrdl), ("SEJ4", rotation.sej4))
        }
        if backend.active() is not backend.NUMPY:
            actions["exact, Numba"] = partial(_rotate, rotation.exact, *arguments)
        with threads.use(1):
            seconds = interleaved(actions, settings.rounds)
        row: dict[str, Any] = {"bodies": n}
        row |= {name: median_and_error(1e9 * values / (repeats * n)) for name, values in seconds.items()}
        row["exact / MRDL"] = median_and_error(seconds["exact"] / seconds["MRDL"])
        rows.append(row)
    return rows


def _rotate(rotate: Callable[..., Any], A: np.ndarray, L: np.ndarray, repeats: int) -> None:
    for _ in range(repeats):
        rotate(A, L, WATER_MOMENTS, STEP)


def _by_numpy(rotate: Callable[..., Any], A: np.ndarray, L: np.ndarray, repeats: int) -> None:
    with backend.using(backend.NUMPY):
        _rotate(rotate, A, L, repeats)


def thermal_rotors(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes (3, 3, n) and angular momenta (3, n) of water molecules at 297 K."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    A = q * np.sign(np.linalg.det(q))[:, None, None]
    tilde = rng.normal(size=(n, 3)) * np.sqrt(GAS_CONSTANT * 297 * np.array(WATER_MOMENTS))
    return np.ascontiguousarray(A.transpose(1, 2, 0)), np.ascontiguousarray(np.einsum("nab,na->bn", A, tilde))


def tables(rows: list[dict]) -> list[Table]:
    """The costs, for the report."""
    names = [name for name in rows[0] if name != "bodies"]
    table = Table(
        "Free rotation, ns a body on one core (NumPy where nothing else is said), and ratio of costs",
        ["bodies", *names],
        [[str(row["bodies"]), *(f"{row[name][0]:.3g} ± {row[name][1]:.1g}" for name in names)] for row in rows],
        left=0,
    )
    return [table]
