"""A long run at constant energy of a small box of water: what drifts, what stays rigid, what memory it takes.

    python -m studies.checks.soak [--steps N] [--platform NAME]

prints a table and writes soak.json. The run is checked from time to time; for quantities that must stay
small, the table has the largest value seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from time import perf_counter

import numpy as np
import openmm
import pandas as pd
from openmm import app, unit

from openmm_sier import SIERIntegrator
from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.measure import forcefields
from openmm_sier.measure.observables import energy_error
from openmm_sier.measure.report import duration
from openmm_sier.measure.starts import make_context, prepare
from openmm_sier.measure.statistics import mean_and_error
from studies import boxes, records, sampling
from studies.command import Settings, chosen, command
from studies.records import Record
from studies.report import SILENT, Report

#: How often the run is checked, steps between two energies, and ps of equilibration.
LOOKS, EVERY, EQUILIBRATION = 20, 500, 20.0


def water(molecules: int) -> tuple[openmm.System, unit.Quantity]:
    """System and positions of a cubic box of TIP3P water on a lattice, at its density.

    The reaction field of a conductor and a switched Lennard-Jones potential leave no step at the cut-off, neither in
    the energy nor in the forces, so any drift is the integrator's.
    """
    topology, lattice = boxes.on_lattice(molecules)
    cutoff = forcefields.LARGEST_CUTOFF * topology.getUnitCellDimensions()[0]
    system = forcefields.load(["tip3p.xml"]).createSystem(
        topology,
        nonbondedMethod=app.CutoffPeriodic,
        nonbondedCutoff=cutoff,
        switchDistance=0.8 * cutoff,
        removeCMMotion=False,
    )
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    nonbonded.setReactionFieldDielectric(1e9)
    return system, lattice * unit.nanometer


def deformation(positions: np.ndarray, bodies: RigidBodies) -> float:
    """The largest difference in nm between a distance in a body and the same in the reference geometry."""
    differences = [0.0]
    for species in bodies.species:
        for i, j in combinations(range(species.atoms.shape[1]), 2):
            lengths = np.linalg.norm(positions[species.atoms[:, i]] - positions[species.atoms[:, j]], axis=1)
            reference = np.linalg.norm(species.sites[:, i] - species.sites[:, j])
            differences.append(float(np.abs(lengths - reference).max()))
    return max(differences)


def memory() -> float:
    """Resident memory of this process in MiB; NaN where /proc does not have it."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")), float("nan"))


def look(context: openmm.Context) -> dict[str, float]:
    """The present figures of the Context and its bodies, in nm, dalton nm/ps and MiB."""
    integrator = context.getIntegrator()
    bodies, state = integrator.bodies, integrator.getBodyState()
    positions = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    products = np.einsum("abn,cbn->acn", state.A, state.A) - np.eye(3)[:, :, None]
    return {
        "step": context.getStepCount(),
        "orthogonality": float(np.abs(products).max()),
        "deformation": deformation(positions, bodies),
        "momentum": float(np.linalg.norm(bodies.total_momenta(state)[0])),
        "memory": memory(),
    }


def drift(parts: list[sampling.Series]) -> tuple[float, float]:
    """Slope of the total energy in kJ/mol/ps and its standard error.

    It is the mean of the changes from each part of the run to the next, with the error of that mean: forces in single
    precision let the energy walk at random, and the scatter about a straight line would make the error too small.
    """
    time, total = np.array([[part.time.mean(), part.total.mean()] for part in parts]).T
    return mean_and_error(np.diff(total) / np.diff(time))[:2]


@dataclass(frozen=True)
class SoakSettings(Settings):
    """What is run.

    Attributes:
        steps: their number.
        scheme: by name.
        dt: step, fs.
        molecules: of water.
        temperature: K.
        platform: of OpenMM.
    """

    steps: int = 1_000_000
    scheme: str = "sier2"
    dt: float = 1.0
    molecules: int = 64
    temperature: float = 297.0
    platform: str = "CPU"


COLUMNS = {"": "{name}", " ": "{text}"}


def study(settings: SoakSettings, report: Report = SILENT) -> Record:
    """Equilibrate and run, and write soak.json.

    Raises:
        ValueError: there are too few steps, or no such scheme.
    """
    if settings.steps < LOOKS * EVERY:
        raise ValueError(f"steps must be at least {LOOKS * EVERY}, got {settings.steps}")
    (scheme,) = chosen((settings.scheme,), CATALOGUE, "scheme")
    system, positions = water(settings.molecules)
    integrator = SIERIntegrator(settings.dt / 1000, scheme)
    context = make_context(system, integrator, settings.platform)
    prepare(context, positions, settings.temperature, settings.seed, EQUILIBRATION, report=report)
    looks, parts, begun = [look(context)], [], perf_counter()
    for _ in range(LOOKS):
        parts.append(sampling.sample(context, integrator.bodies, settings.steps // LOOKS, EVERY))
        looks.append(look(context))
    seconds = (perf_counter() - begun) / looks[-1]["step"]
    found = pd.DataFrame(looks)
    slope, error = drift(parts)
    thermal = 2 * float(np.mean([part.kinetic.mean() for part in parts]))
    total, potential = (np.concatenate([getattr(part, name) for part in parts]) for name in ("total", "potential"))
    momenta, memories = found["momentum"], found["memory"]
    rows = {
        "energy drift": f"{slope:+.2e} ± {error:.1e} kJ/mol/ps",
        "the same in kT per degree of freedom": f"{1e3 * slope / thermal:+.2e} ± {1e3 * error / thermal:.1e} per ns",
        "rms(H)/rms(V)": f"{100 * energy_error(total, potential):.3f} %",
        "largest |A A^T - 1|": f"{found['orthogonality'].max():.1e}",
        "largest error of a distance in a molecule": f"{found['deformation'].max():.1e} nm",
        "total momentum, first and last": f"{momenta.iloc[0]:.1e}, {momenta.iloc[-1]:.1e} dalton nm/ps",
        "memory, first, middle and last": ", ".join(f"{memories.iloc[i]:.1f}" for i in (0, 10, -1)) + " MiB",
        "wall time per step": duration(seconds),
    }
    told = pd.DataFrame({"name": list(rows), "text": list(rows.values())})
    title = f"{settings.molecules} molecules of water, {looks[-1]['step']} steps of {settings.dt:g} fs, {scheme.name}, "
    report.table(records.table(f"{title}{settings.platform} platform", told, COLUMNS))
    return Record(settings.recorded(), {"looks": found, "told": told}, {}).write(settings.out / "soak.json")


main = command(SoakSettings, study, __doc__, __name__)
