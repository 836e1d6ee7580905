"""Molecules that are not rigid, by name: each runs, conserves energy to fourth order, and restarts to the bit."""

import openmm
import pytest
from openmm import app

from openmm_sier import RigidBodies, SIERIntegrator, SIERLangevinIntegrator, prepare_system
from tests.support import solutes
from tests.support.flexible import residual
from tests.support.flexible_systems import started, total_energy
from tests.support.peptides import capped_alanine_box, forcefield
from tests.support.restarts import assert_restart_is_the_same
from tests.support.seeded import seeded
from tests.support.solutes import disulfide, ion, spc, system_of, water
from tests.support.waters import context_at, phase_point

CONSTRAINTS = {"AllBonds": app.AllBonds, "HAngles": app.HAngles, "HBonds": app.HBonds, "None": None}


@pytest.fixture(scope="module")
def alanine():
    """Topology and positions of ACE-ALA-NME and two waters."""
    return capped_alanine_box(waters=2)


def largest_deviation(system, positions, h, steps, groups, bodies=None):
    """Of the total energy from its start, kJ/mol, over steps of h."""
    integrator = SIERIntegrator(h, bodies=bodies, fastForceGroups=groups)
    context = started(system, integrator, positions, steps=0)
    start, result = total_energy(context), []
    for _ in range(steps):
        integrator.step(1)
        result.append(abs(total_energy(context) - start))
    assert residual(integrator.bodies.constraints, integrator.getBodyState().q) < 1e-13
    return max(result)


def check(system, positions, h, bodies=None):
    """Prepare, run, conserve and restart.

    The energy error of a trajectory is h^4 times a function of the phase point, and a term of h^6 that is smaller by
    some (h w)^2, so that half the step has between a tenth and a twenty-fifth of the error. Steps are short for that.
    """
    prepared = prepare_system(system, bodies)
    groups = prepared.fastForceGroups
    coarse = largest_deviation(system, positions, h, 24, groups, bodies)
    fine = largest_deviation(system, positions, h / 2, 48, groups, bodies)
    dof = 3 * system.getNumParticles()
    # A thousandth of the thermal energy.
    assert coarse < 1e-3 * 1.25 * dof
    assert 10 < coarse / fine < 25

    def langevin():
        return seeded(SIERLangevinIntegrator(300, 5, h, bodies=bodies, fastForceGroups=groups), 5)

    context = started(system, langevin(), positions, steps=3)
    assert_restart_is_the_same(system, context, langevin(), 4)


@pytest.mark.parametrize("constraints", CONSTRAINTS)
def test_peptide(alanine, constraints):
    topology, positions = alanine
    system = forcefield().createSystem(topology, constraints=CONSTRAINTS[constraints], removeCMMotion=False)
    context = context_at(system, openmm.VerletIntegrator(0.001), (positions, 0 * positions))
    context.applyConstraints(1e-9)
    positions, _ = phase_point(context)
    # A System with a Context cannot be prepared.
    del context
    check(system, positions, h=0.001)


def test_mixed_box_with_carbon_dioxide():
    """Periodic: CO2 with the carbon as a virtual site and as a named body, water, ions, a disulfide, flexible SPC."""
    molecules = [solutes.carbon_dioxide(), water(), ion("Na"), disulfide().with_hydrogens_held(), ion("Cl"), spc()]
    system, positions = system_of(molecules, dumbbells=2, box=3.0)
    bodies = RigidBodies.from_system(system, rigid=[[0, 1, 2]], positions=positions)
    # Three lines, a water, two ions, ten atoms with six constraints, three atoms.
    assert bodies.dof == 3 * 5 + 6 + 2 * 3 + (30 - 6) + 9
    check(system, positions, 0.001, bodies)
