"""Exactness of hybrid Monte Carlo where it can be computed, at steps so long that half of the trials are rejected.

Points in harmonic wells, momenta drawn anew and in part, and rigid dipoles in a field with the volume of an ideal gas
of them: means and variances over many trials beside the exact values, in units of their standard errors. Nearly all of
the time goes to Python's calls, so fewer bodies would save nothing.

    python -m studies.hmc.exactness [--trials N] [--processes N]     100000 trials take 7 minutes of one core in all
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from openmm_sier.dynamics.constants import BAR
from openmm_sier.dynamics.rotation import mrdl
from openmm_sier.dynamics.schemes import SIER2, SIER4G
from openmm_sier.measure.statistics import mean_and_error
from studies import records
from studies.command import Settings, command
from studies.hmc.model_engine import KT, Chain, Dipoles, Wells
from studies.records import Record
from studies.report import SILENT, Report

COLUMNS = records.columns("name", "mean", "error", "exact", "off")


@dataclass(frozen=True)
class ExactnessSettings(Settings):
    """How much is done.

    Attributes:
        trials: of each of the four models.
        processes: at a time; one for each core unless given.
    """

    trials: int = 100_000
    processes: int | None = None


def _row(model: str, name: str, values: Sequence[float], exact: float) -> dict[str, Any]:
    """An observable, of which there is a value for each trial, beside its exact mean."""
    mean, error, _ = mean_and_error(np.array(values))
    return {"model": model, "name": name, "mean": mean, "error": error, "exact": exact, "off": (mean - exact) / error}


def wells(trials: int, h: float, steps: tuple[int, ...], kept: float) -> list[dict[str, Any]]:
    """Points in wells; `kept` is the factor that momenta keep in a trial."""
    chain = Chain(Wells(), SIER2, h, steps, friction=-math.log(kept) / h if kept else None)
    squares, fourths, kinetic, products = [], [], [], []
    roots = np.sqrt(chain.model.springs)
    for sample in chain.samples(trials):
        q, p, energies = sample.state.q, sample.state.p, chain.model.observed(sample.state)
        squares.append(energies.mean())
        fourths.append((energies**2).mean())
        kinetic.append((p**2).mean() / KT)
        products.append((roots * q * p).mean() / KT)
    model = f"Wells, SIER2, momenta keep {kept:g}, acceptance {sample.accepted / trials:.3f}"
    return [
        _row(model, "k q^2 / kT", squares, 1),
        _row(model, "its square", fourths, 3),
        _row(model, "p^2 / m kT", kinetic, 1),
        _row(model, "q p / sqrt(m/k) kT", products, 0),
    ]


def dipoles(trials: int, field: float, h: float) -> list[dict[str, Any]]:
    """Rigid dipoles in a field in kT, at constant pressure."""
    model, n = Dipoles(12), 12
    model.FIELD = field
    molecules = [list(range(3 * i, 3 * i + 3)) for i in range(n)]
    # Drifts are so long that the exact map takes eight times as long; MRDL is also reversible and keeps the volume.
    chain = Chain(model, SIER4G, h, (1,), rotation=mrdl, seed=round(field), pressure=KT / BAR, molecules=molecules)
    cosines, squares, volumes = [], [], []
    mean = 1 / math.tanh(field) - 1 / field
    for sample in chain.samples(trials):
        observed = model.observed(sample.state)
        cosines.append(observed.mean())
        squares.append(((observed - mean) ** 2).mean())
        volumes.append(sample.volume)
    title = f"Dipoles in a field of {field:g} kT, SIER4G, acceptance {sample.accepted / trials:.3f}"
    return [
        _row(title, "cosine", cosines, mean),
        _row(title, "its variance", squares, 1 / field**2 - 1 / math.sinh(field) ** 2),
        _row(title, "volume of the gas", volumes, n + 1),
        _row(title, "its variance", list((np.array(volumes) - n - 1) ** 2), n + 1),
    ]


def study(settings: ExactnessSettings, report: Report = SILENT) -> Record:
    """All models, each in a process of its own; writes exactness.json."""
    trials = settings.trials
    with ProcessPoolExecutor(settings.processes) as pool:
        found = [
            pool.submit(dipoles, trials, 3.0, 0.1),
            pool.submit(dipoles, trials, 10.0, 0.062),
            pool.submit(wells, trials, 0.02, (2, 3, 4), 0.0),
            pool.submit(wells, trials, 0.016, (1,), 0.9),
        ]
        rows = pd.DataFrame([row for each in found for row in each.result()])
    for model, mine in rows.groupby("model", sort=False):
        report.table(records.table(str(model), mine, COLUMNS))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "exactness.json")


main = command(ExactnessSettings, study, __doc__, __name__)
