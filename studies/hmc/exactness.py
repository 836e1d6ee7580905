"""Exactness of hybrid Monte Carlo for models with known averages, where half of the trials are rejected.

Points in harmonic wells, momenta drawn anew and in part, and rigid dipoles in a field with the volume of an ideal gas
of them, by `SIERHMCIntegrator` on the Reference platform: means and variances over many trials beside the exact values,
in units of their standard errors. Nearly all of the time goes to Python's calls, so fewer bodies would save nothing.

    python -m studies.hmc.exactness [--trials N] [--processes N]     100000 trials take 11 minutes of one core in all
    python -m studies.hmc.exactness --engine native --platform OpenCL     26 minutes of one core
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import cycle, islice
from typing import Any

import numpy as np
import openmm
import pandas as pd

from openmm_sier import SIERHMCIntegrator
from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.rotation import mrdl
from openmm_sier.dynamics.schemes import SIER2, SIER4G
from studies import text
from studies.command import Settings, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

TEMPERATURE = 300.0
KT = GAS_CONSTANT * TEMPERATURE

COLUMNS = text.columns("name", "mean", "error", "exact", "off")


@dataclass(frozen=True, kw_only=True)
class ExactnessSettings(Settings):
    """Choose how much is done.

    Attributes:
        trials: of each of the four models.
        processes: at a time; one for each core unless given.
        engine: exact or native.
        platform: of OpenMM.
        precision: of a platform for GPUs.
    """

    trials: int = 100_000
    processes: int | None = None
    engine: str = "exact"
    platform: str = "Reference"
    precision: str = "mixed"


def _row(model: str, name: str, values: Sequence[float], exact: float) -> dict[str, Any]:
    """An observable, of which there is a value for each trial, beside its exact mean."""
    mean, error, _ = mean_and_error(np.array(values))
    return {"model": model, "name": name, "mean": mean, "error": error, "exact": exact, "off": (mean - exact) / error}


def samples(
    settings: ExactnessSettings,
    system: openmm.System,
    integrator: SIERHMCIntegrator,
    positions: np.ndarray,
    steps: Sequence[int],
) -> Iterator[openmm.State]:
    """States after each of the trials, which have these numbers of steps by turns.

    A mode of which a trajectory is just half a period long never leaves its energy. Trajectories of several lengths
    leave no such mode.
    """
    # Steps are so long on purpose.
    warnings.filterwarnings("ignore", "A step of .* fs is long")
    platform = openmm.Platform.getPlatformByName(settings.platform)
    properties = {"Precision": settings.precision} if "Precision" in platform.getPropertyNames() else {}
    context = openmm.Context(system, integrator, platform, properties)
    context.setPositions(positions)
    for each in islice(cycle(steps), settings.trials):
        integrator.setStepsPerTrial(each)
        integrator.step(1)
        yield context.getState(positions=True, velocities=True)


def wells(settings: ExactnessSettings, h: float, steps: tuple[int, ...], kept: float) -> list[dict[str, Any]]:
    """Points of 1 dalton in wells of several frequencies; `kept` is the factor that momenta keep in a trial."""
    system, well = openmm.System(), openmm.CustomExternalForce("0.5*k*(x^2 + y^2 + z^2)")
    well.addPerParticleParameter("k")
    springs = 1000.0 * np.arange(1, 7)
    for spring in springs:
        well.addParticle(system.addParticle(1.0), [spring])
    system.addForce(well)
    friction = -math.log(kept) / h if kept else None
    integrator = SIERHMCIntegrator(
        TEMPERATURE, h, SIER2, frictionCoeff=friction, extraChances=2, engine=settings.engine
    )
    integrator.setRandomNumberSeed(17)
    squares, fourths, kinetic, products = [], [], [], []
    for state in samples(settings, system, integrator, np.zeros((6, 3)), steps):
        q, p = md(state.getPositions(asNumpy=True)), md(state.getVelocities(asNumpy=True))
        energies = springs[:, None] * q**2 / KT
        squares.append(energies.mean())
        fourths.append((energies**2).mean())
        kinetic.append((p**2).mean() / KT)
        products.append((np.sqrt(springs)[:, None] * q * p).mean() / KT)
    model = f"Wells, SIER2, momenta keep {kept:g}, acceptance {integrator.acceptanceRate:.3f}"
    return [
        _row(model, "k q^2 / kT", squares, 1),
        _row(model, "its square", fourths, 3),
        _row(model, "p^2 / m kT", kinetic, 1),
        _row(model, "q p / sqrt(m/k) kT", products, 0),
    ]


def dipoles(settings: ExactnessSettings, field: float, h: float) -> list[dict[str, Any]]:
    """Rigid asymmetric molecules in a field in kT, at constant pressure.

    The dipole, along an axis that is none of their own, is from the third atom to the second.
    """
    n, system = 12, openmm.System()
    sites = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.09], [0.0, 0.09, -0.06]])
    length = np.linalg.norm(sites[1] - sites[2])
    force = openmm.CustomExternalForce(f"{-field * KT / length}*charge*z")
    force.addPerParticleParameter("charge")
    for first in range(0, 3 * n, 3):
        for mass, charge in ((16.0, 0.0), (1.0, 1.0), (2.0, -1.0)):
            force.addParticle(system.addParticle(mass), [charge])
        for i, j in ((0, 1), (0, 2), (1, 2)):
            system.addConstraint(first + i, first + j, np.linalg.norm(sites[i] - sites[j]))
    system.addForce(force)
    # Without bonds: it makes the box periodic.
    box = openmm.CustomBondForce("0")
    box.setUsesPeriodicBoundaryConditions(True)
    system.addForce(box)
    system.setDefaultPeriodicBoxVectors(*np.eye(3) * n ** (1 / 3))
    # Drifts are so long that the exact map takes eight times as long; MRDL is also reversible and keeps the volume. A
    # step of RATTLE must be so short that OpenMM satisfies the constraints: with 8 it does not in one of 250 trials.
    map_of_engine = {"rotation": mrdl} if settings.engine == "exact" else {"substeps": 12}
    integrator = SIERHMCIntegrator(
        TEMPERATURE,
        h,
        SIER4G,
        pressure=KT / BAR,
        barostatInterval=1,
        engine=settings.engine,
        extraChances=2,
        **map_of_engine,
    )
    integrator.setRandomNumberSeed(round(field))
    cosines, squares, volumes = [], [], []
    mean = 1 / math.tanh(field) - 1 / field
    for state in samples(settings, system, integrator, np.tile(sites, (n, 1)), (1,)):
        z = md(state.getPositions(asNumpy=True))[:, 2]
        observed = (z[1::3] - z[2::3]) / length
        cosines.append(observed.mean())
        squares.append(((observed - mean) ** 2).mean())
        volumes.append(md(state.getPeriodicBoxVolume()))
    title = f"Dipoles in a field of {field:g} kT, SIER4G, acceptance {integrator.acceptanceRate:.3f}"
    return [
        _row(title, "cosine", cosines, mean),
        _row(title, "its variance", squares, 1 / field**2 - 1 / math.sinh(field) ** 2),
        _row(title, "volume of the gas", volumes, n + 1),
        _row(title, "its variance", list((np.array(volumes) - n - 1) ** 2), n + 1),
    ]


def study(settings: ExactnessSettings, report: Report = SILENT) -> Record:
    """All models, each in a process of its own; writes `record_of`."""
    with ProcessPoolExecutor(settings.processes) as pool:
        found = [
            pool.submit(dipoles, settings, 3.0, 0.125),
            pool.submit(dipoles, settings, 10.0, 0.083),
            pool.submit(wells, settings, 0.02, (2, 3, 4), 0.0),
            pool.submit(wells, settings, 0.016, (1,), 0.9),
        ]
        rows = pd.DataFrame([row for each in found for row in each.result()]).assign(
            engine=settings.engine, platform=settings.platform, trials=settings.trials
        )
    for model, mine in rows.groupby("model", sort=False):
        report.table(str(model), text.table(mine, COLUMNS))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / record_of(settings))


def record_of(settings: ExactnessSettings) -> str:
    """Name of the record: exactness.json by default, and such as exactness-native-opencl.json."""
    if (settings.engine, settings.platform) == (ExactnessSettings.engine, ExactnessSettings.platform):
        return "exactness.json"
    precision = "" if settings.precision == ExactnessSettings.precision else f"-{settings.precision}"
    return f"exactness-{settings.engine}-{settings.platform}{precision}.json".lower()


main = command(ExactnessSettings, study, __doc__, __name__)
