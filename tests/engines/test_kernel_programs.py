"""Programs of the kernels engine as they are written, without kernels: launches, forces and times of trajectories."""

from types import SimpleNamespace

import pytest

from openmm_sier import SIER2V2, SIER4G
from openmm_sier.dynamics.plan import FAST, SLOW, plan_step
from openmm_sier.engines.compiled.movers import DISPLACE, DRIFT, KICK, KICK_FROM_THERE
from openmm_sier.engines.compiled.scalars import Scalars
from openmm_sier.engines.compiled.writing import NOTHING, StepWriter, written_trajectory

STEPS = 3

#: Each drift is one inner step of three fast forces, the last of which is the first of the next.
ONE_INNER_STEP = 0.5


def trajectory(scheme, longest=None):
    """The parts of a trajectory of `STEPS` steps, and the scalars of its calls at a step of 1 ps."""
    plan, scalars = plan_step(scheme, longest, updates=False), Scalars()
    first, between, last = written_trajectory(plan, longest is not None, scalars)
    return [*first, *(STEPS - 1) * between, *last], scalars.values(SimpleNamespace(step=1.0, bath=None))


def time_of(parts, values, kinds, begins_with=(NOTHING, SLOW, FAST)):
    """Time of all calls of some kinds of members, in parts that begin with some forces, ps."""
    chosen = [part for part in parts if part.begins_with in begins_with]
    return sum(values[call.scalars[0]] for part in chosen for call in part.members if call.kind in kinds)


@pytest.mark.parametrize("scheme", [SIER2V2, SIER4G], ids=lambda scheme: scheme.name)
def test_a_trajectory_has_one_launch_between_two_forces(scheme):
    parts, values = trajectory(scheme)
    forces = [part for part in parts if part.begins_with == SLOW]
    # The first ones are at hand.
    assert len(forces) == STEPS * scheme.force_evaluations + 1
    assert len([part for part in parts if part.members]) == len(forces)
    assert time_of(parts, values, (KICK, KICK_FROM_THERE)) == pytest.approx(STEPS)
    assert time_of(parts, values, (DRIFT,)) == pytest.approx(STEPS)


def test_fast_forces_between_two_drifts_are_computed_once():
    parts, values = trajectory(SIER2V2, ONE_INNER_STEP)
    fast = [part for part in parts if part.begins_with == FAST]
    assert len(fast) == 2 * STEPS * 3 + 1
    assert len([part for part in parts if part.begins_with == SLOW]) == 2 * STEPS + 1
    for forces in (FAST, SLOW):
        assert time_of(parts, values, (KICK, KICK_FROM_THERE), (forces,)) == pytest.approx(STEPS)
    assert time_of(parts, values, (DRIFT,)) == pytest.approx(STEPS)
    # Atoms do not move between the fast forces of an end and the slow ones, and the last ones of both give its energy.
    assert [part.begins_with for part in parts[-2:]] == [FAST, SLOW]
    assert [part.wants_energy for part in parts] == [*(len(parts) - 2) * [False], True, True]
    assert not any(part.moves for part in parts[-2:])


def test_kicks_do_not_pass_a_displacement():
    """The first kick of a drift by inner steps goes to the fast forces of before, on either side of a gradient kick."""
    writer = StepWriter(False, True, Scalars())
    writer.write(plan_step(SIER4G, ONE_INNER_STEP, updates=False).operations)
    parts = writer.parts
    displaced = next(i for i, part in enumerate(parts) if DISPLACE in kinds(part) and part.begins_with == SLOW)
    assert kinds(parts[displaced - 1]) == [KICK, KICK]
    assert parts[displaced - 1].begins_with == FAST
    assert kinds(parts[displaced + 1]) == [KICK_FROM_THERE, DRIFT]


def kinds(part):
    """Kinds of the calls of members."""
    return [call.kind for call in part.members]
