"""The native engine beside the exact one: rms(H)/rms(V) of liquids by scheme, platform and number of substeps.

    python -m studies.native.accuracy [--box systems/tip3p-512.pdb | systems/peptide.pdb | co2] [--time 0.3]
        [--schemes sier4g ...] [--substeps 2 3 5] [--fs 1 2] [--on CPU OpenCL:double OpenCL:mixed] [--molecules 64]

prints one line per run: the exact engine's on the CPU first, then the native engine's with the ratio of both. All runs
of a box start from one phase point. The step is `--fs` times the force evaluations of the scheme. `--molecules` takes
that many molecules of the box, in a smaller box of the same density, for slow platforms.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import SIERIntegrator, prepare_system
from openmm_sier.dynamics.schemes import CATALOGUE, Scheme
from openmm_sier.measure import forcefields
from openmm_sier.measure.observables import energy_drift, energy_error

SYSTEMS = Path(__file__).resolve().parents[2] / "systems"

TEMPERATURE, SEED = 297.0, 7

#: Steps of 2 fs before the runs, and of 1 fs in a strong bath before those of boxes that are set up here.
EQUILIBRATION, MELTING = 1000, 2000

#: ps between two energies.
INTERVAL = 0.004

#: Carbon dioxide, EPM2 (Harris and Yung, J. Phys. Chem. 99, 12021 (1995)): C-O in nm, charge of C, sigma and epsilon.
CO_LENGTH, CHARGE, CARBON, OXYGEN = 0.1149, 0.6512, (0.2757, 0.23388), (0.3033, 0.66937)
MASS_C, MASS_O = 12.011, 15.9994

#: Molecules of carbon dioxide and their number in a nm^3, 0.8 g/cm^3.
CO2_MOLECULES, CO2_DENSITY = 256, 10.95


def carbon_dioxide() -> tuple[openmm.System, np.ndarray]:
    """System and positions of EPM2: two mass points at a constrained distance, which carry C and both O.

    The masses are half the molecule's and their distance gives it its moment of inertia, since OpenMM's constraints
    cannot hold three atoms on a line.
    """
    molecule = MASS_C + 2 * MASS_O
    distance = CO_LENGTH * np.sqrt(8 * MASS_O / molecule)
    edge = (CO2_MOLECULES / CO2_DENSITY) ** (1 / 3)
    system, force = openmm.System(), openmm.NonbondedForce()
    system.setDefaultPeriodicBoxVectors(*np.diag([edge] * 3))
    cells, rng = int(np.ceil(CO2_MOLECULES ** (1 / 3))), np.random.default_rng(SEED)
    lattice = (np.stack(np.meshgrid(*[np.arange(cells)] * 3), axis=-1).reshape(-1, 3) + 0.5) * edge / cells
    positions = []
    for centre in rng.permutation(lattice)[:CO2_MOLECULES]:
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        first = system.addParticle(molecule / 2)
        system.addParticle(molecule / 2)
        system.addConstraint(first, first + 1, distance)
        force.addParticle(0, 1, 0)
        force.addParticle(0, 1, 0)
        for place, charge, kind in ((0, CHARGE, CARBON), (-1, -CHARGE / 2, OXYGEN), (1, -CHARGE / 2, OXYGEN)):
            weight = 0.5 + place * CO_LENGTH / distance
            site = system.addParticle(0)
            system.setVirtualSite(site, openmm.TwoParticleAverageSite(first, first + 1, 1 - weight, weight))
            force.addParticle(charge, *kind)
        for i in range(first, first + 5):
            for j in range(first, i):
                force.addException(i, j, 0, 1, 0)
        reach = np.array([-distance / 2, distance / 2, 0, -CO_LENGTH, CO_LENGTH])
        positions.append(centre + reach[:, None] * axis)
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    force.setCutoffDistance(0.9)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(0.75)
    system.addForce(force)
    return system, np.concatenate(positions)


def small_box(path: str, molecules: int) -> tuple[openmm.System, unit.Quantity]:
    """System and positions of water of a box's force field, at its density, on no lattice of its own."""
    box = forcefields.read_box(path)
    field = forcefields.load(box.choice.files, Path(path).parent)
    vectors = np.array(box.topology.getPeriodicBoxVectors().value_in_unit(unit.nanometer))
    edge = vectors[0, 0] * (molecules / box.topology.getNumResidues()) ** (1 / 3)
    modeller = app.Modeller(box.topology, box.positions)
    centres = {r: box.positions[next(r.atoms()).index].value_in_unit(unit.nanometer) for r in box.topology.residues()}
    # The molecules next to a corner, pulled together a little where the cut goes through the liquid.
    ranked = sorted(centres, key=lambda residue: max(np.mod(centres[residue], vectors[0, 0])))
    modeller.delete(ranked[molecules:])
    modeller.topology.setPeriodicBoxVectors(np.diag([edge] * 3) * unit.nanometer)
    return forcefields.pme_system(modeller.topology, field), modeller.positions


def start(path: str, molecules: int | None, tolerance: float = 1e-5) -> tuple[openmm.System, openmm.State, frozenset]:
    """System, State and fast force groups of a box; hydrogens of solutes are constrained.

    With the usual tolerance PME is exact enough to see the schemes' errors.
    """
    if path == "co2":
        system, positions = carbon_dioxide()
    elif molecules is not None:
        system, positions = small_box(path, molecules)
    else:
        box = forcefields.read_box(path, constraints="hbonds")
        system, positions = box.system, box.positions
    for force in system.getForces():
        if isinstance(force, openmm.NonbondedForce):
            force.setEwaldErrorTolerance(tolerance)
    fast = prepare_system(system).fastForceGroups
    bath = openmm.LangevinMiddleIntegrator(TEMPERATURE, 5.0, 0.002)
    bath.setRandomNumberSeed(SEED)
    bath.setConstraintTolerance(1e-9)
    context = openmm.Context(system, bath, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(TEMPERATURE, SEED)
    if path == "co2" or molecules is not None:
        bath.setStepSize(0.001)
        bath.setFriction(20.0)
        bath.step(MELTING)
        bath.setStepSize(0.002)
    bath.step(EQUILIBRATION)
    return system, context.getState(positions=True, velocities=True), fast


def context_on(place: str, system: openmm.System, integrator: openmm.Integrator) -> openmm.Context:
    """A Context on `place`: a platform, and after a colon its precision."""
    name, _, precision = place.partition(":")
    properties = {"Precision": precision} if precision else {}
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName(name), properties)


def run(context: openmm.Context, state: openmm.State, step: float, time: float) -> tuple[float, float]:
    """rms(H)/rms(V) in % and drift in kJ/mol/ps, from energies as OpenMM computes them."""
    integrator = context.getIntegrator()
    integrator.setStepSize(step)
    context.setState(state)
    every = max(1, round(INTERVAL / step))
    rows = []
    for _ in range(round(time / (step * every))):
        integrator.step(every)
        found = context.getState(energy=True)
        rows.append([found.getTime()._value, found.getPotentialEnergy()._value, found.getKineticEnergy()._value])
    times, potential, kinetic = np.array(rows).T
    return 100 * energy_error(times, potential + kinetic, potential, None), energy_drift(times, potential + kinetic)[0]


def compare(
    system: openmm.System, state: openmm.State, fast: frozenset, scheme: Scheme, options: argparse.Namespace
) -> None:
    """Print the lines of one scheme."""
    cases = [("exact", options.exact_on, None)]
    cases += [("native", place, k) for place in options.on for k in options.substeps]
    exact: dict[float, float] = {}
    for engine, place, k in cases:
        integrator = SIERIntegrator(0.001, scheme, engine=engine, substeps=k, fastForceGroups=fast)
        context = context_on(place, system, integrator)
        for fs in options.fs:
            error, drift = run(context, state, 1e-3 * fs * scheme.force_evaluations, options.time)
            ratio = f"{error / exact.setdefault(fs, error):6.3f}"
            name = f"{engine} on {place}" + ("" if k is None else f", {k} substeps")
            print(f"{scheme.name:7} {fs:g} fs  {name:36} {error:9.5f} %  {ratio}  {drift:+8.3f} kJ/mol/ps", flush=True)
        del context, integrator


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--box", default=str(SYSTEMS / "tip3p-512.pdb"))
    parser.add_argument("--molecules", type=int)
    parser.add_argument("--schemes", nargs="+", default=list(CATALOGUE), choices=CATALOGUE)
    parser.add_argument("--substeps", nargs="+", type=int, default=[None], help="default: the usual ones")
    parser.add_argument("--fs", nargs="+", type=float, default=[1.0, 2.0])
    parser.add_argument("--on", nargs="+", default=["CPU"])
    parser.add_argument("--exact-on", default="CPU")
    parser.add_argument("--time", type=float, default=0.3)
    options = parser.parse_args()
    system, state, fast = start(options.box, options.molecules)
    print(f"{Path(options.box).stem}, {options.molecules or 'all'} molecules, {options.time:g} ps", flush=True)
    for name in options.schemes:
        compare(system, state, fast, CATALOGUE[name], options)


if __name__ == "__main__":
    main()
