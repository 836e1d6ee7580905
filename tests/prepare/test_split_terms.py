"""Forces with terms on bodies, of which those on points alone become fast; and models that need no fast forces."""

import copy

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies, SIERIntegrator, prepare_system, select_bodies
from openmm_sier.prepare.split_terms import OF_POINTS
from tests.support import domains
from tests.support.domains import LENGTH, STRENGTH, domain_system, folded, topology_of
from tests.support.silence import silence
from tests.support.waters import array, platform

#: With the masses of carbon and this, kJ/mol/nm^2, bonds have a period of 30 fs, as those of atoms.
STIFF = 2.6e5


@pytest.fixture
def stiff(monkeypatch):
    """A chain with two domains whose bonds are as fast as those of atoms: System, bodies and positions."""
    monkeypatch.setattr(domains, "STRENGTH", STIFF)
    topology, positions, system = topology_of(), folded(), domain_system(elastic=False)
    for i in range(system.getNumParticles()):
        system.setParticleMass(i, 12.0)
    # Ryckaert and Bellemans' torsions along the linkers and into the domains.
    torsions = openmm.RBTorsionForce()
    for i in range(11, 25):
        torsions.addTorsion(i - 2, i - 1, i, i + 1, 1.0, 0.5, -0.3, 0.2, 0.1, -0.1)
    system.addForce(torsions)
    bodies = RigidBodies.from_system(system, topology, select_bodies(topology, domains.descriptions()), positions)
    q, A = bodies.fit(positions)
    return system, bodies, bodies.place(q, A, positions)


def energy_and_forces(system, positions, groups=-1):
    context = openmm.Context(copy.deepcopy(system), openmm.VerletIntegrator(0.001), platform())
    context.setPositions(positions)
    state = context.getState(energy=True, forces=True, groups=groups)
    return state.getPotentialEnergy()._value, array(state.getForces())


def test_terms_on_points_alone_become_fast(stiff):
    """Energies are those before, less the constant that is told, and bodies feel the same."""
    system, bodies, positions = stiff
    before, forces = energy_and_forces(system, positions)
    prepared = prepare_system(system, bodies)
    after, now = energy_and_forces(system, positions)
    # Sums of some 1000 kJ/mol, and of forces of some 1000 kJ/mol/nm.
    assert before - after == pytest.approx(prepared.excludedEnergy._value, abs=1e-9)
    _, A = bodies.fit(positions)
    np.testing.assert_allclose(bodies.forces_and_torques(now, A), bodies.forces_and_torques(forces, A), atol=1e-8)
    fast = [force for force in system.getForces() if force.getForceGroup() == 1]
    kinds = ["HarmonicBondForce", "HarmonicAngleForce", "PeriodicTorsionForce", "RBTorsionForce"]
    assert [force.getName() for force in fast[:-1]] == [kind + OF_POINTS for kind in kinds]
    # Fast forces move points alone, and move some.
    _, moved = energy_and_forces(system, positions, {1})
    assert not moved[~bodies.point_particles].any()
    assert np.count_nonzero(moved[bodies.point_particles].any(axis=1)) > 8
    assert prepared.fastForceGroups == {1}


def test_bonds_between_a_linker_and_a_body_stay_in_the_kicks(stiff):
    system, bodies, _ = stiff
    told = str(prepare_system(system, bodies))
    assert "Force group 1 has the fast forces now: HarmonicBondForce of points" in told
    assert "HarmonicBondForce, HarmonicAngleForce, PeriodicTorsionForce, RBTorsionForce" in told
    bonds = next(force for force in system.getForces() if force.getName() == "HarmonicBondForce")
    strengths = {tuple(bonds.getBondParameters(i)[:2]): bonds.getBondParameters(i)[3]._value for i in range(13)}
    # The first bead is a linker, the second one of a domain, and so on (residues 2 to 13).
    assert strengths[0, 1] == STIFF
    assert strengths[13, 14] == 0


def test_prepared_again_it_stays_as_it_is(stiff):
    system, bodies, _ = stiff
    prepare_system(system, bodies)
    before = openmm.XmlSerializer.serialize(system)
    prepare_system(system, bodies)
    assert openmm.XmlSerializer.serialize(system) == before


@pytest.mark.parametrize("regrouped", [False, True])
def test_integrators_find_them(stiff, regrouped):
    system, bodies, positions = stiff
    prepare_system(system, bodies)
    if regrouped:
        for number, force in enumerate(system.getForces()):
            force.setForceGroup(number)
    integrator = SIERIntegrator(0.002, "SIER4G", bodies=bodies)
    with silence():
        context = openmm.Context(system, integrator, platform())
    context.setPositions(positions)
    integrator.step(1)
    fast = [force for force in system.getForces() if force.getForceGroup() in integrator.fastForceGroups]
    assert len(fast) == 5


def test_forces_that_are_expressions_stay_whole(stiff):
    system, bodies, _ = stiff
    custom = openmm.CustomBondForce("k*(r-r0)^2")
    custom.addGlobalParameter("k", 100.0)
    custom.addGlobalParameter("r0", LENGTH)
    custom.addBond(0, 1, [])
    custom.addBond(14, 15, [])
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
def test_beads_need_no_fast_forces_and_the_usual_step_is_told(has_bodies):
    system, bodies, _ = coarse(has_bodies)
    prepared = prepare_system(system, bodies)
    assert prepared.fastForceGroups == frozenset()
    # Two beads of 110 dalton; a body that one of them is in makes the bond slower.
    period = 2000 * np.pi / np.sqrt(2 * STRENGTH / 110)
    assert f"has a period of {period:.3g} fs: usual steps are {period / 20:.2g} fs with SIER4G" in str(prepared)
    assert {force.getForceGroup() for force in system.getForces()} == {0}


def test_lists_of_particles_leave_the_step_at_that_of_beads_alone():
    system, _, _ = coarse(False)
    told = str(prepare_system(system, select_bodies(topology_of(), domains.descriptions())))
    assert f"a period of {2000 * np.pi / np.sqrt(2 * STRENGTH / 110):.3g} fs" in told


def test_a_group_that_is_asked_for_is_used():
    system, bodies, _ = coarse(True)
    assert prepare_system(system, bodies, fastForceGroup=3).fastForceGroups == {3}


@pytest.mark.parametrize("fast", ["angles", "expressions"])
def test_where_something_is_fast_or_not_known_nothing_is_coarse(fast):
    """A soft restraint between atoms whose bonds are constrained tells nothing of their angles."""
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
    with pytest.raises(openmm.OpenMMException, match="Take a shorter step, or constrain the bond") as refused:
        integrator.step(1)
    assert "prepare_system" not in str(refused.value)
