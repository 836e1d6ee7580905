"""Bodies of sixty atoms that no constraint holds, named by lists of atoms: energy, and constant pressure."""

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import SIER2, SIER4G, SIER4GIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics.constants import BAR
from tests.support.cages import cage, cage_in_water
from tests.support.flexible_systems import total_energy
from tests.support.waters import context_at, phase_point

KT = unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin) * 300


def langevin(h, bodies, friction=5.0, **options):
    made = SIERLangevinIntegrator(300, friction, h, bodies=bodies, **options)
    made.setRandomNumberSeed(5)
    return made


def settled(system, positions, bodies, steps=150, name="Reference"):
    """Positions and velocities near 300 K; this package's minimizer moves bodies as wholes."""
    context = context_at(system, langevin(0.002, bodies, 20.0), (positions, 0 * positions), name)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 200)
    context.setVelocitiesToTemperature(300, 1)
    context.getIntegrator().step(steps)
    return phase_point(context)


def shape_of(context, atoms):
    """All distances between atoms, nm."""
    found = phase_point(context)[0][atoms]
    return np.linalg.norm(found[:, None] - found[None], axis=2)


def test_energy_of_a_large_body_in_water():
    """The error is of fourth order, as with water alone.

    In a drop without a cut-off, whose forces are smooth. The error of a trajectory is h^4 times a function of the phase
    point, and a term of h^6 that is smaller by some (h w)^2: half the step has a tenth to a twenty-fifth of it. In all
    it is below a thousandth of the thermal energy of 246 degrees of freedom.
    """
    system, positions, bodies = cage_in_water(molecules=40, nonbonded=app.NoCutoff, removeCMMotion=False)
    assert bodies.dof == 6 * 41
    point, errors = settled(system, positions, bodies), []
    for h, steps in ((0.003, 24), (0.0015, 48)):
        context = context_at(system, SIER4GIntegrator(h, bodies=bodies), point)
        start, found = total_energy(context), []
        for _ in range(steps):
            context.getIntegrator().step(1)
            found.append(abs(total_energy(context) - start))
        errors.append(max(found))
    assert errors[0] < 1e-3 * 246 / 2 * KT
    assert 10 < errors[0] / errors[1] < 25


@pytest.mark.slow
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
    point = settled(system, positions, bodies, name="CPU")
    atoms = range(len(positions) - 60, len(positions))
    options = {"pressure": 1.0, "barostatInterval": 2} if barostat == "pressure=" else {}
    if not options:
        # OpenMM's barostat takes the atoms for sixty molecules unless bonds join them.
        bonds = openmm.HarmonicBondForce()
        for i in atoms[1:]:
            bonds.addBond(atoms[0], i, 0.1, 0.0)
        system.addForce(bonds)
        moves = openmm.MonteCarloBarostat(1.0, 300, 2)
        moves.setRandomNumberSeed(3)
        system.addForce(moves)
    made = langevin(0.002, bodies, scheme=SIER4G, **options)
    context = context_at(system, made, point, "CPU", steps=1)
    expected, volumes, conserved = shape_of(context, atoms), set(), []
    for _ in range(25):
        made.step(4)
        volumes.add(context.getState().getPeriodicBoxVolume()._value)
        conserved.append(total_energy(context) - made.getHeat().value_in_unit(unit.kilojoule_per_mole))
    assert len(volumes) > 5
    assert np.abs(shape_of(context, atoms) - expected).max() < 1e-12
    if options:
        assert np.ptp(conserved) < 0.6


@pytest.mark.slow
def test_volume_of_an_ideal_gas_of_large_bodies():
    """(N + 1) kT/P, with N the number of bodies and not that of atoms, which would be sixty times as many.

    Blocks of 200 moves, after which the volume has forgotten itself several times over, give the error.
    """
    n, pressure, edge = 8, 20.0, 3.3
    system = openmm.System()
    rigid = [[system.addParticle(12.011) for _ in range(60)] for _ in range(n)]
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    positions = (np.argwhere(np.ones((2, 2, 2)))[:, None] * edge / 2 + cage()).reshape(-1, 3)
    nothing = openmm.CustomBondForce("0")
    nothing.setUsesPeriodicBoundaryConditions(True)
    system.addForce(nothing)
    made = langevin(0.01, rigid, scheme=SIER2, pressure=pressure, barostatInterval=1)
    context = context_at(system, made, (positions, 0 * positions))
    context.setVelocitiesToTemperature(300, 1)
    made.step(200)
    found = []
    for _ in range(4000):
        made.step(1)
        found.append(context.getState().getPeriodicBoxVolume()._value)
    blocks = np.reshape(found, (20, 200)).mean(axis=1)
    expected, error = (n + 1) * KT / (pressure * BAR), blocks.std(ddof=1) / np.sqrt(20)
    assert error < 0.05 * expected
    assert abs(blocks.mean() - expected) < 4 * error
