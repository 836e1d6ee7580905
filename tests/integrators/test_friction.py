"""Friction by type and by axis of the body: diffusion, bookkeeping, settings and refusals."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import openmm
import pytest
from openmm import unit
from scipy.linalg import expm

from openmm_sier import (
    BodyType,
    Motion,
    RigidBodies,
    SIERIntegrator,
    SIERLangevinIntegrator,
    rotational_friction,
    translational_friction,
)
from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.ensembles import Langevin
from tests.support.oracles import random_attitudes
from tests.support.seeded import seeded
from tests.support.types import TOP, typed

T = 300.0
KT = GAS_CONSTANT * T

#: Moments of 1 dalton nm^2.
ROD = BodyType("rod", [[-0.25, 0, 0], [0.25, 0, 0]], [8, 8])

STEPS = [0.005, 0.01, 0.02]


def context_of(system, positions, integrator, seed=7):
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(integrator.getTemperature(), seed)
    return context


def free(counts, **options):
    """Bodies without forces."""
    system, positions, bodies = typed(counts, **options)
    system.removeForce(0)
    return system, positions, bodies


def states(kind, number, step, lag, blocks, **frictions):
    """States of free bodies of a type after some steps each."""
    system, positions, bodies = free({kind: number})
    integrator = seeded(SIERLangevinIntegrator(T, stepSize=step, bodies=bodies, **frictions), 11)
    _context = context_of(system, positions, integrator)
    result = [integrator.getBodyState()]
    for _ in range(blocks):
        integrator.step(lag)
        result.append(integrator.getBodyState())
    return result


def squared_way(D, friction, step, lag):
    """Mean square of a way in `lag` steps, each half a step with the velocity before the bath and half with the other.

    The velocity keeps a factor of exp(-friction h) in a bath. For many steps it is 2 D t (gamma h/2) coth(gamma h/2).
    """
    weights = np.ones(lag + 1)
    weights[[0, -1]] = 0.5
    times = np.arange(lag + 1) * step
    kept = np.exp(-friction * np.abs(times[:, None] - times))
    return D * friction * step**2 * (weights @ kept @ weights)


def assert_mean(values, expected):
    """The mean of independent values is the expected one, within four standard errors."""
    assert values.mean() == pytest.approx(expected, abs=4 * values.std() / math.sqrt(values.size))


# --- diffusion --------------------------------------------------------------------------------------------------------


def test_the_step_error_of_diffusion_is_that_on_the_page():
    for friction, step in ((50.0, 0.005), (50.0, 0.02), (5.0, 0.004)):
        long = squared_way(1.0, friction, step, 1600) - squared_way(1.0, friction, step, 800)
        half = friction * step / 2
        assert long / (2 * 800 * step) == pytest.approx(half / math.tanh(half), rel=1e-6)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("kind", [ROD, TOP], ids=lambda kind: kind.name)
def test_bodies_diffuse_along_and_across_their_axes(kind, step):
    kind = replace(kind, motion=Motion.TRANSLATING)
    D = np.array([0.005, 0.0025, 0.0025] if kind.name == "rod" else [0.003, 0.0015, 0.002])
    friction = translational_friction(kind, D, T)
    lag = round(0.2 / step)
    found = states(kind, 1000, step, lag, 5, frictionCoeff={kind.name: friction}, rotationalFriction=1.0)
    ways = np.array([np.einsum("axn,xn->an", one.A, other.q - one.q) for one, other in pairwise(found)])
    for axis, rate in enumerate(friction._value):
        assert_mean(ways[:, axis] ** 2, squared_way(D[axis], rate, step, lag))


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("axis", range(3))
def test_bodies_diffuse_about_each_of_their_axes(axis, step):
    hinge = Motion((False,) * 3, tuple(k == axis for k in range(3)))
    kind = replace(TOP, motion=hinge)
    # The moments are 0.2 to 0.5 dalton nm^2, and the angles of a block 0.2.
    D = np.array([0.25, 0.2, 0.1])
    friction = rotational_friction(kind, D, T)
    lag = round(0.2 / step)
    found = states(kind, 1000, step, lag, 5, frictionCoeff=1.0, rotationalFriction={kind.name: friction})
    other = (axis + 1) % 3
    angles = []
    for one, later in pairwise(found):
        seen = np.einsum("axn,xn->an", one.A, later.A[other])
        angles.append(np.arctan2(seen[(axis + 2) % 3], seen[other]))
    assert_mean(np.array(angles) ** 2, squared_way(D[axis], friction._value[axis], step, lag))


@pytest.mark.parametrize("step", STEPS)
def test_a_rod_turns_across_its_axis_by_rotational_diffusion(step):
    D = 0.05
    friction = rotational_friction(ROD, D, T)
    rate = friction._value[1]
    assert friction._value[0] == 0
    lag = round(1.0 / step)
    found = states(ROD, 1000, step, lag, 4, frictionCoeff=1.0, rotationalFriction={"rod": friction})
    cosines = np.array([(one.A[0] * other.A[0]).sum(axis=0) for one, other in pairwise(found)])
    # <u u'> = exp(-<angle^2>), with the angle about each of two axes; inertia corrects that by D/gamma, 0.1 %.
    way = squared_way(D, rate, step, lag)
    assert cosines.mean() == pytest.approx(math.exp(-way), abs=4 * cosines.std() / math.sqrt(cosines.size) + 1e-3 * way)


# --- the process ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moves", [(1, 1, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1), (0, 0, 1), (1, 0, 0), (0, 0, 0)])
def test_momenta_decay_by_the_friction_tensor_along_which_the_body_moves(rng, moves):
    n, h, mass = 5, 0.3, 7.0
    A = random_attitudes(rng, n)
    rates = rng.uniform(0.1, 4, (6, n))
    allowed = np.array(moves, dtype=bool)[:, None].repeat(n, axis=1)
    p, L = rng.normal(size=(3, n)) * allowed, rng.normal(size=(3, n))
    spreads = np.tile([[1.5], [0.3], [0.4], [0.5]], n)
    inverses = np.full(n, 1 / mass), np.ones((3, n))

    def bathed(p, L, noise):
        new_p, new_L = np.empty((3, n)), np.empty((3, n))
        gain = kernels.bodies.bathe_by_axes(n, p, A, L, h, rates, spreads, allowed, noise, *inverses, new_p, new_L)
        return new_p, new_L, gain

    new_p, new_L, gain = bathed(p, L, np.zeros((6, n)))
    of_noise = []
    for row in range(6):
        noise = np.zeros((6, n))
        noise[row] = 1.0
        of_noise.append(np.concatenate(bathed(np.zeros((3, n)), np.zeros((3, n)), noise)[:2]))
    covariances = np.einsum("ran,rbn->abn", of_noise, of_noise)
    energy = 0.0
    for k in range(n):
        frame, allow = A[:, :, k], np.diag(moves).astype(float)
        tensors = allow @ frame.T @ np.diag(rates[:3, k]) @ frame @ allow, frame.T @ np.diag(rates[3:, k]) @ frame
        np.testing.assert_allclose(new_p[:, k], expm(-h * tensors[0]) @ p[:, k], atol=1e-14)
        np.testing.assert_allclose(new_L[:, k], expm(-h * tensors[1]) @ L[:, k], atol=1e-14)
        expected = 1.5**2 * (allow - allow @ expm(-2 * h * tensors[0]) @ allow)
        np.testing.assert_allclose(covariances[:3, :3, k], expected, atol=1e-14)
        thermal = frame.T @ np.diag([0.09, 0.16, 0.25]) @ frame
        np.testing.assert_allclose(
            covariances[3:, 3:, k], thermal - expm(-h * tensors[1]) @ thermal @ expm(-h * tensors[1]), atol=1e-14
        )
        energy += (new_p[:, k] ** 2 - p[:, k] ** 2).sum() / (2 * mass) + (new_L[:, k] ** 2 - L[:, k] ** 2).sum() / 2
    assert gain == pytest.approx(energy)


def test_one_number_for_each_type_is_that_number_for_all():
    ends = []
    for friction in (3.0, {"rod": 3.0, "top": (3, 3, 3)}, {"default": 3 / unit.picosecond}):
        system, positions, bodies = typed({ROD: 3, TOP: 3})
        integrator = SIERLangevinIntegrator(T, friction, 0.005, bodies=bodies)
        context = context_of(system, positions, integrator)
        # Noise has other directions in the frames of bodies.
        integrator.setTemperature(0)
        integrator.step(20)
        ends.append(context.getState(positions=True).getPositions(asNumpy=True)._value)
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(ends[2], ends[1])


def test_without_friction_of_any_type_it_is_the_nve_trajectory_bit_for_bit():
    ends = []
    for make in (
        lambda **options: SIERLangevinIntegrator(T, {"default": 0}, 0.005, **options),
        lambda **options: SIERIntegrator(0.005, "SIER2", **options),
    ):
        system, positions, bodies = typed({ROD: 3})
        integrator = make(bodies=bodies)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(positions)
        context.setVelocitiesToTemperature(T, 1)
        integrator.step(10)
        ends.append(context.getState(positions=True).getPositions(asNumpy=True)._value)
    np.testing.assert_array_equal(*ends)


def test_energy_less_heat_is_constant():
    system, positions, bodies = free({ROD: 5, replace(TOP, motion=Motion.IN_PLANE): 5}, flat=True)
    friction = {"rod": (20, 40, 40), "top": (5, 10, 15)}
    integrator = seeded(SIERLangevinIntegrator(T, friction, 0.005, bodies=bodies), 2)
    _context = context_of(system, positions, integrator)
    before = sum(bodies.kinetic_energies(integrator.getBodyState()))
    integrator.step(50)
    heat = integrator.getHeat()._value
    assert abs(heat) > 0.1
    # Rounding of sums of some 50 kJ/mol in 50 steps.
    assert sum(bodies.kinetic_energies(integrator.getBodyState())) - heat == pytest.approx(before, abs=1e-11)


@pytest.mark.parametrize("scheme", ["SIER2", "SIER4G"])
def test_axes_have_their_temperature_whatever_their_friction(scheme):
    system, positions, bodies = free({ROD: 300, TOP: 300})
    friction = {"rod": (50, 1, 5), "top": (1, 10, 100)}
    integrator = seeded(SIERLangevinIntegrator(T, friction, 0.004, scheme, bodies=bodies), 2)
    _context = context_of(system, positions, integrator)
    integrator.step(100)
    along, about = [], []
    for _ in range(20):
        integrator.step(5)
        state = integrator.getBodyState()
        p, L = (np.einsum("axn,xn->an", state.A, vector) for vector in (state.p, state.L))
        along.append(p**2 / (bodies.masses * KT))
        about.append(L**2 * bodies.inverse_moments / KT)
    for columns in bodies.columns:
        # Samples 20 fs apart hardly count for more than one where friction is low: four errors of 300 bodies.
        np.testing.assert_allclose(np.mean(along, axis=0)[:, columns].mean(axis=1), 1, atol=4 * math.sqrt(2 / 300))
        turning = bodies.turns[:, columns].any(axis=1)
        means = np.mean(about, axis=0)[:, columns].mean(axis=1)
        np.testing.assert_allclose(means, turning.astype(float), atol=4 * math.sqrt(2 / 300))


# --- settings ---------------------------------------------------------------------------------------------------------


def test_frictions_are_set_returned_and_copied():
    integrator = SIERLangevinIntegrator(T, {"rod": 1 / unit.nanosecond, "default": (1, 2, 3)}, 0.004)
    expected = {"rod": [1e-3] * 3, "default": [1, 2, 3]}
    for each in (integrator, openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(integrator))):
        for method in (each.getFriction, each.getRotationalFriction):
            assert {name: list(rates / unit.picosecond**-1) for name, rates in method().items()} == expected
    integrator.setRotationalFriction({"rod": np.array([1, 2, 3]) / unit.picosecond})
    integrator.setFriction(4)
    assert integrator.getFriction() == 4 / unit.picosecond
    assert list(integrator.getRotationalFriction()["rod"] / unit.picosecond**-1) == [1, 2, 3]
    integrator.setFriction(integrator.getRotationalFriction())
    assert list(integrator.getFriction()["rod"] / unit.picosecond**-1) == [1, 2, 3]


@pytest.mark.parametrize(
    ("friction", "error", "message"),
    [
        ({"rod": -1}, ValueError, r"frictionCoeff\['rod'\] must not be negative, got -1 1/ps"),
        ({"rod": (1, 2)}, ValueError, r"frictionCoeff\['rod'\] must be one number or three, along the axes"),
        ({"rod": (1, 2, math.inf)}, ValueError, r"frictionCoeff\['rod'\] must be finite"),
        ({"rod": "fast"}, TypeError, r"frictionCoeff\['rod'\] must be a quantity or a number in 1/ps"),
        ({"rod": 3 * unit.kelvin}, TypeError, r"frictionCoeff\['rod'\] must be in units like 1/ps"),
        ({ROD: 1}, TypeError, "frictionCoeff must be a number, or numbers by the names of types, got the key"),
        ((1, 2, 3), TypeError, "frictionCoeff must be a quantity or a number in 1/ps"),
    ],
)
def test_wrong_frictions_are_refused(friction, error, message):
    with pytest.raises(error, match=message):
        SIERLangevinIntegrator(T, friction, 0.004)


@pytest.mark.parametrize(
    ("friction", "message"),
    [
        ({"rodd": 1.0, "default": 1}, "frictionCoeff names the type 'rodd', but the bodies have rod"),
        (
            {},
            "frictionCoeff has no friction for the body of atoms 0, 1: name its type, or give a friction for 'default'",
        ),
    ],
)
def test_frictions_that_do_not_fit_the_types_are_refused_at_creation_and_later(friction, message):
    system, positions, bodies = typed({ROD: 2})
    with pytest.raises(openmm.OpenMMException, match=message):
        context_of(system, positions, SIERLangevinIntegrator(T, friction, 0.004, bodies=bodies))
    integrator = SIERLangevinIntegrator(T, {"rod": 1.0}, 0.004, bodies=bodies)
    _context = context_of(system, positions, integrator)
    with pytest.raises(openmm.OpenMMException, match=message):
        integrator.setFriction(friction)
    with pytest.raises(openmm.OpenMMException, match=message.replace("frictionCoeff", "rotationalFriction")):
        integrator.setRotationalFriction(friction)
    assert list(integrator.getFriction()) == ["rod"]
    integrator.step(1)


def test_the_native_engine_refuses_frictions_of_types_at_creation_and_later():
    message = (
        "The native engine has one friction for all bodies: give `frictionCoeff` as a number, or take engine='exact'"
    )
    system = openmm.System()
    system.addParticle(1.0)
    positions = np.zeros((1, 3))
    with pytest.raises(openmm.OpenMMException, match=message):
        context_of(system, positions, SIERLangevinIntegrator(T, {"default": 1}, 0.004, engine="native"))
    integrator = SIERLangevinIntegrator(T, 1.0, 0.004, engine="native")
    _context = context_of(system, positions, integrator)
    with pytest.raises(openmm.OpenMMException, match=message):
        integrator.setFriction({"default": 1})
    assert integrator.getFriction() == 1 / unit.picosecond
    integrator.step(1)


def test_points_that_constraints_join_have_one_friction():
    system = openmm.System()
    for _ in range(3):
        system.addParticle(12.0)
    system.addConstraint(0, 1, 0.1)
    system.addConstraint(1, 2, 0.1)
    positions = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]])
    with pytest.raises(openmm.OpenMMException, match=r"frictionCoeff .*atom 0 and atom 1"):
        context_of(system, positions, SIERLangevinIntegrator(T, {"default": (1, 2, 2)}, 0.004))
    integrator = SIERLangevinIntegrator(T, {"default": 1}, 0.004)
    _context = context_of(system, positions, integrator)
    integrator.step(3)


def test_momentum_is_conserved_without_friction_of_translation():
    assert not Langevin(T, {"rod": 0}, {"rod": 1}).has_friction
    assert Langevin(T, {"rod": (0, 0, 1)}).has_friction


# --- from diffusion constants -----------------------------------------------------------------------------------------


def test_friction_follows_from_diffusion():
    D = (0.1, 0.2, 0.4)
    np.testing.assert_allclose(translational_friction(TOP, D, T)._value, KT / (TOP.mass * np.array(D)))
    np.testing.assert_allclose(rotational_friction(TOP, D, T)._value, KT / (TOP.principal_moments * D))
    with_units = translational_friction(TOP, D * unit.nanometer**2 / unit.picosecond, T * unit.kelvin)
    assert with_units == translational_friction(TOP, D, T)
    assert translational_friction(TOP, 0.1, T)._value == (KT / (TOP.mass * 0.1),) * 3


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((ROD, (0.1, 0, 0.1), T), ValueError, "diffusion must be above zero: zero would need an infinite friction"),
        ((ROD, -0.1, T), ValueError, "diffusion must not be negative"),
        ((ROD, (0.1, 0.1), T), ValueError, "diffusion must be one number or three"),
        ((ROD, 0.1, 0), ValueError, "temperature must be above zero"),
        ((ROD, 0.1 * unit.nanometer, T), TypeError, "diffusion must be in units like nm"),
    ],
)
def test_impossible_diffusion_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        translational_friction(*arguments)


def test_types_may_differ_in_one_system():
    """Bodies without a type have the default, and the frictions reach the right bodies in the user's order."""
    system, positions, _ = typed({ROD: 2, TOP: 2})
    lists = [[0, 1], [2, 3]], [[4, 5, 6, 7], [8, 9, 10, 11]]
    system.addParticle(40.0)
    positions = np.append(positions, [[5.0, 5, 5]], axis=0)
    bodies = RigidBodies.from_types(system, {TOP: lists[1], ROD: lists[0]}, positions)
    bath = Langevin(T, {"rod": (1, 2, 2), "top": 5, "default": 7}).method(SIERLangevinIntegrator(T, 1, 1).impl.method())
    frictions = bath.bath.frictions(bodies)[:3]
    by_atoms = {tuple(bodies.atoms_of(k)): frictions[:, k].tolist() for k in range(bodies.n)}
    assert by_atoms == {
        (0, 1): [1, 2, 2],
        (2, 3): [1, 2, 2],
        (4, 5, 6, 7): [5] * 3,
        (8, 9, 10, 11): [5] * 3,
        (12,): [7] * 3,
    }
