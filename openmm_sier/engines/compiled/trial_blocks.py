"""The blocks of a program besides a step, as parts: the sum of the motion, and trials of hybrid Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

from openmm_sier.dynamics.plan import FAST, SLOW
from openmm_sier.engines.compiled.movers import CHANGE, DRAW, GO_BACK, START, SUM_END, Call
from openmm_sier.engines.compiled.writing import NOTHING, REORDER, RESTORED, Part, Trajectory

#: Numbers of blocks: a step, and the sum of the motion of all that moves; of trials energies, drawn velocities; of a
#: trajectory the first part, with the start of a trial and without, what is repeated, and the end; other velocities,
#: and the way back.
STEP, SUMMED, ENERGY, DRAWN, STARTED, GONE_ON, BETWEEN, ENDED, CHANGED, GONE_BACK = range(10)

#: The sum of the motion.
SUM = (Part(NOTHING, [Call(SUM_END)], [Call(SUM_END)]),)


def trial_blocks(trajectory: Trajectory, has_fast: bool) -> tuple[list[Part], ...]:
    """Return the blocks of trials.

    Args:
        trajectory: of a trial.
        has_fast: whether there are fast forces.
    """
    energies = [Part(FAST, wants_energy=True)] if has_fast else []
    # Those of the start come back with it.
    has_forces = trajectory.first[0].begins_with == SLOW
    forces = [Part(SLOW)] if has_forces else []
    restored = [Part(RESTORED)] if has_forces else []
    start, *rest = trajectory.first
    started = replace(start, members=[Call(START), *start.members], others=[Call(START), *start.others])
    last = trajectory.last if trajectory.last[-1].begins_with != FAST else [*trajectory.last, Part(NOTHING)]
    *before, end = last
    ended = replace(end, members=[*end.members, Call(SUM_END)], others=[*end.others, Call(SUM_END)])
    return (
        [*energies, Part(SLOW, wants_energy=True)],
        [Part(REORDER), _of_all(DRAW), *forces],
        [started, *rest],
        trajectory.first,
        trajectory.between,
        [*before, ended],
        [_of_all(CHANGE)],
        [_of_all(GO_BACK), *restored],
    )


def _of_all(kind: str) -> Part:
    """Return the part in which all movers do one thing."""
    return Part(NOTHING, [Call(kind)], [Call(kind)])
