"""Cost of the free-rotation maps alone."""

from __future__ import annotations

from functools import partial

import numpy as np
import pandas as pd

from openmm_sier.dynamics import backend, rotation
from openmm_sier.dynamics.backend import threads
from openmm_sier.dynamics.operators import Rotation
from studies.bench.timing import interleaved, median_and_error
from studies.paper import tip4p

#: Rotations by name, all executed by NumPy.
MAPS = {"MRDL": rotation.mrdl, "exact": rotation.exact, "SEJ4": rotation.sej4}


def time_rotations(n: int, rounds: int, step: float) -> pd.DataFrame:
    """Nanoseconds per body of each free-rotation map at the thermal motion of water, and the ratio to MRDL.

    One thread does the work, however many are used elsewhere.

    Args:
        n: number of bodies.
        rounds: in which all maps take their turns.
        step: ps.
    """
    bodies, repeats = tip4p.molecules(n), max(1, 20000 // n)
    start = tip4p.canonical_rotation(bodies, 297.0, np.random.default_rng(1))

    def turn(rotate: Rotation, by: backend.Backend = backend.NUMPY) -> None:
        with backend.using(by):
            for _ in range(repeats):
                rotate(start.A, start.L, bodies.species[0].moments, step)

    actions = {name: partial(turn, rotate) for name, rotate in MAPS.items()}
    if backend.active() is not backend.NUMPY:
        actions["exact, Numba"] = partial(turn, rotation.exact, backend.active())
    with threads.use(1):
        seconds = interleaved(actions, rounds)
    rows = []
    for name, values in seconds.items():
        cost, cost_error, _ = median_and_error(1e9 * values / (repeats * n))
        over, over_error, _ = median_and_error(values / seconds["MRDL"])
        row = {"bodies": n, "name": name, "nanoseconds": cost, "nanoseconds_error": cost_error}
        rows.append(row | {"over_mrdl": over, "over_mrdl_error": over_error})
    return pd.DataFrame(rows)
