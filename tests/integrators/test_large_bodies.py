"""Bodies of sixty atoms that no constraint holds, named by lists of atoms: energy, and constant pressure."""

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIER4G, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics.constants import GAS_CONSTANT
from tests.support.cages import cage_in_water
from tests.support.flexible_systems import total_energy
from tests.support.seeded import seeded
from tests.support.waters import context_at, phase_point


def langevin(h, bodies, friction=5.0, **options):
    return seeded(SIERLangevinIntegrator(300, friction, h, bodies=bodies, **options), 5)


def settled(system, positions, bodies):
    """Positions and velocities near 300 K; this package's minimizer moves bodies as wholes."""
    context = context_at(system, langevin(0.002, bodies, 20.0), (positions, 0 * positions), "CPU")
    openmm.LocalEnergyMinimizer.minimize(context, 10, 200)
    context.setVelocitiesToTemperature(300, 1)
    context.getIntegrator().step(150)
    return phase_point(context)


def shape_of(context, atoms):
    """All distances between atoms, nm."""
    point = phase_point(context)[0][atoms]
    return np.linalg.norm(point[:, None] - point[None], axis=2)


@pytest.mark.thorough
@pytest.mark.parametrize("barostat", ["pressure=", "MonteCarloBarostat"])
def test_a_large_body_in_water_at_constant_pressure(barostat):
    """The box changes, the body keeps its shape, and what the bath and the volume moves give is counted.

    Shapes are made from attitudes, so that distances are right to rounding. Only this package's volume moves count
    their heat: then the energy less the heat is conserved as at constant energy, to 0.1 kJ/mol over these steps.
    A move changes the energy by some kT, 2.5 kJ/mol.
    """
    cutoff = {"nonbondedCutoff": 0.8 * unit.nanometer, "switchDistance": 0.65 * unit.nanometer}
    system, positions, bodies = cage_in_water(**cutoff)
    prepare_system(system, bodies)
    point = settled(system, positions, bodies)
    atoms = range(len(positions) - 60, len(positions))
    options = {"pressure": 1.0, "barostatInterval": 2} if barostat == "pressure=" else {}
    if not options:
        # OpenMM's barostat takes the atoms for sixty molecules unless bonds join them.
        bonds = openmm.HarmonicBondForce()
        for i in atoms[1:]:
            bonds.addBond(atoms[0], i, 0.1, 0.0)
        system.addForce(bonds)
        system.addForce(seeded(openmm.MonteCarloBarostat(1.0, 300, 2)))
    result = langevin(0.002, bodies, scheme=SIER4G, **options)
    context = context_at(system, result, point, "CPU", steps=1)
    expected, volumes, conserved = shape_of(context, atoms), set(), []
    for _ in range(25):
        result.step(4)
        volumes.add(context.getState().getPeriodicBoxVolume()._value)
        conserved.append(total_energy(context) - result.getHeat().value_in_unit(unit.kilojoule_per_mole))
    # Of fifty moves, half of which are accepted.
    assert len(volumes) > 1
    assert np.abs(shape_of(context, atoms) - expected).max() < 1e-12
    if options:
        assert np.ptp(conserved) < 0.6


def test_velocities_that_openmm_draws_are_those_of_the_body():
    """Atoms of a body have no motion of their own, also in what the Context shows before the first step.

    The body alone has 6 degrees of freedom, of 180 that its atoms would have.
    """
    system, positions, bodies = cage_in_water(nonbondedCutoff=0.8 * unit.nanometer, removeCMMotion=False)
    result = langevin(0.002, bodies)
    context = context_at(system, result, (positions, 0 * positions))
    for change in (
        lambda: context.setVelocitiesToTemperature(300, 1),
        lambda: (context.setVelocities(positions), context.applyVelocityConstraints(1e-6)),
    ):
        change()
        shown = context.getState(energy=True).getKineticEnergy()._value
        temperature = result.computeSystemTemperature()._value
        # Sums over atoms and over bodies agree to rounding, and OpenMM's constraints of water to 1e-5.
        assert shown == pytest.approx(result.bodies.dof * GAS_CONSTANT * temperature / 2, rel=1e-4)
