"""Updates: Forces of OpenMM that act between steps change the run as they change the Context.

After a barostat has moved the box the run goes on as one that begins there, and velocities that a thermostat draws are
those of the next step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import openmm
import pytest
from hypothesis import reject
from hypothesis import strategies as st

from tests.laws.actions import assert_drawn
from tests.laws.examples import SIMPLE, WITH_BODIES
from tests.laws.law import Law
from tests.laws.methods import Method, methods
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import SURROUNDINGS, Mixture, is_frozen
from tests.laws.molecules import Ion
from tests.laws.runs import ROUNDING, end, started
from tests.support.faults import lines_run
from tests.support.seeded import seeded

#: Steps from one move of a barostat to the next. A new Context begins to count where it has just acted.
EVERY = 3

#: Moves of a barostat, of which the box has room for all.
MOVES = 6

#: bar: a move to a larger volume is refused.
PRESSURE = 3e4

#: Temperature of a thermostat that draws all velocities, K.
HOT = 1000.0

#: Step in which nothing moves, ps, and the rate at which each atom is hit in it, 1/ps.
INSTANT = 1e-7
HITS = 1e12

#: Barostats that scale the centres of molecules, each with the pressure as arguments.
BAROSTATS = {
    "isotropic": lambda: openmm.MonteCarloBarostat(PRESSURE, 300.0, EVERY),
    "anisotropic": lambda: openmm.MonteCarloAnisotropicBarostat(
        openmm.Vec3(PRESSURE, PRESSURE, PRESSURE), 300.0, True, True, True, EVERY, True
    ),
}


@dataclass(frozen=True)
class Moved:
    """A run in whose System a barostat is, after some of its moves.

    Attributes:
        barostat: name of `BAROSTATS`.
        seed: of the barostat.
    """

    mixture: Mixture
    method: Method
    barostat: str = "isotropic"
    seed: int = 1
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform, [self._force])
        box = run.view().box
        if end(run, MOVES * EVERY) or (run.view().box == box).all():
            reject()
        other = run.at_same_view()
        for each in (run, other):
            each.integrator.step(EVERY - 1)
        run.view().assert_near(other.view(), *ROUNDING[run.method.engine])

    def _force(self) -> openmm.Force:
        return seeded(BAROSTATS[self.barostat](), self.seed)


@dataclass(frozen=True)
class Undone(Moved):
    """An interrupt in a step before which the barostat moved the box: the step is completed, or nothing has moved.

    Attributes:
        line: of the package at which it comes, counted from the beginning of the call.
    """

    line: int = 1

    def check(self) -> None:
        run = started(self.mixture, replace(self.method, engine="exact"), self.platform, [self._force])
        if end(run, 2 * EVERY - 1):
            reject()
        before = run.view()
        lines_run(lambda: run.integrator.step(1), self.line, KeyboardInterrupt)
        after = run.view()
        if after.steps == before.steps:
            after.assert_near(before, 1e-13)


@dataclass(frozen=True)
class Hit:
    """A run without a CMMotionRemover, all of whose atoms a thermostat hits in a step."""

    mixture: Mixture
    method: Method
    seed: int = 1
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method.having(stepSize=INSTANT), self.platform, [self._force])
        before = run.view()
        run.integrator.step(1)
        assert_drawn(run, before, run.view(), HOT)

    def _force(self) -> openmm.Force:
        return seeded(openmm.AndersenThermostat(HOT, HITS), self.seed)


@st.composite
def cases(draw: st.DrawFn, platform: str) -> Moved | Undone | Hit:
    """Draw a mixture and a method without random numbers, whose bodies constraints hold."""
    way = draw(methods(("SIERIntegrator",)))
    seed = draw(st.integers(1, 99))
    if draw(st.sampled_from([False, False, True])):
        return Hit(replace(draw(mixtures(named=False)), remover=0), way, seed, platform)
    mixture = draw(mixtures(SURROUNDINGS[1:], named=False))
    barostat = draw(st.sampled_from(list(BAROSTATS)))
    if is_frozen(mixture) or draw(st.sampled_from([False, False, True])):
        return Undone(mixture, way, barostat, seed, platform, draw(st.integers(1, 300)))
    return Moved(mixture, way, barostat, seed, platform)


LAW = Law("updates", cases, few=8)


@LAW.numbers()
def test_what_forces_do_between_steps_is_there(examples):
    LAW.hold(examples)


@pytest.mark.parametrize("barostat", BAROSTATS)
@pytest.mark.parametrize(("engine", "bodies"), [("exact", "held"), ("native", "held"), ("native", "free")])
def test_forces_follow_the_box(engine, bodies, barostat):
    mixture = replace(WITH_BODIES[bodies], prepared="yes", crossing=True)
    Moved(mixture, replace(SIMPLE[0], engine=engine), barostat).check()


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_velocities_that_are_drawn_are_those_of_the_step(engine):
    Hit(WITH_BODIES["held"], replace(SIMPLE[0], engine=engine)).check()


@pytest.mark.parametrize("line", [60, 105, 150, 200])
def test_a_step_that_is_undone_leaves_no_atom_elsewhere(line):
    Undone(Mixture((Ion(), Ion(frozen=True)), 0, "cut-off"), SIMPLE[0], line=line).check()
