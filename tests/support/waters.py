"""Small water systems for the tests that need a Context."""

import functools
import random

import numpy as np
import openmm
from openmm import app, unit

from tests.support.seeded import seeded
from tests.support.starts import displaced, stored
from tests.support.systems import field


def platform(name="Reference"):
    return openmm.Platform.getPlatformByName(name)


@functools.cache
def water_box(model="tip3p", molecules=64, ions=False):
    """Topology, positions (N, 3) in nm and force field of a cubic box of water, deterministic."""
    names = {"tip3p": "tip3p", "tip4pew": "tip4pew", "tip5p": "tip5p", "spce": "spce"}
    field = app.ForceField("amber14/tip3p.xml" if ions else f"{names[model]}.xml")
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    edge = (molecules / 33.4) ** (1 / 3)
    # OpenMM sets the molecules from a file, and picks those that ions replace at random.
    random.seed(20070518)
    shape = {"tip5p": "tip5p", "tip4pew": "tip4pew", "spce": "spce"}.get(model, "tip3p")
    if ions:
        modeller.addSolvent(field, model=shape, boxSize=openmm.Vec3(edge, edge, edge), ionicStrength=1 * unit.molar)
    else:
        modeller.addSolvent(field, model=shape, boxSize=openmm.Vec3(edge, edge, edge))
    positions = np.array(modeller.positions.value_in_unit(unit.nanometer))
    return modeller.topology, positions, field


def periodic_system(model="tip3p", molecules=64, ions=False, tolerance=8e-4, **options):
    """Topology, positions and a PME System of a small box.

    With this tolerance the mesh of 64 molecules has 16 points along an edge, and 18 after preparing. With 1e-4 it would
    have 28 and 31, with which forces of the Reference platform take two and five times as long.
    """
    topology, positions, field = water_box(model, molecules, ions)
    system = field.createSystem(
        topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=0.55 * unit.nanometer,
        ewaldErrorTolerance=tolerance,
        **options,
    )
    return topology, displaced(positions, system), system


def cluster_system(molecules=8, model="tip3p", **options):
    """Topology, positions and System of isolated molecules, without a cut-off."""
    topology, positions, field = water_box(model)
    size = len(positions) // topology.getNumResidues() * molecules
    modeller = app.Modeller(topology, positions * unit.nanometer)
    centre = positions.mean(axis=0)
    residues = list(topology.residues())
    distances = [np.linalg.norm(positions[next(r.atoms()).index] - centre) for r in residues]
    modeller.delete([residues[i] for i in np.argsort(distances, kind="stable")[molecules:]])
    topology, positions = modeller.topology, np.array(modeller.positions.value_in_unit(unit.nanometer))
    topology.setPeriodicBoxVectors(None)
    if len(positions) != size:
        raise ValueError(f"expected {size} atoms, got {len(positions)}")
    system = field.createSystem(topology, removeCMMotion=False, **options)
    return topology, displaced(positions, system), system


def relaxed(name, topology, positions, system, temperature=297.0, seed=7, steps=300):
    """Positions and velocities (N, 3) after minimization and a short Langevin run, as they are stored by a name."""

    def made():
        integrator = seeded(openmm.LangevinMiddleIntegrator(temperature, 10.0, 0.001), seed)
        simulation = app.Simulation(topology, system, integrator, platform("CPU"))
        simulation.context.setPositions(positions)
        simulation.minimizeEnergy(maxIterations=100)
        simulation.context.setVelocitiesToTemperature(temperature, seed)
        simulation.step(steps)
        return dict(zip(("positions", "velocities"), phase_point(simulation.context), strict=True))

    start = stored(name, made)
    return displaced(start["positions"], system), start["velocities"]


def settled(name, topology, positions, system, **options):
    """Topology, System, and the positions and velocities (N, 3) near 297 K that are stored by a name.

    Tests change no System but copies of it.
    """
    return topology, system, relaxed(name, topology, positions, system, **options)


def array(quantity):
    return np.array(quantity.value_in_unit_system(unit.md_unit_system))


def phase_point(context):
    """Positions and velocities of a Context, (N, 3) each."""
    state = context.getState(positions=True, velocities=True)
    return (
        state.getPositions(asNumpy=True).value_in_unit(unit.nanometer).copy(),
        state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond).copy(),
    )


def energies(context):
    """Potential and kinetic energy of a Context, kJ/mol."""
    state = context.getState(energy=True)
    return tuple(
        e.value_in_unit(unit.kilojoule_per_mole) for e in (state.getPotentialEnergy(), state.getKineticEnergy())
    )


def properties_of(name, precision="double"):
    """Properties of a platform: one thread of the CPU platform, and a precision where there are several."""
    if name == "CPU":
        return {"Threads": "1", "DeterministicForces": "true"}
    return {} if name == "Reference" else {"Precision": precision}


def context_at(system, integrator, point, name="Reference", steps=None):
    """A Context at positions and velocities, after steps of its integrator if these are given."""
    context = openmm.Context(system, integrator, platform(name), properties_of(name))
    context.setPositions(point[0])
    context.setVelocities(point[1])
    if steps is not None:
        integrator.step(steps)
    return context


def judged(system, integrator):
    """A Context whose step has been judged, as its first step would be."""
    context = openmm.Context(system, integrator, platform())
    integrator.impl.refuse_long_step()
    return context


def plain_context(system, positions, name="Reference"):
    """A Context at positions, of one of OpenMM's own integrators, for energies and forces."""
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform(name), properties_of(name))
    context.setPositions(positions)
    return context


def force_of(system, kind=openmm.NonbondedForce):
    """The first Force of a kind in a System."""
    return next(force for force in system.getForces() if isinstance(force, kind))


def droplet(molecules=27, stiffness=50.0):
    """Topology, positions and System of a drop of water whose oxygens a weak harmonic force in kJ/mol/nm^2 holds.

    Forces are smooth and have no cut-off, so that energies show the order of a scheme, and cheap.
    """
    topology, positions, system = cluster_system(molecules)
    oxygens = [atom.index for atom in topology.atoms() if atom.element.symbol == "O"]
    system.addForce(field("0.5*stiffness*(x^2+y^2+z^2)", oxygens, stiffness=stiffness))
    return topology, positions - positions[oxygens].mean(axis=0), system
