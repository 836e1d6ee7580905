"""A long run at constant energy of a small box of water: what drifts, what stays rigid, what memory it takes.

    python -m studies.checks.soak [--steps N] [--platform NAME] [--out FILE]

prints a table and writes the same figures as JSON. The run is checked from time to time; for quantities that must stay
small, the table has the largest value seen.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import RigidBodies, SIERIntegrator
from openmm_sier.cli.console import REPORT, clock, note, table
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.measure import forcefields, sampling
from openmm_sier.measure.observables import energy_error
from openmm_sier.measure.report import duration
from openmm_sier.measure.starts import make_context, prepare
from openmm_sier.measure.statistics import mean_and_error

SYSTEMS = Path(__file__).resolve().parents[2] / "systems"

#: How often the run is checked, steps between two energies, and ps of equilibration.
LOOKS, EVERY, EQUILIBRATION = 20, 500, 20.0


def water(molecules: int, temperature: float, seed: int):
    """System and positions of a cubic box of TIP3P water on a lattice, at its density.

    The reaction field of a conductor and a switched Lennard-Jones potential leave no step at the cut-off, neither in
    the energy nor in the forces, so any drift is the integrator's.
    """
    make = _program(SYSTEMS / "make.py")
    forcefield = forcefields.load(["tip3p.xml"], SYSTEMS)
    topology = make.make_topology(molecules, 0)
    edge = make.box_edge(topology, make.water_density(temperature))
    topology.setUnitCellDimensions([edge] * 3 * unit.nanometer)
    lattice = make.start_positions(molecules, 0, edge, make.water_geometry(forcefield), np.random.default_rng(seed))
    cutoff = forcefields.LARGEST_CUTOFF * edge
    system = forcefield.createSystem(
        topology,
        nonbondedMethod=app.CutoffPeriodic,
        nonbondedCutoff=cutoff * unit.nanometer,
        switchDistance=0.8 * cutoff * unit.nanometer,
        removeCMMotion=False,
    )
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    nonbonded.setReactionFieldDielectric(1e9)
    return system, lattice * unit.nanometer


def _program(path: Path):
    """A program of the project as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def deformation(positions, bodies: RigidBodies) -> float:
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


def look(context) -> dict[str, float]:
    """The present figures of the Context and its bodies."""
    integrator = context.getIntegrator()
    bodies, state = integrator.bodies, integrator.getBodyState()
    positions = context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    products = np.einsum("abn,cbn->acn", state.A, state.A) - np.eye(3)[:, :, None]
    return {
        "step": context.getStepCount(),
        "orthogonality": float(np.abs(products).max()),
        "deformation_nm": deformation(positions, bodies),
        "momentum_dalton_nm_per_ps": float(np.linalg.norm(bodies.total_momenta(state)[0])),
        "memory_MiB": memory(),
    }


def drift(parts: list[sampling.Series]) -> tuple[float, float]:
    """Slope of the total energy in kJ/mol/ps and its standard error.

    It is the mean of the changes from each part of the run to the next, with the error of that mean: forces in single
    precision let the energy walk at random, and the scatter about a straight line would make the error too small.
    """
    time, total = np.array([[part.time.mean(), part.total.mean()] for part in parts]).T
    return mean_and_error(np.diff(total) / np.diff(time))[:2]


def soak(options) -> dict:
    """Equilibrate, run, and return the figures."""
    system, positions = water(options.molecules, options.temperature, options.seed)
    integrator = SIERIntegrator(options.dt / 1000, CATALOGUE[options.scheme])
    context = make_context(system, integrator, options.platform)
    prepare(context, positions, options.temperature, options.seed, EQUILIBRATION, report=REPORT)
    looks, parts, start = [look(context)], [], clock()
    for _ in range(LOOKS):
        parts.append(sampling.sample(context, integrator.bodies, options.steps // LOOKS, EVERY))
        looks.append(look(context))
    seconds = clock() - start
    return {
        "openmm": openmm.__version__,
        "settings": {**vars(options), "out": str(options.out)},
        "seconds_per_step": seconds / looks[-1]["step"],
        "degrees_of_freedom": integrator.bodies.dof,
        "drift_kJ_per_mol_per_ps": drift(parts),
        "kinetic_kJ_per_mol": float(np.mean([part.kinetic.mean() for part in parts])),
        "rms_H_over_rms_V": float(np.mean([energy_error(p.time, p.total, p.potential) for p in parts])),
        "energies_kJ_per_mol": [float(part.total.mean()) for part in parts],
        "looks": looks,
    }


def show(figures: dict) -> None:
    """Print the table."""
    settings, looks = figures["settings"], figures["looks"]
    slope, error = figures["drift_kJ_per_mol_per_ps"]
    thermal = 2 * figures["kinetic_kJ_per_mol"]
    memories = [each["memory_MiB"] for each in looks]
    rows = [
        ("energy drift", f"{slope:+.2e} ± {error:.1e} kJ/mol/ps"),
        ("the same in kT per degree of freedom", f"{1e3 * slope / thermal:+.2e} ± {1e3 * error / thermal:.1e} per ns"),
        ("rms(H)/rms(V)", f"{100 * figures['rms_H_over_rms_V']:.3f} %"),
        ("largest |A A^T - 1|", f"{max(each['orthogonality'] for each in looks):.1e}"),
        ("largest error of a distance in a molecule", f"{max(each['deformation_nm'] for each in looks):.1e} nm"),
        (
            "total momentum, first and last",
            "{:.1e}, {:.1e} dalton nm/ps".format(*(looks[i]["momentum_dalton_nm_per_ps"] for i in (0, -1))),
        ),
        ("memory, first, middle and last", "{:.1f}, {:.1f}, {:.1f} MiB".format(*(memories[i] for i in (0, 10, -1)))),
        ("wall time per step", duration(figures["seconds_per_step"])),
    ]
    title = f"{settings['molecules']} molecules of water, {looks[-1]['step']} steps of {settings['dt']:g} fs, "
    table(f"{title}{settings['scheme'].upper()}, {settings['platform']} platform", ("", ""), rows)


def parse(arguments):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1_000_000, help="default: %(default)s")
    parser.add_argument("--scheme", choices=sorted(CATALOGUE), default="sier2", help="default: %(default)s")
    parser.add_argument("--dt", type=float, default=1.0, help="step in fs (default: %(default)s)")
    parser.add_argument("--molecules", type=int, default=64, help="default: %(default)s")
    parser.add_argument("--temperature", type=float, default=297.0, help="K (default: %(default)s)")
    parser.add_argument("--platform", default="CPU", help="OpenMM's name of it (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("soak.json"), help="default: %(default)s")
    options = parser.parse_args(arguments)
    if options.steps < LOOKS * EVERY:
        parser.error(f"--steps must be at least {LOOKS * EVERY}")
    return options


def main(arguments=None) -> int:
    options = parse(arguments)
    figures = soak(options)
    options.out.write_text(json.dumps(figures, indent=1))
    show(figures)
    note(f"wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
