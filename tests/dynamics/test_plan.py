"""Plans: the number of inner steps, what engines read of operations, and the text."""

import pytest

from openmm_sier import SIER2, SIER4, SIER4G, Scheme
from openmm_sier.dynamics.plan import Energy, Kick, Repeat, UpdateContext, inner_steps, plan_step, steps_with_bath
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.dynamics.stages import DRIFT, KICK


def test_steps_with_a_bath_in_one_are_odd():
    assert [steps_with_bath(h, 0.001) for h in (0.001, 0.0011, 0.003, 0.0031, -0.005)] == [1, 3, 3, 5, 5]


def test_inner_steps():
    assert [inner_steps(h, 0.001) for h in (0.0, 0.001, 0.0010001, 0.003, -0.004)] == [1, 1, 2, 3, 4]
    # Rounding of a product does not make one step more.
    assert inner_steps(0.1 * 0.003 * 10, 0.001) == 3


def test_each_drift_has_as_many_inner_steps_as_its_length_needs():
    """The drifts of SIER4 are 0.17, 0.59, -0.16 and so on of a step, so that two have more than one."""
    plan = plan_step(SIER4, 0.3)
    numbers = [operation.number for operation in plan.operations if operation.moves_atoms]
    assert numbers == [inner_steps(stage.fraction, 0.3) for stage in SIER4.stages if stage.flow == DRIFT]
    assert len(set(numbers)) > 1
    assert plan.longest_inner_step <= 0.3


@pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=CATALOGUE)
def test_the_energy_of_an_end_comes_with_its_forces(scheme):
    """Once no atom moves any more, and only where a kick follows."""
    operations = plan_step(scheme).with_energy().operations
    places = [i for i, operation in enumerate(operations) if isinstance(operation, Energy)]
    if scheme.stages[-1].flow == DRIFT:
        assert not places
        return
    (place,) = places
    assert operations[place - 1].moves_atoms
    assert isinstance(operations[place + 1], Kick)
    assert not any(operation.moves_atoms for operation in operations[place:])


def test_plan_prints_as_the_algorithm():
    assert str(plan_step(SIER2.with_bath(), 1 / 3)).splitlines() == [
        "SIER2, a step h:",
        "update context state",
        "kick 1 by slow forces",
        "drift to bath 0.5, by inner steps e = 1/3 h:",
        "    kick 1 by fast forces",
        "    drift 1",
        "    kick 1 by fast forces",
        "    drift to bath 0.5",
        "bath 1",
        "drift from bath 0.5, by inner steps e = 1/3 h:",
        "    drift from bath 0.5",
        "    kick 1 by fast forces",
        "    drift 1",
        "project momenta",
    ]


def test_what_moves_atoms():
    plan = plan_step(SIER4G, 0.2)
    assert [operation.moves_atoms for operation in plan.operations] == [False, False, True, False, True, False, False]
    assert isinstance(plan.operations[0], UpdateContext)
    (repeated,) = plan.operations[2].operations
    assert isinstance(repeated, Repeat)
    assert repeated.number == 3
    assert repeated.moves_atoms
    assert not Repeat(2, (Kick(1.0),)).moves_atoms


def test_what_cannot_be_planned_is_refused():
    with pytest.raises(ValueError, match="longest inner step"):
        plan_step(SIER4, 0)
    with pytest.raises(ValueError, match="'spin'"):
        plan_step(Scheme("other", ((KICK, 0.5), (DRIFT, 1.0), (KICK, 0.5), ("spin", 1.0))))
