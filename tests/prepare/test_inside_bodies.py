"""Interactions within rigid bodies: excluded with the same forces on bodies, and the energy that is told less."""

import copy

import numpy as np
import openmm
import pytest

from openmm_sier import RigidBodies, SIERIntegrator, prepare_system, select_bodies, with_frames
from openmm_sier.prepare import inside_bodies
from openmm_sier.prepare.inside_bodies import PAIRWISE
from openmm_sier.system.boxes import widths
from tests.support.domains import DOMAINS, descriptions, domain_system, folded, topology_of
from tests.support.waters import periodic_system, platform


def chains(number=2, **options):
    """A System of chains with two domains each, its bodies, and positions in their exact shapes."""
    topology, positions = topology_of(number), folded(number)
    system = domain_system(number, **options)
    domains = select_bodies(topology, descriptions("ABCDEFGH"[:number]))
    bodies = RigidBodies.from_system(system, topology, domains, positions)
    q, A = bodies.fit(positions)
    return system, bodies, bodies.place(q, A, positions)


def on_bodies(system, bodies, positions, name="Reference"):
    """The potential energy, and the forces and torques on bodies."""
    context = openmm.Context(copy.deepcopy(system), openmm.VerletIntegrator(0.001), platform(name))
    context.setPositions(positions)
    state = context.getState(energy=True, forces=True)
    _, A = bodies.fit(positions)
    forces = bodies.forces_and_torques(state.getForces(asNumpy=True)._value, A)
    return state.getPotentialEnergy()._value, *forces


def unchanged_but_for_a_constant(system, bodies, positions):
    """Prepare a System and compare: sums of forces of some 2000 kJ/mol/nm in double precision."""
    before = on_bodies(system, bodies, positions)
    prepared = prepare_system(system, bodies)
    after = on_bodies(system, bodies, positions)
    assert before[0] - after[0] == pytest.approx(prepared.excludedEnergy._value, abs=1e-9)
    np.testing.assert_allclose(after[1:], before[1:], rtol=0, atol=1e-9)
    return prepared


def silent_pairs(force):
    """The pairs of atoms that a Force leaves out."""
    if isinstance(force, openmm.CustomNonbondedForce):
        return {tuple(sorted(force.getExclusionParticles(i))) for i in range(force.getNumExclusions())}
    found = (force.getExceptionParameters(i) for i in range(force.getNumExceptions()))
    return {tuple(sorted((a, b))) for a, b, q, _, epsilon in found if not q._value and not epsilon._value}


@pytest.mark.parametrize(
    "options", [{"cut_off": None}, {"cut_off": 1.2}, {"cut_off": 1.2, "box": 10.0}], ids=["all", "cut off", "periodic"]
)
def test_forces_on_bodies_stay_and_the_energy_is_less_by_a_constant(options):
    system, bodies, positions = chains(**options)
    prepared = unchanged_but_for_a_constant(system, bodies, positions)
    assert prepared.excludedPairs > 250
    assert prepared.excludedEnergy._value != 0
    said = f"{prepared.excludedPairs} pairs of atoms within 4 rigid bodies do no work, and are excluded from Nonbonded"
    assert said in str(prepared)
    # The energy is the same constant wherever bodies are.
    moved = positions + np.where(bodies.owners[:, None] == bodies.owners[2], [0.0, 0.3, -0.2], 0.0)
    original = chains(**options)[0]
    difference = on_bodies(original, bodies, moved)[0] - on_bodies(system, bodies, moved)[0]
    assert difference == pytest.approx(prepared.excludedEnergy._value, abs=1e-9)


def test_all_forces_leave_out_the_same_pairs_within_bodies():
    system, bodies, _ = chains(cut_off=1.2)
    prepare_system(system, bodies)
    inside = [
        {pair for pair in silent_pairs(force) if bodies.owners[pair[0]] == bodies.owners[pair[1]]}
        for force in system.getForces()
        if isinstance(force, PAIRWISE)
    ]
    assert inside[0] == inside[1]
    # Some platforms demand that Forces have the same pairs altogether.
    exceptions, exclusions = system.getForce(0).getNumExceptions(), system.getForce(1).getNumExclusions()
    assert exceptions == exclusions


def test_prepared_again_there_is_nothing_more_to_exclude():
    system, bodies, _ = chains()
    prepare_system(system, bodies)
    texts = openmm.XmlSerializer.serialize(system)
    again = prepare_system(system, bodies)
    assert (again.excludedPairs, again.excludedEnergy._value) == (0, 0)
    assert openmm.XmlSerializer.serialize(system) == texts


def test_a_custom_force_with_groups_functions_and_computed_values():
    system, bodies, positions = chains(cut_off=1.2)
    force = openmm.CustomNonbondedForce("scale*table(r)*c1*c2*sqrt(a1*a2)")
    force.addPerParticleParameter("a")
    force.addComputedValue("c", "1+a^2")
    force.addGlobalParameter("scale", 3.0)
    force.addTabulatedFunction("table", openmm.Continuous1DFunction(np.cos(np.linspace(0, 3, 50)), 0, 5))
    for i in range(len(positions)):
        force.addParticle([0.3 + 0.01 * i])
    for pair in sorted(silent_pairs(system.getForce(1))):
        force.addExclusion(*pair)
    force.addInteractionGroup(range(30), range(10, len(positions)))
    system.addForce(force)
    unchanged_but_for_a_constant(system, bodies, positions)


def test_ellipsoids_that_turn_with_their_body():
    """Those whose axes are told by linkers, atoms 4 and 5, turn within their body, and still interact there.

    Energies alone are compared: OpenMM's forces of ellipsoids are no gradient on the Reference platform.
    """
    system, bodies, positions = chains(cut_off=None)
    force = openmm.GayBerneForce()
    inside = np.flatnonzero(bodies.owners == bodies.owners[1])[:-2]
    for i in range(len(positions)):
        axes = (i + 1, i + 2) if i in inside else (-1, -1)
        axes = (0, 14) if i in (4, 5) else axes
        shape = (0.4, 0.4, 0.4, 1.0, 1.0, 1.0) if axes[0] < 0 else (0.3, 0.4, 0.5, 1.2, 1.2, 0.8)
        force.addParticle(0.4, 0.5, *axes, *shape)
    force.addException(1, 2, 0.4, 0.2)
    system.addForce(force)
    before = on_bodies(system, bodies, positions)[0]
    excluded = prepare_system(system, bodies).excludedEnergy._value
    assert before - on_bodies(system, bodies, positions)[0] == pytest.approx(excluded, abs=1e-9)
    pairs = {tuple(force.getExceptionParameters(i)[:2]) for i in range(force.getNumExceptions())}
    assert (1, 2) in pairs
    assert not {atom for pair in pairs for atom in pair} & {4, 5}


def test_chains_whose_parameters_differ_have_energies_of_their_own():
    system, bodies, positions = chains()
    force = system.getForce(0)
    for i in range(40):
        force.setParticleParameters(i, 0.1 + 0.01 * i, 0.3, 0.2)
    unchanged_but_for_a_constant(system, bodies, positions)


def test_atoms_that_interact_with_images_of_each_other_are_left():
    """In a box of 1.9 nm atoms of one domain are nearer to images than to each other, which turns with the domain."""
    system, bodies, positions = chains(1, cut_off=0.9, box=1.9)
    prepared = unchanged_but_for_a_constant(system, bodies, positions)
    distances = [np.linalg.norm(positions[a] - positions[b]) for a, b in silent_pairs(system.getForce(0)) if b > a + 1]
    assert prepared.excludedPairs > 20
    assert max(distances) <= 0.45 * 1.9


def test_widths_of_a_sheared_box():
    box = np.array([[3.0, 0, 0], [1.0, 2.0, 0], [0, 0, 5.0]])
    np.testing.assert_allclose(widths(box), [6 / np.sqrt(5), 2.0, 5.0], rtol=1e-14)


# --- what stays -------------------------------------------------------------------------------------------------------


def pme(system):
    system.getForce(0).setNonbondedMethod(openmm.NonbondedForce.PME)


def offset(system):
    force = system.getForce(0)
    force.addGlobalParameter("lambda", 1.0)
    force.addParticleParameterOffset("lambda", 5, 0.1, 0.0, 0.0)


def derivative(system):
    system.getForce(1).addEnergyParameterDerivative("strength")


def born(system):
    force = openmm.CustomGBForce()
    for _ in range(system.getNumParticles()):
        force.addParticle([])
    system.addForce(force)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (pme, "an excluded pair takes longer than one that is not"),
        (offset, "depends on a global parameter"),
        (derivative, "gives derivatives"),
        (born, "exclusions would change CustomGBForce too"),
    ],
)
def test_interactions_stay_where_they_must_and_why_is_told(change, why):
    system, bodies, _ = chains(box=10.0)
    change(system)
    before = [silent_pairs(system.getForce(i)) for i in range(2)]
    prepared = prepare_system(system, bodies)
    assert why in str(prepared)
    assert prepared.excludedPairs == 0
    assert [silent_pairs(system.getForce(i)) for i in range(2)] == before


def test_lists_of_particles_do_not_tell_the_shape():
    system, _, _ = chains(1)
    prepared = prepare_system(system, select_bodies(topology_of(), list(map("A:{}".format, DOMAINS))))
    assert prepared.excludedPairs == 0
    assert "within 2 rigid bodies do no work but cost time. They stay" in str(prepared)


def test_very_large_bodies_stay(monkeypatch):
    monkeypatch.setattr(inside_bodies, "MOST_PAIRS", 80)
    system, bodies, positions = chains(1)
    prepared = unchanged_but_for_a_constant(system, bodies, positions)
    # The smaller one, of 12 beads, has 66 pairs.
    assert 0 < prepared.excludedPairs <= 66


def test_water_and_forces_within_others_stay():
    _, _, water = periodic_system("tip3p", 8)
    before = silent_pairs(next(force for force in water.getForces() if isinstance(force, openmm.NonbondedForce)))
    assert prepare_system(water).excludedPairs == 0
    assert before == silent_pairs(next(f for f in water.getForces() if isinstance(f, openmm.NonbondedForce)))
    system, bodies, _ = chains(1)
    inner = openmm.CustomCVForce("v^2")
    inner.addCollectiveVariable("v", copy.deepcopy(system.getForce(1)))
    system.removeForce(1)
    system.addForce(inner)
    prepare_system(system, bodies)
    assert len(silent_pairs(inner.getCollectiveVariable(0))) < len(silent_pairs(system.getForce(0)))


def test_frames_keep_what_is_excluded():
    """Energies are sums of some 1000 kJ/mol; long-range corrections, which know N, are off."""
    system, bodies, positions = chains(cut_off=1.2)
    system.getForce(0).setUseDispersionCorrection(False)
    before = on_bodies(system, bodies, positions)[0]
    excluded = prepare_system(system, bodies).excludedEnergy._value
    framed = with_frames(system, positions, bodies)
    assert prepare_system(framed.system).excludedPairs == 0
    context = openmm.Context(framed.system, openmm.VerletIntegrator(0.001), platform("Reference"))
    context.setPositions(framed.positions)
    assert context.getState(energy=True).getPotentialEnergy()._value + excluded == pytest.approx(before, abs=1e-9)


def test_bonded_terms_within_bodies_are_told_of():
    system, bodies, _ = chains(1)
    told = (
        "within rigid bodies or between frozen atoms do no work but cost time (24 of 39 of HarmonicBondForce, 22 of 38"
    )
    assert told in str(prepare_system(system, bodies))
    assert "do no work" not in str(prepare_system(domain_system(1)))


def test_a_run_of_a_prepared_system_is_that_of_the_system():
    """Forces are the same to rounding, and 50 steps make 1e-12 of a difference at most."""
    ends = []
    for is_prepared in (False, True):
        system, bodies, positions = chains(1)
        if is_prepared:
            prepare_system(system, bodies)
        context = openmm.Context(system, SIERIntegrator(0.01, bodies=bodies, fastForceGroups=()), platform("Reference"))
        context.setPositions(positions)
        context.getIntegrator().step(50)
        ends.append(context.getState(positions=True).getPositions(asNumpy=True)._value)
    assert np.abs(ends[1] - ends[0]).max() < 1e-10
