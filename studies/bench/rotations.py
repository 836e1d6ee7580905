"""Cost of the free-rotation maps alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from openmm_sier.dynamics import backend, rotation
from openmm_sier.dynamics.backend import threads
from openmm_sier.dynamics.constants import GAS_CONSTANT
from studies import records
from studies.bench.timing import BenchSettings, interleaved, median_and_error
from studies.report import Report, Table

STEP = 1e-3
WATER_MOMENTS = (0.0061, 0.0115, 0.0176)


#: Rotations by name, all executed by NumPy.
MAPS = {"MRDL": rotation.mrdl, "exact": rotation.exact, "SEJ4": rotation.sej4}

COLUMNS = {
    "bodies": "{bodies}",
    "map": "{name}",
    "ns a body": "{nanoseconds:.3g} ± {nanoseconds_error:.1g}",
    "over MRDL": "{over_mrdl:.3g} ± {over_mrdl_error:.1g}",
}


def time_rotations(sizes: Sequence[int], rounds: int, step: float = STEP) -> pd.DataFrame:
    """Nanoseconds per body of each free-rotation map at the thermal motion of water, and the ratio to MRDL.

    One thread does the work, however many are used elsewhere.

    Args:
        sizes: numbers of bodies.
        rounds: in which all maps take their turns.
        step: ps.
    """
    rows = []
    for n in sizes:
        repeats = max(1, 20000 // n)
        arguments = (*thermal_rotors(n), step, repeats)
        actions: dict[str, Callable[[], None]] = {
            name: partial(_by_numpy, rotate, *arguments) for name, rotate in MAPS.items()
        }
        if backend.active() is not backend.NUMPY:
            actions["exact, Numba"] = partial(_rotate, rotation.exact, *arguments)
        with threads.use(1):
            seconds = interleaved(actions, rounds)
        for name, values in seconds.items():
            cost, cost_error, _ = median_and_error(1e9 * values / (repeats * n))
            over, over_error, _ = median_and_error(values / seconds["MRDL"])
            row = {"bodies": n, "name": name, "nanoseconds": cost, "nanoseconds_error": cost_error}
            rows.append(row | {"over_mrdl": over, "over_mrdl_error": over_error})
    return pd.DataFrame(rows)


def find(settings: BenchSettings, report: Report) -> dict[str, pd.DataFrame]:
    """The table of `time_rotations`."""
    return {"rotations": time_rotations(settings.bodies, settings.rounds)}


def tables(found: Mapping[str, pd.DataFrame]) -> list[Table]:
    """The costs, for the report."""
    title = "Free rotation, on one core (NumPy where nothing else is said)"
    return [records.table(title, found["rotations"], COLUMNS, left=2)]


def _rotate(rotate: Callable[..., Any], A: np.ndarray, L: np.ndarray, step: float, repeats: int) -> None:
    for _ in range(repeats):
        rotate(A, L, WATER_MOMENTS, step)


def _by_numpy(rotate: Callable[..., Any], A: np.ndarray, L: np.ndarray, step: float, repeats: int) -> None:
    with backend.using(backend.NUMPY):
        _rotate(rotate, A, L, step, repeats)


def thermal_rotors(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes (3, 3, n) and angular momenta (3, n) of water molecules at 297 K."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    A = q * np.sign(np.linalg.det(q))[:, None, None]
    tilde = rng.normal(size=(n, 3)) * np.sqrt(GAS_CONSTANT * 297 * np.array(WATER_MOMENTS))
    return np.ascontiguousarray(A.transpose(1, 2, 0)), np.ascontiguousarray(np.einsum("nab,na->bn", A, tilde))
