"""The check of Forces against their energies: it finds those that are no gradient, and passes others."""

import copy

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIERIntegrator, check_forces
from openmm_sier.observe.force_check import BATCH
from tests.support.containers import contained
from tests.support.force_examples import POSITIONS, system_of
from tests.support.matrices import representatives
from tests.support.peptides import capped_alanine
from tests.support.silence import silence
from tests.support.systems import field, with_forces
from tests.support.waters import array, cluster_system, force_of, periodic_system, plain_context, platform

PLATFORMS = ("Reference", "CPU")

#: The atom that a wrong force acts on, and by how much that is wrong, kJ/mol/nm.
WRONG_ATOM, WRONG = 10, 300.0

#: Sizes are known by sixteen random directions: within these but for 1 in 5,000, by chi-squared.
LOWEST, HIGHEST = 0.40, 1.7


def pushing(state):
    """A constant force of which the energy knows nothing."""
    forces = np.zeros((len(state.getPositions()), 3))
    forces[WRONG_ATOM, 1] = WRONG
    return 0.0 * unit.kilojoule_per_mole, forces * unit.kilojoule_per_mole / unit.nanometer


def resting(state):
    """An energy of which no force knows."""
    x = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    return WRONG * x[WRONG_ATOM, 1] * unit.kilojoule_per_mole, 0 * x * unit.kilojoule_per_mole / unit.nanometer


# --- what is sound ---


@pytest.mark.parametrize(
    ("model", "tolerance", "name"),
    representatives([("tip3p", 5e-4, "CPU"), ("tip4pew", 1e-4, "CPU")], ("tip3p", 5e-4, "CPU")),
)
def test_water_is_sound(model, tolerance, name):
    """With PME as OpenMM splits it, and a jump of Lennard-Jones energies."""
    _, positions, system = periodic_system(model, 64)
    force_of(system).setEwaldErrorTolerance(tolerance)
    report = check_forces(plain_context(system, positions, name))
    assert report.faults == ()
    assert "All Forces are the gradients of their energies within 1 %" in str(report)
    assert "NonbondedForce" in report.checked
    assert "CMMotionRemover" not in report.checked


def test_a_peptide_is_sound():
    system, positions = capped_alanine(waters=4)
    assert check_forces(plain_context(system, positions, "CPU")).faults == ()


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["CustomCVForce in ATMForce", "ConstantPotentialForce"])
def test_forces_within_forces_are_sound(name):
    _, positions, system = periodic_system("tip3p", 64)
    assert check_forces(plain_context(contained(system, name), positions, "CPU")).faults == ()


# --- what is not ---


def gay_berne(wells, count=8, seed=3, gap=0.6, radii=(0.2, 0.25, 0.3)):
    """Ellipsoids, each with two particles that are its axes: System and positions."""
    random = np.random.default_rng(seed)
    system, force, positions = openmm.System(), openmm.GayBerneForce(), []
    for number, corner in zip(range(count), np.ndindex(2, 2, 2), strict=False):
        first = 3 * number
        for mass in (10.0, 1.0, 1.0):
            system.addParticle(mass)
        force.addParticle(0.3, 1.0, first + 1, first + 2, *radii, *wells)
        for _ in range(2):
            force.addParticle(0.1, 0.0, -1, -1, 0.1, 0.1, 0.1, 1, 1, 1)
        axes, _ = np.linalg.qr(random.normal(size=(3, 3)))
        centre = gap * np.array(corner)
        positions += [centre, centre + 0.1 * axes[0], centre + 0.1 * axes[1]]
        for a, b, length in ((0, 1, 0.1), (0, 2, 0.1), (1, 2, 0.1 * 2**0.5)):
            system.addConstraint(first + a, first + b, length)
    system.addForce(force)
    return system, np.array(positions)


def force_error(context, positions):
    """By how much the forces on all atoms are wrong, by central differences, as a norm."""
    forces, slopes = array(context.getState(forces=True).getForces()), np.zeros_like(positions)
    for place in np.ndindex(positions.shape):
        energies = []
        for distance in (-1e-5, 1e-5):
            moved = positions.copy()
            moved[place] += distance
            context.setPositions(moved)
            energies.append(context.getState(energy=True).getPotentialEnergy()._value)
        slopes[place] = (energies[1] - energies[0]) / 2e-5
    return np.linalg.norm(forces + slopes)


@pytest.mark.parametrize("name", representatives(PLATFORMS, "CPU"))
def test_gay_berne_with_different_well_depths_is_found(name):
    """Its forces on the particles of the axes are wrong, on both platforms, as central differences show."""
    system, positions = gay_berne((0.7, 1.3, 0.9))
    context = plain_context(system, positions, name)
    (fault,) = check_forces(context).faults
    assert (fault.force, fault.number) == ("GayBerneForce", 0)
    expected = force_error(plain_context(system, positions), positions)
    assert LOWEST * expected < fault.size < HIGHEST * expected
    assert fault.size > 0.01 * fault.of


@pytest.mark.parametrize("wells", [(1.0, 0.5, 0.2), (1.0, 1.0, 0.2)])
def test_gay_berne_with_different_well_depths_is_found_at_any_start(wells):
    """Forces that are wrong by 1 % to 50 %, and whose error varies along a motion, are no noise."""
    for seed in range(20):
        system, positions = gay_berne(wells, 2, seed, gap=0.5)
        context = plain_context(system, positions)
        of = np.linalg.norm(array(context.getState(forces=True).getForces()))
        check = check_forces(context)
        assert check.doubts == ()
        # Near the tolerance, the directions decide by chance.
        if force_error(context, positions) > 0.01 / LOWEST * of:
            assert len(check.faults) == 1, seed


def test_gay_berne_with_equal_well_depths_is_sound():
    """It is right where axes are at right angles, and not where the motions of the check bring them."""
    for seed in range(10):
        system, positions = gay_berne((0.7, 0.7, 0.7), 8, seed, gap=0.55, radii=(0.2, 0.15, 0.4))
        context = plain_context(system, positions)
        check = check_forces(context)
        assert (check.faults, check.doubts) == ((), ())


# --- what cannot be judged ---


def test_energies_that_jump_are_in_doubt():
    """LCPO drops pairs at a distance where their energy is not zero; the forces are right elsewhere."""
    check = check_forces(plain_context(system_of(openmm.LCPOForce), POSITIONS))
    assert check.faults == ()
    (doubt,) = check.doubts
    assert doubt.force == "LCPOForce"
    assert doubt.hidden > 0.01 * doubt.of
    assert "LCPOForce, Force 0 of the System, cannot be judged" in str(check)


@pytest.mark.parametrize("wrong", representatives([pushing, resting], resting))
def test_a_force_on_one_atom_is_found_among_many(wrong):
    _, positions, system = cluster_system(24)
    force = openmm.PythonForce(wrong)
    force.setName("mine")
    system.addForce(force)
    (fault,) = check_forces(plain_context(system, positions, "CPU")).faults
    assert fault.force == "mine (PythonForce)"
    assert fault.number == system.getNumForces() - 1
    text = str(fault)
    assert text.startswith("mine (PythonForce), Force ")
    assert "is not the gradient of its energy" in text
    assert LOWEST * WRONG < fault.size < HIGHEST * WRONG


@pytest.mark.thorough
def test_more_forces_than_groups():
    """The wrong one is the last of them, behind as many as OpenMM has groups."""
    _, positions, system = cluster_system(4)
    springs = [field(f"{1 + i}*x^2", [i % 12]) for i in range(BATCH + 4)]
    system = with_forces(system, *springs)
    system.addForce(openmm.PythonForce(pushing))
    report = check_forces(plain_context(system, positions))
    assert [fault.force for fault in report.faults] == ["PythonForce"]
    assert len(report.checked) == system.getNumForces()


# --- what it leaves as it is, and refuses ---


def test_a_context_of_this_package_is_not_changed():
    _, positions, system = cluster_system(4)
    integrator = SIERIntegrator(0.002)
    with silence():
        context = openmm.Context(system, integrator, platform())
        context.setPositions(positions)
        context.setVelocitiesToTemperature(297, 1)
        integrator.step(2)
        before, xml = context.getState(positions=True, velocities=True), openmm.XmlSerializer.serialize(system)
        assert check_forces(context).faults == ()
    after = context.getState(positions=True, velocities=True)
    assert np.array_equal(array(before.getPositions()), array(after.getPositions()))
    assert np.array_equal(array(before.getVelocities()), array(after.getVelocities()))
    assert openmm.XmlSerializer.serialize(system) == xml


def test_parameters_of_the_context_count():
    """At its default the parameter leaves nothing of the force."""
    _, positions, system = cluster_system(4)
    system.addForce(field("scale*x^2", [0], scale=0.0))
    wrong = openmm.CustomCVForce("scale*push")
    wrong.addGlobalParameter("scale", 0.0)
    wrong.addCollectiveVariable("push", openmm.PythonForce(pushing))
    system.addForce(wrong)
    context = plain_context(system, positions)
    assert check_forces(context).faults == ()
    context.setParameter("scale", 1.0)
    assert [fault.force for fault in check_forces(context).faults] == ["CustomCVForce"]


def test_what_is_given_wrongly_is_refused():
    _, positions, system = cluster_system(2)
    context = plain_context(system, positions)
    for tolerance in (0, 1, -0.1, float("nan")):
        with pytest.raises(ValueError, match="tolerance must be"):
            check_forces(context, tolerance=tolerance)
    empty = openmm.Context(copy.deepcopy(system), openmm.VerletIntegrator(0.001), platform())
    with pytest.raises(openmm.OpenMMException, match="NonbondedForce is nan"):
        check_forces(empty)
