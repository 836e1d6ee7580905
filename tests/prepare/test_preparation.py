"""Prepared Systems: their changes, later changes by users, and integrators for them."""

import copy
import functools
import warnings

import numpy as np
import openmm
import pytest

from openmm_sier import (
    RigidBodies,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    balance_pme,
    prepare_system,
    set_inertia,
)
from openmm_sier.dynamics.schemes import SIER4, SIER4G
from openmm_sier.dynamics.species import Species
from openmm_sier.prepare.close_pairs import NAME, OPPOSITE, fast_force_groups
from openmm_sier.system.inner_forces import pme_parameters
from openmm_sier.system.tables import masses
from tests.support.flexible import chains
from tests.support.flexible_systems import FAST, started, system_of
from tests.support.hydrogen_groups import hydrogen_groups
from tests.support.methanols import positions_of, topology_of
from tests.support.methanols import system_of as methanols_of
from tests.support.peptides import capped_alanine
from tests.support.seeded import seeded
from tests.support.silence import silence
from tests.support.waters import array, force_of, periodic_system, platform, water_box

SOLUTE = 22


@pytest.fixture(scope="module")
def peptide():
    """ACE-ALA-NME in four waters, with bonds of hydrogen constrained: System and positions."""
    return capped_alanine(waters=4)


@pytest.fixture(scope="module")
def prepared(peptide):
    system = copy.deepcopy(peptide[0])
    prepare_system(system)
    return system


def named(system, name):
    (force,) = (force for force in system.getForces() if force.getName() == name)
    return force


def context_of(system, positions, integrator=None, name="Reference"):
    # Threads add forces up in another order each time.
    properties = {"Threads": "1", "DeterministicForces": "true"} if name == "CPU" else {}
    context = openmm.Context(system, integrator or openmm.VerletIntegrator(0.001), platform(name), properties)
    context.setPositions(positions)
    return context


def energy_and_forces(context):
    state = context.getState(energy=True, forces=True)
    return state.getPotentialEnergy()._value, array(state.getForces())


def assert_the_same(one, other):
    """Energy and forces of two Contexts, of some 1000 kJ/mol and kJ/mol/nm in sums of 100 terms, to rounding."""
    (energy, forces), (other_energy, other_forces) = energy_and_forces(one), energy_and_forces(other)
    assert other_energy == pytest.approx(energy, abs=1e-9)
    assert np.abs(other_forces - forces).max() < 1e-9


# --- what is done ---


def test_fast_forces_and_close_pairs(peptide):
    system = copy.deepcopy(peptide[0])
    preparation = prepare_system(system)
    assert preparation.fastForceGroups == {FAST}
    assert "HarmonicBondForce, PeriodicTorsionForce, HarmonicAngleForce" in str(preparation)
    assert "81 close pairs (up to 4 bonds apart)" in str(preparation)
    fast, opposite = named(system, NAME), named(system, OPPOSITE)
    # By the topology ACE-ALA-NME has 41 pairs three bonds apart and 40 four bonds.
    assert fast.getNumBonds() == opposite.getNumBonds() == 41 + 40
    assert (fast.getForceGroup(), opposite.getForceGroup()) == (FAST, 0)


@pytest.mark.parametrize("name", ["Reference", "CPU"])
def test_close_pairs_are_those_of_the_nonbonded_force(peptide, prepared, name):
    """All forces less those of the close pairs are those of a NonbondedForce in which these pairs are excluded."""
    plain = context_of(*peptide, name=name)
    assert_the_same(plain, context_of(prepared, peptide[1], name=name))
    without = copy.deepcopy(peptide[0])
    nonbonded = force_of(without, openmm.NonbondedForce)
    close = named(prepared, NAME)
    excepted = {tuple(nonbonded.getExceptionParameters(i)[:2]): i for i in range(nonbonded.getNumExceptions())}
    for i in range(close.getNumBonds()):
        a, b, _ = close.getBondParameters(i)
        number = excepted.get((a, b), excepted.get((b, a)))
        if number is None:
            nonbonded.addException(a, b, 0, 1, 0)
        else:
            nonbonded.setExceptionParameters(number, a, b, 0, 1, 0)
    _, expected = energy_and_forces(context_of(without, peptide[1], name=name))
    alone = copy.deepcopy(prepared)
    named(alone, NAME).setForceGroup(7)
    context = context_of(alone, peptide[1], name=name)
    pairs = array(context.getState(forces=True, groups={7}).getForces())
    # All forces but those of close pairs, in both. The CPU platform has single precision, of forces up to 1000.
    error = 1e-9 if name == "Reference" else 2e-3
    assert np.abs(energy_and_forces(context)[1] - pairs - expected).max() < error


def test_prepared_again_a_system_stays_as_it_is(prepared):
    again = copy.deepcopy(prepared)
    before = openmm.XmlSerializer.serialize(again)
    prepare_system(again)
    assert openmm.XmlSerializer.serialize(again) == before
    prepare_system(again, fastForceGroup=5)
    assert fast_force_groups(again) == 1 << 5
    prepare_system(again)
    assert openmm.XmlSerializer.serialize(again) == before


def test_a_system_without_nonbonded_forces():
    system, _ = system_of(chains(), waters=1)
    force_of(system, openmm.HarmonicBondForce).setForceGroup(0)
    preparation = prepare_system(system)
    assert preparation.fastForceGroups == {FAST}
    assert "Force group 1 has the fast forces now: HarmonicBondForce." in str(preparation)
    assert [force.getForceGroup() for force in system.getForces()] == [FAST, 0, 0, FAST]


def test_what_acts_on_rigid_bodies_is_fast():
    system = methanols_of(2)
    positions, topology = positions_of(2), topology_of(2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        groups = RigidBodies.from_system(system, topology, hydrogen_groups(topology), positions)
    preparation = prepare_system(system, groups)
    assert preparation.fastForceGroups == {1}
    assert "stay slow forces" not in str(preparation)


def test_water_is_prepared_and_its_limit_reported():
    _, _, system = periodic_system("tip3p", 64)
    force_of(system, openmm.NonbondedForce).setEwaldErrorTolerance(5e-4)
    balanced = copy.deepcopy(system)
    balance_pme(balanced)
    message = str(prepare_system(system))
    assert "PME are balanced" in message
    assert openmm.XmlSerializer.serialize(system) == openmm.XmlSerializer.serialize(balanced)
    assert "NonbondedForce ends with a jump of the energy at 0.55 nm" in message
    assert "switchDistance=0.46*nanometer" in message
    force = force_of(system, openmm.NonbondedForce)
    force.setUseSwitchingFunction(True)
    assert prepare_system(system).limits == ()


def test_with_heavy_hydrogens_pme_is_balanced_for_a_bath():
    _, _, system = periodic_system("tip3p", 64)
    balanced = copy.deepcopy(system)
    balance_pme(balanced, constantEnergy=False)
    assert "PME are balanced for a heat bath" in str(prepare_system(system, hydrogenMass=4))
    parameters = [pme_parameters(force_of(each, openmm.NonbondedForce)) for each in (system, balanced)]
    assert parameters[0] == parameters[1]


# --- later changes ---


def scaled(system, factor):
    """Charges, well depths and exceptions of the solute scaled, as REST2 and free energy methods do."""
    force = force_of(system, openmm.NonbondedForce)
    for i in range(SOLUTE):
        charge, sigma, epsilon = force.getParticleParameters(i)
        force.setParticleParameters(i, factor**0.5 * charge, sigma, factor * epsilon)
    for i in range(force.getNumExceptions()):
        a, b, charge, sigma, epsilon = force.getExceptionParameters(i)
        if max(a, b) < SOLUTE:
            force.setExceptionParameters(i, a, b, factor * charge, sigma, factor * epsilon)
    return force


@pytest.mark.parametrize("in_context", [False, True], ids=["System", "Context"])
def test_solute_scaling_gives_what_it_gives_in_the_plain_system(peptide, prepared, in_context):
    results = []
    for original in (peptide[0], prepared):
        system = copy.deepcopy(original)
        context = context_of(system, peptide[1]) if in_context else None
        force = scaled(system, 0.5)
        if context is not None:
            force.updateParametersInContext(context)
        results.append(context or context_of(system, peptide[1]))
    assert_the_same(*results)
    assert abs(energy_and_forces(results[0])[0] - energy_and_forces(context_of(*peptide))[0]) > 10


def test_parameter_offsets(peptide):
    """Charges and exceptions that a parameter of the Context scales, prepared after the offsets were added."""
    plain = copy.deepcopy(peptide[0])
    force = force_of(plain, openmm.NonbondedForce)
    force.addGlobalParameter("coupling", 1.0)
    for i in range(SOLUTE):
        charge, sigma, epsilon = force.getParticleParameters(i)
        force.setParticleParameters(i, 0, sigma, 0)
        force.addParticleParameterOffset("coupling", i, charge, 0, epsilon)
    for i in range(force.getNumExceptions()):
        a, b, charge, sigma, epsilon = force.getExceptionParameters(i)
        if max(a, b) < SOLUTE and (charge._value or epsilon._value):
            force.setExceptionParameters(i, a, b, 0, sigma, 0)
            force.addExceptionParameterOffset("coupling", i, charge, 0, epsilon)
    offset, usual = copy.deepcopy(plain), copy.deepcopy(peptide[0])
    prepare_system(offset)
    prepare_system(usual)
    contexts = [context_of(system, peptide[1]) for system in (plain, offset)]
    for coupling in (1.0, 0.3, 0.0):
        for context in contexts:
            context.setParameter("coupling", coupling)
        assert_the_same(*contexts)
    # At its default the parameter gives the charges that the close pairs have without offsets.
    one, other = (named(system, NAME) for system in (offset, usual))
    assert one.getNumBonds() == other.getNumBonds() == 81
    for i in range(81):
        assert one.getBondParameters(i)[2] == pytest.approx(other.getBondParameters(i)[2], rel=1e-12)


@pytest.mark.thorough
def test_alchemical_factory(peptide, prepared):
    alchemy = pytest.importorskip("openmmtools.alchemy", reason="pip install openmm-sier[validation]")
    region = alchemy.AlchemicalRegion(alchemical_atoms=range(SOLUTE), annihilate_electrostatics=True)
    results = []
    for system in (peptide[0], prepared):
        result = alchemy.AbsoluteAlchemicalFactory(consistent_exceptions=False).create_alchemical_system(system, region)
        state = alchemy.AlchemicalState.from_system(result)
        state.lambda_electrostatics, state.lambda_sterics = 0.0, 0.5
        context = context_of(result, peptide[1])
        state.apply_to_context(context)
        results.append(context)
    assert_the_same(*results)
    assert fast_force_groups(results[1].getSystem()) == 1 << FAST


def test_several_nonbonded_forces_and_others_that_exclude_pairs(peptide):
    system = copy.deepcopy(peptide[0])
    system.addForce(copy.deepcopy(force_of(system, openmm.NonbondedForce)))
    custom = openmm.CustomNonbondedForce("0")
    for _ in range(system.getNumParticles()):
        custom.addParticle()
    nonbonded = force_of(system, openmm.NonbondedForce)
    for i in range(nonbonded.getNumExceptions()):
        custom.addExclusion(*nonbonded.getExceptionParameters(i)[:2])
    system.addForce(custom)
    prepared = copy.deepcopy(system)
    assert "162 close pairs" in str(prepare_system(prepared))
    assert_the_same(context_of(system, peptide[1]), context_of(prepared, peptide[1]))


# --- what integrators find ---

INTEGRATORS = {
    "constant energy": lambda **options: SIERIntegrator(0.004, **options),
    "Langevin": lambda **options: SIERLangevinIntegrator(300, 1, 0.004, **options),
    "hybrid Monte Carlo": lambda **options: SIERHMCIntegrator(300, 0.004, stepsPerTrial=2, **options),
}


@pytest.mark.parametrize("engine", ["exact", "native"])
@pytest.mark.parametrize("kind", INTEGRATORS)
def test_integrators_find_fast_forces(peptide, prepared, kind, engine):
    """They move atoms bit for bit like one with explicit groups, and so does the program in their XML."""
    contexts, ends, made = [], [], []
    for told in ({}, {"fastForceGroups": {FAST}}):
        integrator = seeded(INTEGRATORS[kind](engine=engine, **told))
        context = context_of(copy.deepcopy(prepared), peptide[1], integrator)
        context.setVelocitiesToTemperature(300, 1)
        integrator.step(2)
        assert integrator.fastForceGroups == {FAST}
        ends.append(array(context.getState(positions=True).getPositions()))
        made.append(integrator)
        # OpenMM cannot copy an integrator whose Context is gone.
        contexts.append(context)
    assert np.array_equal(*ends)
    programs = [[one.getComputationStep(i) for i in range(one.getNumComputations())] for one in made]
    assert programs[0] == programs[1]
    # Copies look for them in their own System.
    fresh = INTEGRATORS[kind](engine=engine)
    contexts.append(context_of(copy.deepcopy(peptide[0]), peptide[1], fresh))
    for other in (copy.copy(made[0]), openmm.XmlSerializer.clone(made[0])):
        assert other.fastForceGroups == set()
        contexts.append(context_of(copy.deepcopy(peptide[0]), peptide[1], other))
        assert other.fastForceGroups == set()
        assert other.getNumComputations() == fresh.getNumComputations()


def test_an_argument_wins(peptide, prepared):
    result = SIERIntegrator(0.002, fastForceGroups=set())
    for integrator in (openmm.XmlSerializer.clone(result), result):
        context_of(copy.deepcopy(prepared), peptide[1], integrator)
        assert integrator.fastForceGroups == set()


def test_what_an_integrator_holds_survives_the_new_program(peptide, prepared):
    integrator = SIERIntegrator(0.005, SIER4, substeps=2, engine="native")
    integrator.setConstraintTolerance(1e-7)
    integrator.setRandomNumberSeed(17)
    integrator.setIntegrationForceGroups({0, FAST})
    context = context_of(copy.deepcopy(prepared), peptide[1], integrator)
    assert context.getIntegrator() is integrator
    assert integrator.fastForceGroups == {FAST}
    assert integrator.getStepSize()._value == 0.005
    assert openmm.CustomIntegrator.getStepSize(integrator)._value == 0.005 / integrator.impl.native_steps
    assert integrator.getConstraintTolerance() == 1e-7
    assert integrator.getRandomNumberSeed() == 17
    assert integrator.getIntegrationForceGroups() == 0b11


# --- a System that has a Context already ---


def keep_inertia(system):
    positions = water_box()[1]
    water = Species.from_coordinates(np.array([[0, 1, 2]]), masses(system)[:3], positions[:3])
    set_inertia(system, positions, [[0, 1, 2]], water.mass, water.moments)


@pytest.mark.parametrize(
    "integrator", [functools.partial(SIERIntegrator, scheme="SIER2"), openmm.VerletIntegrator], ids=["SIER", "OpenMM"]
)
@pytest.mark.parametrize("change", [prepare_system, balance_pme, keep_inertia], ids=lambda change: change.__name__)
def test_a_system_with_a_context_is_not_prepared(change, integrator):
    _, positions, system = periodic_system("tip3p", 64)
    before = openmm.XmlSerializer.serialize(system)
    context = context_of(system, positions, integrator(0.001))
    # `getSystem` makes another Python object for the same System.
    for each in (system, context.getSystem()):
        with pytest.raises(ValueError, match="prepare Systems before"):
            change(each)
    assert openmm.XmlSerializer.serialize(system) == before
    change(copy.deepcopy(system))
    del context
    change(system)


def test_a_system_whose_context_was_refused_can_be_prepared():
    """A notebook keeps the error, and with it the Context that was not completed."""
    _, positions, system = periodic_system("tip3p", 64)
    lines = openmm.XmlSerializer.clone(system)
    for _ in range(3):
        lines.addParticle(12.0)
    other = RigidBodies.from_system(lines)
    with pytest.raises(ValueError, match="180 particles") as refused:
        context_of(system, positions, SIERIntegrator(0.001, "SIER2", bodies=other))
    prepare_system(system)
    assert refused.tb is not None


# --- the notice ---


@pytest.mark.parametrize("kind", ["constant energy", "hybrid Monte Carlo"])
def test_integrators_of_fourth_order_warn_about_pme(kind):
    _, positions, system = periodic_system("tip3p", 64)
    options = {"scheme": "SIER4G"} if kind == "hybrid Monte Carlo" else {}
    with pytest.warns(UserWarning, match=r"prepare_system\(system\).*SIER4G.* 1\.2 to 1\.6 %") as caught:
        context_of(system, positions, INTEGRATORS[kind](**options))
    assert len(caught) == 1
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    "remedy", [prepare_system, lambda system: force_of(system, openmm.NonbondedForce).setPMEParameters(4, 24, 24, 24)]
)
def test_pme_that_a_user_chose_draws_no_warning(remedy):
    _, positions, system = periodic_system("tip3p", 64)
    with silence():
        context_of(system, positions, SIERIntegrator(0.001, "SIER2"))
        remedy(system)
        context_of(system, positions, SIERIntegrator(0.004, SIER4G))


# --- force groups that others use ---


def test_a_free_group_is_taken_where_the_first_has_other_forces():
    system, positions = system_of(chains())
    force_of(system, openmm.HarmonicBondForce).setForceGroup(0)
    force_of(system, openmm.CustomExternalForce).setForceGroup(1)
    force_of(system, openmm.CustomNonbondedForce).setForceGroup(2)
    with pytest.raises(ValueError, match=r"CustomExternalForce .*group 1"):
        prepare_system(system, fastForceGroup=1)
    with pytest.raises(ValueError, match="at most 31, got 32"):
        prepare_system(system, fastForceGroup=32)
    assert force_of(system, openmm.HarmonicBondForce).getForceGroup() == 0
    preparation = prepare_system(system)
    assert preparation.fastForceGroups == {3}
    integrator = SIERIntegrator(0.003)
    context = started(system, integrator, positions, steps=1)
    assert context.getStepCount() == 1
    assert integrator.fastForceGroups == {3}


def test_the_group_of_the_reciprocal_sum_is_taken(peptide):
    system = copy.deepcopy(peptide[0])
    force_of(system, openmm.NonbondedForce).setReciprocalSpaceForceGroup(1)
    assert prepare_system(system).fastForceGroups == {2}


@pytest.mark.parametrize("regroup", [lambda number: number, lambda number: 0], ids=["a group each", "one group"])
def test_forces_that_were_regrouped_are_to_be_prepared_again(peptide, prepared, regroup):
    system = copy.deepcopy(prepared)
    for number, force in enumerate(system.getForces()):
        force.setForceGroup(regroup(number))
    with pytest.raises(openmm.OpenMMException, match=r"prepare_system\(system\) again"):
        context_of(system, peptide[1], SIERIntegrator(0.002))
    (group,) = prepare_system(system).fastForceGroups
    integrator = SIERIntegrator(0.002)
    context_of(system, peptide[1], integrator)
    assert integrator.fastForceGroups == {group}
    names = {force.getName() for force in system.getForces() if force.getForceGroup() == group}
    assert names == {"HarmonicBondForce", "HarmonicAngleForce", "PeriodicTorsionForce", NAME}


def test_forces_that_are_added_later_stay_in_the_kicks(peptide, prepared):
    system = copy.deepcopy(prepared)
    restraint = openmm.CustomBondForce("10*r^2")
    restraint.addBond(0, 10, [])
    restraint = system.getForce(system.addForce(restraint))
    integrator = SIERIntegrator(0.002)
    with silence():
        context_of(system, peptide[1], integrator)
    assert integrator.fastForceGroups == {FAST}
    restraint.setForceGroup(FAST)
    with pytest.raises(openmm.OpenMMException, match="CustomBondForce was changed"):
        context_of(system, peptide[1], SIERIntegrator(0.002))


# --- what is given ---


def test_bodies_as_plain_lists():
    system = methanols_of(2)
    heavy = [[0, 1, 2, 3], [4, 5], [6, 7, 8, 9], [10, 11]]
    assert prepare_system(system, heavy).fastForceGroups == {1}
    with pytest.raises(TypeError, match=r"bodies must be .*got a mask"):
        prepare_system(system, bodies=[[True, False, True]])


def test_a_simulation_is_refused_with_what_to_give():
    system, positions = system_of(chains())
    context = started(system, SIERIntegrator(0.001, "SIER2"), positions)
    with pytest.raises(TypeError, match=r"system must be .*got a SIERContext"):
        prepare_system(context)
