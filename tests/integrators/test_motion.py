"""Types that move along and about some axes only, in a Context: all ensembles, velocities, minimization, refusals."""

import math
import re
from dataclasses import replace

import numpy as np
import openmm
import pytest
from scipy.special import ive

from openmm_sier import (
    SIER2,
    SIER4G,
    BodyType,
    Motion,
    RigidityError,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    SIERThermostatIntegrator,
    with_frames,
)
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.vectors import body_frame
from openmm_sier.ensembles import VelocityRescaling
from openmm_sier.system.bonded_terms import mobilities
from tests.support.seeded import seeded
from tests.support.systems import field
from tests.support.types import PATCHY, TOP, typed

T = 300.0
ROD = BodyType("rod", [[-0.1, 0, 0], [0.15, 0, 0]], [12, 8])

MOTIONS = {
    "rotating": Motion.ROTATING,
    "translating": Motion.TRANSLATING,
    "pinned": Motion.PINNED,
    "in plane": Motion.IN_PLANE,
    "about an axis on a line": Motion((False, True, False), (False, True, False)),
}

ENSEMBLES = {
    "SIER2": lambda **options: SIERIntegrator(0.005, SIER2, **options),
    "SIER4G": lambda **options: SIERIntegrator(0.005, SIER4G, **options),
    "langevin": lambda **options: SIERLangevinIntegrator(T, 5.0, 0.005, **options),
    "rescaling": lambda **options: SIERThermostatIntegrator(VelocityRescaling(T, 5.0, every=2), 0.005, **options),
    "trials": lambda **options: SIERHMCIntegrator(T, 0.005, **options),
}


def context_of(system, positions, integrator, velocities=7):
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    if velocities is not None:
        context.setVelocitiesToTemperature(T, velocities)
    return context


def mixture(motion, number=4, **options):
    """Bodies of three shapes with a motion, and free ones, in a field."""
    kinds = {replace(kind, motion=motion): number for kind in (ROD, TOP, PATCHY)}
    return typed({**kinds, replace(TOP, name="free"): 2}, flat=motion == Motion.IN_PLANE, **options)


@pytest.mark.parametrize("name", ENSEMBLES)
@pytest.mark.parametrize("motion", MOTIONS)
def test_what_cannot_move_stays(motion, name):
    system, positions, bodies = mixture(MOTIONS[motion])
    integrator = seeded(ENSEMBLES[name](bodies=bodies), 3)
    _context = context_of(system, positions, integrator)
    first = integrator.getBodyState()
    integrator.step(20)
    state = integrator.getBodyState()
    stays = ~bodies.translates
    np.testing.assert_array_equal(state.q[stays], first.q[stays])
    assert not state.p[stays].any()
    # Angular momenta of size 5, after some hundred operations that round.
    assert np.abs(body_frame(state.A, state.L)[~bodies.turns]).max() < 1e-12
    turned = np.einsum("axn,axn->an", first.A, state.A)
    is_fixed = ~bodies.turns.any(axis=0)
    assert is_fixed.any() == (motion in ("translating", "pinned"))
    np.testing.assert_array_equal(state.A[:, :, is_fixed], first.A[:, :, is_fixed])
    hinged = bodies.turns & (bodies.turns.sum(axis=0) == 1)
    np.testing.assert_allclose(turned[hinged], 1, rtol=0, atol=1e-13)
    # All that can move does.
    assert (state.q != first.q)[bodies.translates].all()
    assert (turned[:, ~is_fixed].min(axis=0) < 1 - 1e-9).all()
    assert math.isfinite(integrator.computeTemperatures().in_kelvin().total)


@pytest.mark.parametrize("name", ["SIER2", "SIER4G"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_energy_errors_have_the_order_of_the_scheme(motion, name):
    errors = []
    for divisor in (2, 4):
        system, positions, bodies = mixture(MOTIONS[motion])
        integrator = ENSEMBLES[name](bodies=bodies)
        integrator.setStepSize(0.01 / divisor)
        context = context_of(system, positions, integrator)
        energies = []
        for _ in range(20):
            integrator.step(divisor)
            state = context.getState(energy=True)
            kinetic = sum(bodies.kinetic_energies(integrator.getBodyState()))
            energies.append(state.getPotentialEnergy()._value + kinetic)
        errors.append(np.ptp(energies))
    # Half the next order, since the longest of these steps is a sixth of the fastest period.
    order = {"SIER2": 2, "SIER4G": 4}[name]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.5)


@pytest.mark.parametrize("motion", MOTIONS)
def test_velocities_and_temperatures_are_those_of_what_moves(motion):
    number = 400
    kinds = {replace(kind, motion=MOTIONS[motion]): number for kind in (ROD, TOP, PATCHY)}
    system, positions, bodies = typed(kinds, flat=True)
    integrator = ENSEMBLES["SIER2"](bodies=bodies)
    _context = context_of(system, positions, integrator)
    state = integrator.getBodyState()
    kT = GAS_CONSTANT * T
    along = state.p**2 / (bodies.masses * kT)
    about = body_frame(state.A, state.L) ** 2 * bodies.inverse_moments / kT
    for values, freedoms in ((along, bodies.translates), (about, bodies.turns)):
        assert np.abs(values[~freedoms]).max(initial=0.0) < 1e-20
        if freedoms.any():
            # A sum of squares of as many normal deviates: four standard errors.
            assert values[freedoms].mean() == pytest.approx(1, abs=4 * math.sqrt(2 / freedoms.sum()))
    temperatures = integrator.computeTemperatures().in_kelvin()
    total = bodies.translates.sum() + bodies.turns.sum()
    assert bodies.dof == total
    if total:
        assert temperatures.total == pytest.approx(T * (along.sum() + about.sum()) / total)
    assert math.isnan(temperatures.rotation) == (not bodies.turns.any())
    assert math.isnan(temperatures.translation) == (not bodies.translates.any())


@pytest.mark.parametrize(("others", "freedoms"), [(Motion.IN_PLANE, 3 * 5 - 2), (Motion.PINNED, 3 * 4)])
def test_momentum_is_conserved_along_axes_along_which_all_bodies_move(others, freedoms):
    one = replace(ROD, name="other", motion=others)
    system, positions, bodies = typed({replace(ROD, motion=Motion.IN_PLANE): 4, one: 1}, flat=True)
    system.removeForce(0)
    integrator = ENSEMBLES["SIER2"](bodies=bodies)
    _context = context_of(system, positions, integrator)
    assert integrator.conservesMomentum == (others is Motion.IN_PLANE)
    kinetic = sum(bodies.kinetic_energies(integrator.getBodyState()))
    if others is Motion.IN_PLANE:
        momentum = integrator.getBodyState().p.sum(axis=1)
        kinetic -= 0.5 * float(momentum @ momentum) / bodies.masses.sum()
    assert integrator.computeTemperatures().in_kelvin().total == pytest.approx(2 * kinetic / (freedoms * GAS_CONSTANT))


@pytest.mark.parametrize("name", ["SIER2", "langevin", "trials"])
def test_a_remover_of_the_centre_leaves_what_cannot_move(name):
    # Nothing moves along z.
    kinds = {replace(kind, motion=Motion.IN_PLANE): 4 for kind in (ROD, TOP, PATCHY)}
    system, positions, bodies = typed(kinds, flat=True)
    system.removeForce(0)
    system.addForce(openmm.CMMotionRemover())
    integrator = seeded(ENSEMBLES[name](bodies=bodies), 3)
    _context = context_of(system, positions, integrator)
    integrator.step(3)
    state = integrator.getBodyState()
    assert not state.p[~bodies.translates].any()
    if name != "langevin":
        # Rounding of a sum of 12 momenta of size 10.
        assert np.abs(state.p.sum(axis=1)).max() < 1e-12


def test_a_hinged_dipole_has_its_average_in_one_degree_of_freedom_that_is_rescaled():
    """One pendulum, whose canonical average rescaling samples: nothing else has heat."""
    length, strength = 0.2, 1.5
    pull = strength * GAS_CONSTANT * T / length
    kind = BodyType("pendulum", [[0, 0, 0], [length, 0, 0]], [6, 6], motion=Motion((False,) * 3, (False, False, True)))
    system, _, bodies = typed({kind: 1})
    system.removeForce(0)
    system.addForce(field(f"-{pull}*x", [1]))
    system.addForce(field(f"{pull}*x", [0]))
    bath = VelocityRescaling(T, 2.0, every=5)
    integrator = seeded(SIERThermostatIntegrator(bath, 0.02, SIER2, bodies=bodies), 5)
    context = context_of(system, np.array([[0.0, 0, 0], [length, 0, 0]]), integrator)
    cosines = []
    for _ in range(600):
        integrator.step(20)
        one, other = context.getState(positions=True).getPositions()
        cosines.append((other - one)[0]._value / length)
    assert integrator.bodies.dof == 1
    blocks = np.mean(np.reshape(cosines, (40, 15)), axis=1)
    expected = ive(1, strength) / ive(0, strength)
    assert blocks.mean() == pytest.approx(expected, abs=4 * blocks.std() / math.sqrt(39))
    # The bound is narrow: without the field the mean would be zero.
    assert blocks.std() / math.sqrt(39) < 0.05


def test_sites_move_as_easily_as_the_motion_lets_them():
    """The rules for steps take the largest response of a site to a force."""
    # The first site is at this distance from the centre of mass of 12 and 8 dalton, which are 0.25 nm apart.
    arm = 0.25 * 8 / 20
    expected = {
        Motion.FREE: 1 / 20 + arm**2 / ROD.principal_moments[2],
        Motion.ROTATING: arm**2 / ROD.principal_moments[2],
        Motion.TRANSLATING: 1 / 20,
        Motion.PINNED: 0.0,
    }
    for motion, mobility in expected.items():
        _, _, bodies = typed({replace(ROD, motion=motion): 1})
        assert mobilities(bodies)[0] == pytest.approx(mobility)


@pytest.mark.parametrize("motion", MOTIONS)
def test_minimization_moves_only_what_can_move(motion):
    system, positions, bodies = mixture(MOTIONS[motion])
    integrator = ENSEMBLES["SIER2"](bodies=bodies)
    context = context_of(system, positions, integrator, velocities=None)
    first, before = integrator.getBodyState(), context.getState(energy=True).getPotentialEnergy()
    openmm.LocalEnergyMinimizer.minimize(context, 1.0, 200)
    state = integrator.getBodyState()
    assert context.getState(energy=True).getPotentialEnergy() < before
    np.testing.assert_allclose(state.q[~bodies.translates], first.q[~bodies.translates], rtol=0, atol=1e-12)
    is_fixed = ~bodies.turns.any(axis=0)
    np.testing.assert_allclose(state.A[:, :, is_fixed], first.A[:, :, is_fixed], rtol=0, atol=1e-12)


def test_constraints_within_a_body_do_not_set_it_free():
    system, positions, bodies = typed({replace(ROD, motion=Motion.PINNED): 3})
    for one in range(0, 6, 2):
        system.addConstraint(one, one + 1, 0.25)
    integrator = ENSEMBLES["SIER2"](bodies=bodies)
    context = context_of(system, positions, integrator)
    assert not context.getState(velocities=True).getVelocities(asNumpy=True)._value.any()
    openmm.LocalEnergyMinimizer.minimize(context, 1.0, 50)
    np.testing.assert_allclose(
        context.getState(positions=True).getPositions(asNumpy=True)._value, positions, atol=1e-12
    )


@pytest.mark.parametrize("name", ["langevin", "trials"])
def test_restarts_and_copies_have_the_motion(name):
    system, positions, bodies = mixture(Motion.IN_PLANE)
    integrator = seeded(ENSEMBLES[name](bodies=bodies), 3)
    context = context_of(system, positions, integrator)
    integrator.step(3)
    copied = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(integrator))
    assert [kind.motion for kind in copied.impl.settings.bodies.species] == [kind.motion for kind in bodies.species]
    later = context_of(system, positions, copied)
    later.loadCheckpoint(context.createCheckpoint())
    ends = []
    for each in (integrator, copied):
        each.step(3)
        ends.append(each.getBodyState())
    for array in ("q", "p", "A", "L"):
        np.testing.assert_array_equal(getattr(ends[0], array), getattr(ends[1], array))


def test_the_volume_changes_where_all_bodies_translate():
    system, positions, bodies = mixture(Motion.TRANSLATING, size=1.0, periodic=True)
    integrator = seeded(SIERLangevinIntegrator(T, 5.0, 0.005, bodies=bodies, pressure=1e5, barostatInterval=1), 3)
    context = context_of(system, positions, integrator)
    before = context.getState().getPeriodicBoxVolume()
    first = integrator.getBodyState()
    integrator.step(10)
    assert context.getState().getPeriodicBoxVolume() != before
    is_fixed = ~bodies.turns.any(axis=0)
    np.testing.assert_array_equal(integrator.getBodyState().A[:, :, is_fixed], first.A[:, :, is_fixed])


@pytest.mark.parametrize("barostat", ["pressure", "MonteCarloBarostat"])
def test_bodies_that_do_not_translate_refuse_pressure(barostat):
    system, positions, bodies = mixture(Motion.IN_PLANE, size=1.0, periodic=True)
    options = {"pressure": 1.0} if barostat == "pressure" else {}
    if not options:
        system.addForce(openmm.MonteCarloBarostat(1.0, T))
    integrator = SIERLangevinIntegrator(T, 5.0, 0.005, bodies=bodies, **options)
    message = f"does not move along all axes: leave out the {barostat}"
    with pytest.raises(openmm.OpenMMException, match=re.escape(message)):
        context_of(system, positions, integrator)


def test_the_native_engine_and_frames_refuse_motions():
    system, positions, bodies = mixture(Motion.ROTATING)
    integrator = SIERLangevinIntegrator(T, 5.0, 0.005, bodies=bodies, engine="native")
    with pytest.raises(openmm.OpenMMException, match=r"Motion\.FREE, .*engine='exact'"):
        context_of(system, positions, integrator)
    with pytest.raises(ValueError, match=r"Motion\.FREE"):
        with_frames(system, positions, bodies)


def test_bodies_that_are_inclined_to_the_plane_are_refused():
    with pytest.raises(RigidityError, match=r"'rod' with Motion\.IN_PLANE"):
        typed({replace(ROD, motion=Motion.IN_PLANE): 3})


def test_a_motion_is_checked():
    with pytest.raises(TypeError, match=r"motion of .*'rod'"):
        replace(ROD, motion="pinned")
    with pytest.raises(ValueError, match=r"'top': .*two of three axes"):
        replace(TOP, motion=Motion(rotations=(True, True, False)))
    assert replace(ROD, motion=Motion.IN_PLANE).dof == 3
