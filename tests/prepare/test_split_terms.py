"""Forces with terms on rigid bodies, which become fast, and on frozen atoms, which do not; models that need neither."""

import copy

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies, SIERIntegrator, prepare_system, select_bodies
from openmm_sier.prepare import close_pairs
from openmm_sier.prepare.split_terms import OF_BODIES
from tests.support import domains
from tests.support.domains import LENGTH, STIFF, STRENGTH, domain_system, folded, stiff_chain, topology_of
from tests.support.silence import silence
from tests.support.waters import array, platform

#: Forces of which terms are fast.
KINDS = ["HarmonicBondForce", "HarmonicAngleForce", "PeriodicTorsionForce", "RBTorsionForce"]

#: A bead of the linker between two domains.
HELD = 18


def energy_and_forces(system, positions, groups=-1):
    context = openmm.Context(copy.deepcopy(system), openmm.VerletIntegrator(0.001), platform())
    context.setPositions(positions)
    state = context.getState(energy=True, forces=True, groups=groups)
    return state.getPotentialEnergy()._value, array(state.getForces())


@pytest.mark.parametrize("frozen", [(), (HELD,)], ids=["", "frozen"])
def test_the_system_stays_what_it_is(frozen):
    """Energies are those before, and bodies feel the same."""
    system, bodies, positions = stiff_chain(frozen)
    before, forces = energy_and_forces(system, positions)
    assert prepare_system(system, bodies).fastForceGroups == {1}
    after, now = energy_and_forces(system, positions)
    # Sums of some 1000 kJ/mol, and of forces of some 1000 kJ/mol/nm.
    assert after == pytest.approx(before, abs=1e-9)
    _, A = bodies.fit(positions)
    np.testing.assert_allclose(bodies.forces_and_torques(now, A), bodies.forces_and_torques(forces, A), atol=1e-8)


def test_terms_between_linkers_and_bodies_are_fast():
    system, bodies, positions = stiff_chain()
    message = str(prepare_system(system, bodies))
    assert f"Force group 1 has the fast forces now: {', '.join(KINDS)}." in message
    assert "stay slow forces" not in message
    # They move bodies, and turn them.
    _, moved = energy_and_forces(system, positions, {1})
    _, torques = bodies.forces_and_torques(moved, bodies.fit(positions)[1])
    extended = bodies.moments.any(axis=0)
    assert extended.sum() == 2
    assert (np.abs(torques[:, extended]).max(axis=0) > 1).all()


def test_close_pairs_of_linkers_and_bodies_are_fast_and_those_within_bodies_are_left_out():
    system, bodies, _ = stiff_chain()
    prepare_system(system, bodies)
    pairs = next(force for force in system.getForces() if force.getName() == close_pairs.NAME)
    ends = np.array([pairs.getBondParameters(i)[:2] for i in range(pairs.getNumBonds())])
    owners = bodies.owners[ends]
    assert (owners[:, 0] != owners[:, 1]).all()
    extended = bodies.moments.any(axis=0)[owners]
    # Both kinds are there, and none is more than four bonds along the chain.
    assert (extended.any(axis=1).any(), (~extended).all(axis=1).any()) == (True, True)
    assert np.abs(ends[:, 0] - ends[:, 1]).max() <= 4


def test_terms_on_frozen_atoms_stay_in_the_kicks():
    system, bodies, positions = stiff_chain([HELD])
    message = str(prepare_system(system, bodies))
    fast = [force for force in system.getForces() if force.getForceGroup() == 1]
    assert [force.getName() for force in fast[:-1]] == [kind + OF_BODIES for kind in KINDS]
    assert f"since they act on virtual sites or frozen atoms: {', '.join(KINDS)}." in message
    bonds = next(force for force in system.getForces() if force.getName() == "HarmonicBondForce")
    strengths = {tuple(bonds.getBondParameters(i)[:2]): bonds.getBondParameters(i)[3]._value for i in range(15)}
    # The first bead is a linker, the second one of a domain.
    assert strengths[0, 1] == 0
    assert strengths[HELD - 1, HELD] == STIFF
    _, moved = energy_and_forces(system, positions, {1})
    assert not moved[HELD].any()


@pytest.mark.parametrize("frozen", [(), (HELD,)], ids=["", "frozen"])
def test_prepared_again_it_stays_as_it_is(frozen):
    system, bodies, _ = stiff_chain(frozen)
    prepare_system(system, bodies)
    before = openmm.XmlSerializer.serialize(system)
    prepare_system(system, bodies)
    assert openmm.XmlSerializer.serialize(system) == before


@pytest.mark.parametrize("regrouped", [False, True])
def test_integrators_find_them(regrouped):
    """Also in a System that was prepared again since its groups were changed."""
    system, bodies, positions = stiff_chain([HELD])
    prepare_system(system, bodies)
    if regrouped:
        for number, force in enumerate(system.getForces()):
            force.setForceGroup(number)
        prepare_system(system, bodies)
    integrator = SIERIntegrator(0.002, "SIER4G", bodies=bodies)
    with silence():
        context = openmm.Context(system, integrator, platform())
    context.setPositions(positions)
    integrator.step(1)
    fast = [force for force in system.getForces() if force.getForceGroup() in integrator.fastForceGroups]
    assert len(fast) == 5


def test_forces_that_are_expressions_stay_whole():
    system, bodies, _ = stiff_chain([HELD])
    custom = openmm.CustomBondForce("k*(r-r0)^2")
    custom.addGlobalParameter("k", 100.0)
    custom.addGlobalParameter("r0", LENGTH)
    custom.addBond(0, 1, [])
    custom.addBond(HELD, 15, [])
    system.addForce(custom)
    assert "CustomBondForce" in str(prepare_system(system, bodies)).split("stay slow forces")[1]
    assert custom.getForceGroup() == 0


# --- coarse models ----------------------------------------------------------------------------------------------------


def coarse(has_bodies):
    topology, positions, system = topology_of(), folded(), domain_system()
    if not has_bodies:
        return system, None, positions
    bodies = RigidBodies.from_system(system, topology, select_bodies(topology, domains.descriptions()), positions)
    return system, bodies, positions


@pytest.mark.parametrize("has_bodies", [False, True])
def test_beads_need_no_fast_forces_and_the_usual_step_is_reported(has_bodies):
    system, bodies, _ = coarse(has_bodies)
    prepared = prepare_system(system, bodies)
    assert prepared.fastForceGroups == frozenset()
    # Two beads of 110 dalton; a body that one of them is in makes the bond slower.
    period = 2000 * np.pi / np.sqrt(2 * STRENGTH / 110)
    assert f"has a period of {period:.3g} fs: usual steps are {period / 20:.2g} fs with SIER4G" in str(prepared)
    assert {force.getForceGroup() for force in system.getForces()} == {0}


def test_lists_of_particles_leave_the_step_at_that_of_beads_alone():
    system, _, _ = coarse(False)
    message = str(prepare_system(system, select_bodies(topology_of(), domains.descriptions())))
    assert f"a period of {2000 * np.pi / np.sqrt(2 * STRENGTH / 110):.3g} fs" in message


def test_a_group_that_is_asked_for_is_used():
    system, bodies, _ = coarse(True)
    assert prepare_system(system, bodies, fastForceGroup=3).fastForceGroups == {3}


@pytest.mark.parametrize("fast", ["angles", "expressions"])
def test_where_something_is_fast_or_not_known_nothing_is_coarse(fast):
    """A soft restraint between atoms whose bonds are constrained does not constrain their angles."""
    system, _, _ = coarse(False)
    if fast == "angles":
        angles = next(force for force in system.getForces() if isinstance(force, openmm.HarmonicAngleForce))
        angles.setAngleParameters(3, 3, 4, 5, 2.0, 5000.0)
    else:
        custom = openmm.CustomBondForce("1000*(r-0.38)^2")
        custom.addBond(3, 9, [])
        system.addForce(custom)
    assert prepare_system(system).fastForceGroups == {1}


def test_a_step_that_is_too_long_is_not_answered_by_inner_steps():
    system, _, positions = coarse(False)
    prepare_system(system)
    integrator = SIERIntegrator(0.4, "SIER4G")
    context = openmm.Context(system, integrator, platform())
    context.setPositions(positions)
    with pytest.raises(openmm.OpenMMException, match=r"\(--dt\), or constrain the bond") as refused:
        integrator.step(1)
    assert "prepare_system" not in str(refused.value)
