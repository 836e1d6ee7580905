"""The future depends on what is visible, and a restart has the same bits."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import openmm
import pytest
from hypothesis import strategies as st

from openmm_sier.engines.snapshot import HOST_PLATFORMS
from tests.laws.action_strategies import pasts, several
from tests.laws.actions import Action, Load, Save, Step
from tests.laws.examples import EVERY_CHANGE, SIMPLE, WITH_BODIES
from tests.laws.law import Law
from tests.laws.methods import Method, methods
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import Mixture
from tests.laws.runs import ROUNDING, Run, assert_alike, started


@dataclass(frozen=True)
class Future:
    """A run at constant energy, and a new Context with the same positions, velocities, box, parameters and clock.

    Attributes:
        misplaced: whether virtual sites are set to other places there, which no step may read.
    """

    mixture: Mixture
    method: Method
    past: tuple[Action, ...]
    future: tuple[Action, ...]
    platform: str = "Reference"
    misplaced: bool = False

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        for action in self.past:
            followed(run, action)
        other = run.at_same_view()
        if self.misplaced:
            positions = run.view().positions
            positions[run.sites] += 0.05
            other.context.setPositions(positions)
        other.saved = list(run.saved)
        for action in (*self.future, Step(2)):
            refusals = followed(run, action), followed(other, action)
            assert refusals[0] == refusals[1], f"{action}: {refusals[0]} in place of {refusals[1]}"
            run.view().assert_near(other.view(), *ROUNDING[run.method.engine])


@dataclass(frozen=True)
class Restart:
    """A run, and a restart of it in a new Context.

    Attributes:
        way: "checkpoint", "State" or "XML", which is that of a State.
        by: the origin of the new integrator: "settings", "copy" or "XML".
        aged: whether the new Context makes a step before; a State brings back no noise that it has used.
    """

    mixture: Mixture
    method: Method
    past: tuple[Action, ...]
    way: str
    by: str
    aged: bool
    future: tuple[Action, ...]
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        for action in self.past:
            followed(run, action)
        if run.method.is_random:
            # So that noise was used. A checkpoint from before the first noise does not bring back OpenMM's generator of
            # the Reference and CPU platforms, which other Contexts share.
            followed(run, Step(1))
        again = self.restarted(run)
        future = (*self.future, Step(2))
        refusals = [followed(run, action) for action in future]
        other = again()
        expected = [followed(other, action) for action in future]
        assert refusals == expected, f"{refusals} in place of {expected} after a restart"
        assert_alike(run.everything(), other.everything(), *self._tolerances(run.method))

    def _tolerances(self, method: Method) -> tuple[float, float]:
        """Return those of positions and velocities: GPU platforms round where they box molecules of a State."""
        is_exact = self.platform in HOST_PLATFORMS or self.way == "checkpoint"
        return (0.0, 0.0) if is_exact else ROUNDING[method.engine]

    def restarted(self, run: Run) -> Callable[[], Run]:
        """Save a run here, and return a function that restarts it."""
        # OpenMM's noise is only in checkpoints.
        load = run.save("checkpoint" if run.method.draws_from_openmm else self.way)
        saved, settings = list(run.saved), list(run.settings)
        system = openmm.XmlSerializer.clone(run.system)
        copied, written = copy.deepcopy(run.integrator), openmm.XmlSerializer.serialize(run.integrator)
        makers = {
            "settings": lambda: run.method.make(run.built.bodies, settings),
            "copy": lambda: copied,
            "XML": lambda: openmm.XmlSerializer.deserialize(written),
        }

        def again() -> Run:
            other = run.continued(system, makers[self.by](), settings, saved)
            if self.aged and (self.way == "checkpoint" or not run.method.is_random):
                other.context.setPositions(run.start)
                other.context.setVelocities(run.built.velocities)
                followed(other, Step(1))
            load(other.context)
            return other

        return again


def followed(run: Run, action: Action) -> str | None:
    """Do an action; return the kind of refusal, if it is refused."""
    if not action.applies(run):
        return None
    try:
        action.act(run)
    except action.refusals as error:
        return type(error).__name__
    return None


@st.composite
def futures(draw: st.DrawFn, platform: str) -> Future:
    method = draw(methods(("SIERIntegrator",)))
    return Future(draw(mixtures()), method, draw(pasts(method.kind)), draw(several(method.kind)), platform)


@st.composite
def restarts(draw: st.DrawFn, platform: str) -> Restart:
    method = draw(methods())
    # A seed is for the next Context, and so for a restart from a State.
    past = tuple(action for action in draw(pasts(method.kind)) if getattr(action, "name", "") != "setRandomNumberSeed")
    way, by = draw(st.sampled_from(["checkpoint", "State", "XML"])), draw(st.sampled_from(["settings", "copy", "XML"]))
    return Restart(draw(mixtures()), method, past, way, by, draw(st.booleans()), draw(several(method.kind)), platform)


#: A method whose step begins with the forces of the end of the last one.
REUSING = SIMPLE[0].having(scheme="SIER2V2")

FUTURES = Law("futures", futures, few=15)
RESTARTS = Law("restarts", restarts, few=15)


@FUTURES.numbers()
def test_the_future_depends_on_what_is_visible(examples):
    FUTURES.hold(examples)


@pytest.mark.parametrize(("engine", "bodies"), [("exact", "named"), ("native", "held"), ("native", "free")])
def test_the_future_depends_on_what_is_visible_after_each_change(engine, bodies):
    for change in EVERY_CHANGE:
        if not isinstance(change, (Save, Load)):
            Future(WITH_BODIES[bodies], replace(REUSING, engine=engine), (Step(2), change), (), misplaced=True).check()


@pytest.mark.parametrize("way", ["checkpoint", "State", "XML"])
@pytest.mark.parametrize("simple", [SIMPLE[1], SIMPLE[3], SIMPLE[4]], ids=lambda simple: simple.kind)
def test_a_restart_of_each_kind_goes_on_the_same(simple, way):
    method = simple.having(pressure=1e3, barostatInterval=1)
    Restart(WITH_BODIES["named"], method, (Step(3),), way, "settings", False, ()).check()


@RESTARTS.numbers()
def test_a_restart_goes_on_the_same(examples):
    RESTARTS.hold(examples)


@RESTARTS.numbers()
def test_a_restart_goes_on_the_same_on_the_cpu_platform(examples):
    RESTARTS.hold(max(4, examples // 5), "CPU")
