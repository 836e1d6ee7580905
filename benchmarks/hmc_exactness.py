"""Exactness of hybrid Monte Carlo where it can be computed, at steps so long that half of the trials are rejected.

Points in harmonic wells, momenta drawn anew and in part, and rigid dipoles in a field with the volume of an ideal gas
of them: means and variances over many trials beside the exact values, in units of their standard errors.

    python benchmarks/hmc_exactness.py [TRIALS]     100000 if not given: about an hour
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.rotation import mrdl
from openmm_sier.dynamics.schemes import SIER2, SIER4G
from openmm_sier.measure.statistics import mean_and_error
from tests.support.trials import KT, Chain, Dipoles, Wells, whole_trial


def say(name: str, series: list, expected: float) -> None:
    """One line: mean, error and deviation from what is expected."""
    mean, error = mean_and_error(np.array(series), 50)
    print(f"  {name:38} {mean:8.4f} +- {error:.4f}, exact {expected:8.4f}: {(mean - expected) / error:+.1f} errors")


def wells(trials: int, h: float, steps: tuple[int, ...], kept: float) -> None:
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
    print(f"Wells, SIER2, momenta keep {kept:g}, acceptance {state.accepted / trials:.3f}")
    say("k q^2 / kT", squares, 1)
    say("its square", fourths, 3)
    say("p^2 / m kT", kinetic, 1)
    say("q p / sqrt(m/k) kT", products, 0)


def dipoles(trials: int, field: float, h: float) -> None:
    """Rigid dipoles in a field in kT, at constant pressure."""
    model, n = Dipoles(12), 12
    model.FIELD = field
    chain = Chain(model, SIER4G, h, (1, 2), rotation=mrdl)
    move = MonteCarloVolumeMove(KT, 1, chain.bath).operator(model.bodies, [range(3 * i, 3 * i + 3) for i in range(n)])
    step, state, volume = chain.step, model.start(), float(n)
    cosines, squares, volumes = [], [], []
    mean = 1 / math.tanh(field) - 1 / field
    for _ in range(trials):
        state = whole_trial(step, state)
        cosines.append(model.observed(state).mean())
        squares.append(((model.observed(state) - mean) ** 2).mean())
        state, factor = move(state, volume, lambda q, factor: 0.0)
        volume *= factor**3
        volumes.append(volume)
    print(f"Dipoles in a field of {field:g} kT, SIER4G, acceptance {state.accepted / trials:.3f}")
    say("cosine", cosines, mean)
    say("its variance", squares, 1 / field**2 - 1 / math.sinh(field) ** 2)
    say("volume of the gas", volumes, n + 1)
    say("its variance", list((np.array(volumes) - n - 1) ** 2), n + 1)


if __name__ == "__main__":
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    wells(number, 0.02, (2, 3, 4), 0.0)
    wells(number, 0.016, (1,), 0.9)
    dipoles(number, 3.0, 0.1)
    dipoles(number, 10.0, 0.058)
