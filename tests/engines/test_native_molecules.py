"""Fast forces of flexible molecules with the native engine, beside the exact one."""

from __future__ import annotations

import numpy as np
import openmm
import pytest

from openmm_sier import SIER4G, SIERIntegrator
from openmm_sier.engines.native import program as native_program
from tests.support.ethane import ethane
from tests.support.waters import context_at, energies, phase_point


@pytest.fixture(scope="module")
def molecule():
    """Ethane with its bond and angles in group 1, in a field, moving."""
    system, positions = ethane()
    for force in system.getForces():
        force.setForceGroup(1)
    field = openmm.CustomExternalForce("30*x*y + 20*z^2")
    for i in range(system.getNumParticles()):
        field.addParticle(i, [])
    system.addForce(field)
    context = context_at(system, openmm.VerletIntegrator(0.001), (positions, np.zeros((8, 3))))
    context.setVelocitiesToTemperature(300, 3)
    return system, phase_point(context)


def end(molecule, h, steps, **settings) -> np.ndarray:
    system, point = molecule
    integrator = SIERIntegrator(h, SIER4G, fastForceGroups={1}, **settings)
    context = context_at(system, integrator, point)
    integrator.step(steps)
    return phase_point(context)[0]


def test_both_engines_go_to_one_trajectory(molecule):
    fine = end(molecule, 0.0005, 64, engine="exact")
    errors = [np.abs(end(molecule, 0.032 / n, n, engine="native") - fine).max() for n in (8, 16)]
    # Fourth order, 16 in the limit. Forces that are in drifts and kicks, or in neither, leave an error that stays.
    assert 11 < errors[0] / errors[1] < 22
    assert errors[1] < 1e-5


def test_program_is_that_of_the_groups_and_goes_through_xml(molecule):
    system, point = molecule
    integrator = SIERIntegrator(0.002, SIER4G, fastForceGroups={1}, engine="native")
    _context = context_at(system, integrator, point)
    assert integrator.engine == "native"
    assert integrator.program == native_program.write(SIER4G, None, {1})
    again = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(integrator))
    assert again.fastForceGroups == {1}
    assert again.program == integrator.program


def test_energy_is_conserved(molecule):
    system, point = molecule
    integrator = SIERIntegrator(0.004, SIER4G, engine="native", fastForceGroups={1})
    context = context_at(system, integrator, point)
    found = []
    for _ in range(100):
        integrator.step(1)
        found.append(sum(energies(context)))
    # The exact engine has 0.01 kJ/mol at this step.
    assert np.std(found) < 0.05


def test_groups_that_do_not_act_are_refused(molecule):
    system, point = molecule
    integrator = SIERIntegrator(0.002, SIER4G, engine="native", fastForceGroups={1})
    integrator.setIntegrationForceGroups({0})
    with pytest.raises(openmm.OpenMMException, match="fast force group 1 is not among the integration force groups"):
        context_at(system, integrator, point)


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_bonds_that_constraints_hold_do_not_vibrate(engine):
    """The constrained bond has a period of 9 fs, at which SIER4G bears no step of 6 fs; the other one 300 fs."""
    system, bonds = openmm.System(), openmm.HarmonicBondForce()
    for mass in (12.0, 1.0, 12.0):
        system.addParticle(mass)
    system.addConstraint(0, 1, 0.109)
    bonds.addBond(1, 0, 0.109, 4.5e5)
    bonds.addBond(0, 2, 0.153, 2.6e3)
    system.addForce(bonds)
    positions = np.array([[0.109, 0, 0], [0, 0, 0], [0.262, 0, 0]])
    integrator = SIERIntegrator(0.006, SIER4G, engine=engine)
    context_at(system, integrator, (positions, np.zeros((3, 3))))
    assert integrator.engine == engine
