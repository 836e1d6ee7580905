"""Exactness of hybrid Monte Carlo where it can be computed, at steps so long that half of the trials are rejected.

Points in harmonic wells, momenta drawn anew and in part, and rigid dipoles in a field with the volume of an ideal gas
of them: means and variances over many trials beside the exact values, in units of their standard errors. Nearly all of
the time goes to Python's calls, so fewer bodies would save nothing.

    python -m studies.hmc.exactness [TRIALS] [--processes N]     100000 if not given: 7 minutes of one core in all
"""

from __future__ import annotations

import argparse
import math
import sys
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.rotation import mrdl
from openmm_sier.dynamics.schemes import SIER2, SIER4G
from openmm_sier.measure.statistics import mean_and_error
from tests.support.trials import KT, Chain, Dipoles, Wells, whole_trial


class Series(NamedTuple):
    """Values of an observable, one per trial, and the exact mean."""

    name: str
    values: list[float]
    expected: float

    def row(self) -> str:
        mean, error, _ = mean_and_error(np.array(self.values))
        off = (mean - self.expected) / error
        return f"| {self.name} | {mean:.4f} | {error:.4f} | {self.expected:.4f} | {off:+.1f} |"


def wells(trials: int, h: float, steps: tuple[int, ...], kept: float) -> str:
    """Points in wells; `kept` is the factor that momenta keep in a trial."""
    chain = Chain(Wells(), SIER2, h, steps, friction=-math.log(kept) / h if kept else math.inf)
    squares, fourths, kinetic, products = [], [], [], []
    roots = np.sqrt(chain.model.springs)
    for state in chain.samples(trials):
        energies = chain.model.observed(state)
        squares.append(energies.mean())
        fourths.append((energies**2).mean())
        kinetic.append((state.p**2).mean() / KT)
        products.append((roots * state.q * state.p).mean() / KT)
    return _table(
        f"Wells, SIER2, momenta keep {kept:g}, acceptance {state.accepted / trials:.3f}",
        Series("k q^2 / kT", squares, 1),
        Series("its square", fourths, 3),
        Series("p^2 / m kT", kinetic, 1),
        Series("q p / sqrt(m/k) kT", products, 0),
    )


def dipoles(trials: int, field: float, h: float) -> str:
    """Rigid dipoles in a field in kT, at constant pressure."""
    model, n = Dipoles(12), 12
    model.FIELD = field
    # Drifts are so long that the exact map takes eight times as long; MRDL is also reversible and keeps the volume.
    chain = Chain(model, SIER4G, h, (1,), rotation=mrdl, seed=round(field))
    move = MonteCarloVolumeMove(KT, 1, chain.bath).operator(model.bodies, [range(3 * i, 3 * i + 3) for i in range(n)])
    step, state, volume = chain.step, model.start(), float(n)
    cosines, squares, volumes = [], [], []
    mean = 1 / math.tanh(field) - 1 / field
    for _ in range(trials):
        state = whole_trial(step, state)
        observed = model.observed(state)
        cosines.append(observed.mean())
        squares.append(((observed - mean) ** 2).mean())
        state, factor = move(state, volume, lambda q, factor: 0.0)
        volume *= factor**3
        volumes.append(volume)
    return _table(
        f"Dipoles in a field of {field:g} kT, SIER4G, acceptance {state.accepted / trials:.3f}",
        Series("cosine", cosines, mean),
        Series("its variance", squares, 1 / field**2 - 1 / math.sinh(field) ** 2),
        Series("volume of the gas", volumes, n + 1),
        Series("its variance", list((np.array(volumes) - n - 1) ** 2), n + 1),
    )


def _table(title: str, *series: Series) -> str:
    return "\n".join([f"| **{title}** | | | | |", *(each.row() for each in series)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trials", type=int, nargs="?", default=100_000)
    parser.add_argument("--processes", type=int, help="default: one a core")
    options = parser.parse_args()
    with ProcessPoolExecutor(options.processes) as pool:
        found = [
            pool.submit(dipoles, options.trials, 3.0, 0.1),
            pool.submit(dipoles, options.trials, 10.0, 0.062),
            pool.submit(wells, options.trials, 0.02, (2, 3, 4), 0.0),
            pool.submit(wells, options.trials, 0.016, (1,), 0.9),
        ]
        print("| | mean | error | exact | errors off |\n|---|---|---|---|---|")
        for each in found:
            print(each.result(), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
