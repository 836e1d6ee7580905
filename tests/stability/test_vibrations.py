"""Unconstrained bonds: steps that are too long are refused, and long ones draw warnings."""

import copy
import math
import re
import warnings
from functools import partial

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import (
    SIER2,
    SIER4G,
    RigidBodies,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
)
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.dynamics.stages import DRIFT, KICK
from openmm_sier.stability import advice
from openmm_sier.stability.advice import Remedies
from openmm_sier.stability.motions import Motions
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.stability.step_rules import DESTROYED, RESONANCE
from openmm_sier.system.links import Links
from tests.support.silence import silence
from tests.support.systems import assembled, field
from tests.support.waters import cluster_system, context_at, judged, phase_point, platform

#: Of O-H in OpenMM's flexible TIP3P, 462750.4 kJ/mol/nm^2.
PERIOD = 2 * math.pi * math.sqrt(1 / (462750.4 * (1 / 1.008 + 1 / 15.99943)))


@pytest.fixture(scope="module")
def flexible():
    return cluster_system(3, rigidWater=False)


def diatomic(strength=1e5, masses=(1.0, 16.0), group=0):
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(0, 1, 0.1, strength)
    bonds.setForceGroup(group)
    return assembled(masses, bonds)


def limits(scheme, period):
    """Steps in ps at which a mode becomes unstable, and inaccurate."""
    return (limit * period / (2 * math.pi) for limit in (scheme.stability_limit, scheme.accuracy_limit))


@pytest.mark.parametrize("make", [SIERIntegrator, lambda h, s: SIERLangevinIntegrator(297, 1, h, scheme=s)])
def test_flexible_water_is_refused(flexible, make):
    _, _, system = flexible
    with pytest.raises(openmm.OpenMMException) as caught:
        judged(system, make(0.006, SIER4G))
    message = str(caught.value)
    stable, accurate = limits(SIER4G, PERIOD)
    assert "A step of 6 fs is too long: the bond between atoms 0 and 1 " in message
    assert f"a period of {1000 * PERIOD:.3g} fs" in message
    assert f"SIER4G is accurate up to {1000 * accurate:.3g} fs, and unstable from {1000 * stable:.3g} fs on" in message


def test_a_long_step_draws_one_warning_and_a_short_one_none(flexible):
    _, positions, system = flexible
    stable, accurate = limits(SIER4G, PERIOD)
    with silence():
        integrator = SIERIntegrator(0.99 * accurate, SIER4G)
        context = context_at(system, integrator, (positions, 0 * positions), steps=1)
    integrator.setStepSize(1.01 * accurate)
    with pytest.warns(UserWarning, match=r"3\.\d* fs is long: the bond") as caught:
        integrator.step(1)
    assert caught[0].filename == __file__
    with silence():
        integrator.step(1)
    integrator.setStepSize(1.01 * stable)
    before = phase_point(context)[0]
    with pytest.raises(openmm.OpenMMException, match="is too long"):
        integrator.step(1)
    assert np.array_equal(phase_point(context)[0], before)
    assert context.getStepCount() == 3
    integrator.setStepSize(0.001)
    integrator.step(1)
    with pytest.warns(UserWarning, match="is long"):
        judged(system, SIERIntegrator(0.001, "SIER2"))


@pytest.mark.parametrize("scheme", [SIER2, SIER4G], ids=lambda scheme: scheme.name)
def test_the_longest_step_is_the_longest_without_a_warning(flexible, scheme):
    _, _, system = flexible
    check = StepCheck(system, RigidBodies.from_system(system))
    assert check.longest_step(scheme, 0, 0) == math.inf
    slow, fast = check.longest_step(scheme, 1, 0), check.longest_step(scheme, 0, 1)
    assert check.longest_step(scheme, 1, 1) == min(slow, fast)

    def within(step):
        return IntegrationMethod(scheme, step, substeps=100, fast_groups=1)

    with silence():
        check(IntegrationMethod(scheme, 0.999 * slow), 1)
        check(within(0.999 * fast), 1)
    with pytest.warns(UserWarning, match="is long"):
        check(IntegrationMethod(scheme, 1.001 * slow), 1)
    with pytest.warns(UserWarning, match="is long for the bond"):
        check(within(1.001 * fast), 1)


def test_bonds_inside_bodies_do_not_count(flexible):
    _, positions, system = flexible
    with silence():
        bodies = RigidBodies.from_system(system, rigid=[[0, 1, 2], [3, 4, 5], [6, 7, 8]], positions=positions)
    named = SIERIntegrator(0.004, SIER4G, bodies=bodies)
    context = context_at(system, named, (positions, 0 * positions), steps=1)
    assert context.getStepCount() == 1
    with silence():
        bodies = RigidBodies.from_system(system, rigid=[[0, 1, 2], [6, 7, 8]], positions=positions)
    partly = SIERIntegrator(0.006, SIER4G, bodies=bodies)
    context = context_at(system, partly, (positions, 0 * positions))
    with pytest.raises(openmm.OpenMMException, match="atoms 3 and 4"):
        partly.step(1)
    assert context.getStepCount() == 0


def test_bonds_that_do_not_act_do_not_count():
    integrator = SIERIntegrator(0.006, "SIER2")
    integrator.setIntegrationForceGroups({0})
    context = judged(diatomic(2e5, group=1), integrator)
    context.setPositions(np.array([[0, 0, 0], [0.1, 0, 0]]))
    integrator.step(1)
    integrator.setIntegrationForceGroups({0, 1})
    with pytest.raises(openmm.OpenMMException, match="atoms 0 and 1"):
        integrator.step(1)


@pytest.mark.parametrize(("of_hydrogen", "is_told"), [(1.0, False), (3.0, False), (4.0, True)])
def test_a_bond_of_atoms_that_lost_mass_to_hydrogens(of_hydrogen, is_told):
    """The remedy of a script that gave hydrogens 4 dalton before: `prepare_system` gives back what heavy atoms lost."""
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(0, 1, 0.12, 4e5)
    system = assembled([16.0, 13.0 - of_hydrogen, of_hydrogen], bonds)
    system.addConstraint(1, 2, 0.11)
    remedies = Remedies(system, RigidBodies.from_system(system), Links(system)).hold((0, 1))
    assert any("if createSystem made hydrogens heavy, call prepare_system" in each for each in remedies) == is_told


def test_hydrogens_are_looked_for_only_for_a_message(monkeypatch):
    """They only decide the words of remedies, and large Systems have many."""

    def looked_for(*_):
        raise AssertionError

    monkeypatch.setattr(advice, "hydrogens_among", looked_for)
    _, _, system = cluster_system(2)
    judged(system, SIERIntegrator(0.001, "SIER2"))
    with pytest.raises(AssertionError):
        judged(system, SIERIntegrator(0.006, "SIER2"))


@pytest.mark.parametrize("masses", [(1.0, 16.0), (1.0, 0.0), (12.0, 12.0)])
def test_the_period_is_that_of_the_reduced_mass(masses):
    """Atoms without mass stay where they are, and do not count."""
    system = diatomic(masses=masses)
    inverse = sum(1 / mass for mass in masses if mass)
    period = 2 * math.pi / math.sqrt(1e5 * inverse)
    stable, _ = limits(SIER2, period)
    judged(system, SIERIntegrator(0.999 * stable, "SIER2"))
    with pytest.raises(openmm.OpenMMException, match=f"{1000 * period:.3g} fs"):
        judged(system, SIERIntegrator(1.001 * stable, "SIER2"))


@pytest.mark.parametrize(
    ("masses", "named", "left_out"),
    [
        ((1.0, 16.0), ("make all hydrogens heavy", "constraints=HBonds"), "AllBonds"),
        ((3.0, 10.0), ("constraints=HBonds",), "averages but no dynamics"),
        ((4.0, 10.0), ("constraints=HBonds", "if createSystem made hydrogens heavy"), "averages but no dynamics"),
        ((14.0, 14.0), ("constraints=AllBonds",), "hydrogens"),
    ],
)
def test_remedies_are_those_that_help(masses, named, left_out):
    system = diatomic(4e5, masses)
    prepare_system(system)
    with pytest.raises(openmm.OpenMMException, match="is too long for the bond") as refused:
        judged(system, SIERLangevinIntegrator(300, 1, 0.03, substeps=40))
    for remedy in named:
        assert remedy in str(refused.value)
    assert left_out not in str(refused.value)


def group_of_methyl():
    """A carbon that heavy hydrogens have made as light as they are, bonded to nitrogen, in vacuum."""
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(0, 1, 0.147, 2.8e5)
    system = assembled([14.0, 4.0, 3.7, 3.7, 3.7], bonds, constraints=[(1, i, 0.109) for i in (2, 3, 4)])
    return system, None, None


def restrained():
    """An atom that a field holds tightly."""
    return assembled([12.0], field("k*x^2/2", [0], k=1e6)), None, np.zeros((1, 3))


def coupled():
    """A bond as a term of two atoms that is no bonded Force, so that inner steps cannot follow it."""
    force = openmm.CustomCompoundBondForce(2, "2e5*(distance(p1,p2)-0.1)^2")
    force.addBond([0, 1], [])
    return assembled([12.0, 12.0], force), None, np.array([[0, 0, 0], [0.1, 0, 0]])


def biased():
    distance = openmm.CustomBondForce("r")
    distance.addBond(0, 1)
    force = openmm.CustomCVForce("2e5*(d-0.1)^2")
    force.addCollectiveVariable("d", distance)
    force.setName("bias")
    return assembled([12.0, 12.0], force), None, np.array([[0, 0, 0], [0.1, 0, 0]])


def between_bodies():
    """Two rigid triangles that a stiff bond joins."""
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(0, 3, 0.15, 4e5)
    x = np.array([[0, 0, 0], [-0.1, 0.1, 0], [-0.1, -0.1, 0], [0.15, 0, 0], [0.25, 0.1, 0], [0.25, -0.1, 0]])
    return assembled(6 * [12.0], bonds), [[0, 1, 2], [3, 4, 5]], x


def beside_a_body():
    """A stiff bond of two beads at a rigid triangle: constraints could not join it."""
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(0, 3, 0.15, 2e3)
    bonds.addBond(3, 4, 0.15, 4e5)
    x = np.array([[0, 0, 0], [-0.1, 0.1, 0], [-0.1, -0.1, 0], [0.15, 0, 0], [0.3, 0, 0]])
    return assembled(5 * [12.0], bonds), [[0, 1, 2]], x


FAST, SLOW = "Call prepare_system(system)", "Take a shorter step (--dt), or"

#: What limits a step, how the remedy begins, and what else it says or leaves out.
ADVICE = {
    "a bond to hydrogen": (lambda: (diatomic(4e5), None, None), FAST, "constraints=HBonds", "AllBonds"),
    "a bond of light carbon": (group_of_methyl, FAST, "constraints=AllBonds", "HBonds"),
    "a restraint": (restrained, SLOW, "make CustomExternalForce softer", "constrain the bond"),
    "a term of two atoms": (coupled, SLOW, "constraints=AllBonds", "prepare_system"),
    "a collective variable": (biased, SLOW, "make bias softer", "constrain the bond"),
    "a bond of two bodies": (between_bodies, FAST, "into one rigid body", "HBonds"),
    "a bond beside a body": (beside_a_body, FAST, "into one rigid body", "HBonds"),
}


@pytest.mark.parametrize("prepared", [False, True])
@pytest.mark.parametrize("kind", ADVICE)
def test_a_remedy_is_one_that_helps(kind, prepared):
    """Inner steps for motions that they can follow, and no preparation where it was done or has no effect."""
    make, begins, says, leaves_out = ADVICE[kind]
    system, rigid, x = make()
    bodies = RigidBodies.from_system(system, rigid=rigid, positions=x) if rigid else None
    if prepared:
        prepare_system(system, bodies)
        # What can be fast is judged by its kicks and inner steps then.
        begins = SLOW if begins == SLOW else ""
    integrator = SIERIntegrator(0.03, SIER4G, bodies=bodies, substeps=20)
    context = openmm.Context(system, integrator, platform())
    judge = integrator.impl.refuse_long_step
    if x is not None:
        context.setPositions(x)
        judge = partial(integrator.step, 1)
    with pytest.raises(openmm.OpenMMException, match="is too long") as refused:
        judge()
    message = str(refused.value)
    assert begins in message
    assert says in message
    assert leaves_out not in message
    if begins != FAST:
        assert FAST not in message


def test_bonds_without_strength_are_no_oscillators():
    judged(diatomic(strength=0.0), SIERIntegrator(1.0, "SIER2"))
    judged(diatomic(masses=(0.0, 0.0)), SIERIntegrator(1.0, "SIER2"))


def test_a_bond_at_a_body_moves_the_body(rng):
    """Its inverse mass is the largest that a rigid motion of the atoms has there, from their own mass matrix."""
    masses, x = rng.uniform(1, 20, 4), rng.normal(scale=0.1, size=(4, 3))
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(2, 4, 0.1, 1e5)
    system = assembled([*masses, 0.0], bonds)
    bodies = RigidBodies.from_system(system, rigid=[range(4)], positions=np.vstack([x, [0, 0, 1]]) * unit.nanometer)
    # Columns: what six rigid motions do to the 12 coordinates of the atoms.
    motions = np.zeros((4, 3, 6))
    motions[:, :, :3] = np.eye(3)
    motions[:, :, 3:] = -np.cross(x[:, None, :], np.eye(3)).transpose(0, 2, 1)
    matrix = np.einsum("k,kxi,kxj->ij", masses, motions, motions)
    inverse = np.linalg.eigvalsh(motions[2] @ np.linalg.inv(matrix) @ motions[2].T)[-1]
    assert inverse < 1 / masses[2]
    (bond,) = Motions(system, bodies, bodies.species).harmonic
    assert bond.period == pytest.approx(2 * math.pi / math.sqrt(1e5 * inverse), rel=1e-10)
    assert bond.atoms == (2, 4)


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_flexible_water_that_is_prepared_is_refused_where_kicks_destroy_it(engine):
    """At 6 fs, two thirds of a period, it gains 28 kJ/mol/ps, and at 4.5 fs, half a period, a tenth of its heat in
    0.2 ps; at 4 fs it runs."""
    _, _, system = cluster_system(3, rigidWater=False)
    prepare_system(system)
    for h in (0.0045, 0.006, 0.009):
        with pytest.raises(openmm.OpenMMException, match="More inner steps do not help"):
            judged(system, SIERIntegrator(h, SIER4G, engine=engine, substeps=8))
    judged(system, SIERIntegrator(0.004, SIER4G, engine=engine, substeps=8))
    # With a bath at 9 fs, 0.58 periods, bonds are shorter than in vacuum, and energies an eighth too high.
    prepare_system(system, hydrogenMass=4)
    refused = r"is too long for the bond between atoms \d and \d: .*More inner steps do not help"
    with silence(), pytest.raises(openmm.OpenMMException, match=refused):
        judged(system, SIERLangevinIntegrator(300, 1, 0.009, engine=engine))
    judged(system, SIERLangevinIntegrator(300, 1, 0.007, engine=engine))


@pytest.mark.filterwarnings("error")
def test_the_step_that_a_refusal_in_a_bath_names_draws_no_warning():
    """The limit of bonds to hydrogen is shorter there than at constant energy."""
    _, _, system = cluster_system(3, rigidWater=False)
    prepare_system(system)
    with pytest.raises(openmm.OpenMMException, match="Take up to") as refused:
        judged(system, SIERLangevinIntegrator(300, 1, 0.0065))
    step = float(re.search(r"Take up to ([\d.]+) fs", str(refused.value))[1])
    judged(system, SIERLangevinIntegrator(300, 1, step / 1000))


@pytest.mark.parametrize(
    ("make", "h", "inner"),
    [(partial(SIERLangevinIntegrator, 300, 1), 3, 1), (partial(SIERIntegrator, scheme="SIER2"), 4, 2)],
)
@pytest.mark.filterwarnings("error:An inner step")
def test_inner_steps_are_as_many_as_the_fastest_bond_needs(flexible, make, h, inner):
    """Leapfrog steps of 3 fs would be refused, and SIER4G's of 4 fs warned of. A copy has them too."""
    _, positions, system = flexible
    system = openmm.XmlSerializer.clone(system)
    prepare_system(system)
    first = make(h / 1000)
    # An integrator lives as long as its Context.
    contexts = [context_at(system, first, (positions, 0 * positions), steps=1)]
    contexts.append(context_at(system, again := copy.copy(first), (positions, 0 * positions), steps=1))
    for each in (first, again):
        assert each.impl.engine.inner_step(each.impl.method()) == pytest.approx(inner / 1000)
        assert each.substeps is None
    shorter = make(0.001)
    contexts.append(context_at(system, shorter, (positions, 0 * positions)))
    shorter.setStepSize(h / 1000)
    shorter.step(1)


def is_bounded(scheme, angle, share):
    """Whether a harmonic mode stays bounded that moves by an angle a step within drifts, and that other forces kick.

    The share is the stiffness of the forces in the kicks over that of the fast ones, negative if they weaken the mode.
    """
    x, matrix = share * angle**2, np.eye(2)
    for stage in scheme.stages:
        cosine, sine = np.cos(angle * stage.fraction), np.sin(angle * stage.fraction)
        if stage.flow == DRIFT:
            matrix = np.array([[cosine, sine / angle], [-angle * sine, cosine]]) @ matrix
        elif stage.flow == KICK:
            matrix = np.array([[1, 0], [-stage.fraction * x * (1 - stage.shift * x), 1]]) @ matrix
    # Determinants are 1, so that both eigenvalues are on the unit circle up to here.
    return abs(np.trace(matrix)) <= 2 + 1e-12


@pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=CATALOGUE)
@pytest.mark.parametrize("share", [0.02, 0.08, -0.08, 0.5, 1.0, 4.0])
def test_kicks_twice_a_period_are_unstable_in_a_window(scheme, share):
    """All steps outside of the window of SIER2, which is the widest, are stable, and some in it are not."""
    first, last = math.pi / (1 + abs(share)), math.pi / max(1 - abs(share), 0.5)
    assert all(is_bounded(scheme, angle, share) for angle in np.linspace(0.01 * math.pi, first, 200))
    assert not all(is_bounded(scheme, angle, share) for angle in np.linspace(first, last, 1000))
    if abs(share) < 0.1:
        assert all(is_bounded(scheme, angle, share) for angle in np.linspace(last, 1.5 * math.pi, 100))


def test_steps_in_the_window_are_refused():
    """It is half a period, less and more by the share of the surroundings in the stiffness of the bond."""
    system = diatomic(strength=4e5, masses=(12.0, 12.0))
    charges = openmm.NonbondedForce()
    for charge in (0.5, -0.5):
        charges.addParticle(charge, 0.3, 0.0)
    charges.setForceGroup(1)
    system.addForce(charges)
    period = 2 * math.pi / math.sqrt(4e5 / 6)
    # Both ends of 4e4 kJ/mol/nm^2 in a row, where the bond has 4e5.
    share = 0.05
    check = StepCheck(system, RigidBodies.from_system(system))

    def checked(step):
        check(IntegrationMethod(SIER4G, step * period, substeps=100, fast_groups=1), 3)

    with silence():
        checked(0.999 * RESONANCE)
    with pytest.warns(UserWarning, match="more than twice in each period"):
        checked(0.999 * (1 - share) / 2)
    for step in (1.001 * (1 - share) / 2, 0.5, 0.999 / (1 - share) / 2, 1.001 * DESTROYED):
        with pytest.raises(openmm.OpenMMException, match="More inner steps do not help"):
            checked(step)
    # A warning, which is not given again.
    checked(1.001 / (1 - share) / 2)


def test_a_bond_softer_than_its_surroundings_has_a_longest_step():
    """Of ions that touch: their repulsion is several times as stiff as the bond."""
    system = diatomic(strength=8000, masses=(12.0, 12.0))
    charges = openmm.NonbondedForce()
    for charge in (0.5, -0.5):
        charges.addParticle(charge, 0.3, 0.5)
    charges.setForceGroup(1)
    system.addForce(charges)
    check = StepCheck(system, RigidBodies.from_system(system))
    period = 2 * math.pi / math.sqrt(8000 / 6)
    method = IntegrationMethod(SIER4G, 0.4 * period, substeps=100, fast_groups=1)
    with pytest.raises(openmm.OpenMMException, match=r"Take up to [1-9]\d\.\d fs"):
        check(method, 3)


def test_every_kind_of_warning_is_given_once(flexible):
    _, _, system = flexible
    check = StepCheck(system, RigidBodies.from_system(system))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check(IntegrationMethod(SIER4G, 0.0035), 1)
        check(IntegrationMethod(SIER4G, 0.0036), 1)
        check(IntegrationMethod(SIER4G, 0.58 * PERIOD, substeps=100, fast_groups=1), 1)
    assert ["more than twice" in str(each.message) for each in caught] == [False, True]


def test_a_drude_force_is_refused_with_what_to_take():
    """SWM4-NDP's pairs were at 178 K, where they belong near 1 K."""
    system = diatomic(strength=0.0)
    drude = openmm.DrudeForce()
    drude.addParticle(1, 0, -1, -1, -1, -1.7, 1e-3, 1, 1)
    system.addForce(drude)
    integrator = SIERIntegrator(0.001, "SIER2")
    with pytest.raises(openmm.OpenMMException, match="DrudeLangevinIntegrator"):
        openmm.Context(system, integrator, platform())
    openmm.Context(diatomic(), integrator, platform())
