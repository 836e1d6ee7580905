"""Requests: what is asked for is there, and questions and refusals change nothing, now and later."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import reject
from hypothesis import strategies as st

from tests.laws.action_strategies import actions, setters_of
from tests.laws.actions import Action, Minimize, Step
from tests.laws.examples import EVERY_CHANGE, SIMPLE, WITH_BODIES
from tests.laws.integrator_actions import QUESTIONS, Ask, Set, questions, setters, values_of
from tests.laws.law import Law
from tests.laws.methods import Method, methods
from tests.laws.mixture_strategies import mixtures, moved
from tests.laws.mixtures import Mixture
from tests.laws.molecules import Water
from tests.laws.runs import (
    MINIMIZED_WITH_ANOTHER_LIST,
    REFUSALS,
    SAME,
    WITH_ANOTHER_LIST,
    Run,
    assert_alike,
    end,
    started,
)


@dataclass(frozen=True)
class Requests:
    """Actions in a Context, each of which must show, and the same without questions and without what was refused."""

    mixture: Mixture
    method: Method
    asked: tuple[Action, ...]
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        done = [action for action in self.asked if tried(run, action)]
        error = end(run)
        twin = Run(self.mixture, run.method, self.platform)
        twin.integrator.step(0)
        for action in done:
            if action.changes:
                action.act(twin)
        expected = end(twin)
        assert error == expected, f"{error} in place of {expected} without questions and without what was refused"
        assert_alike(run.everything(), twin.everything(), *self._tolerances())

    def _tolerances(self) -> tuple[float, float]:
        """Return those of positions and velocities: questions leave another list of neighbours on the CPU platform."""
        if self.platform != "CPU":
            return 0.0, 0.0
        minimizes = any(isinstance(action, Minimize) for action in self.asked)
        return MINIMIZED_WITH_ANOTHER_LIST if minimizes else WITH_ANOTHER_LIST


def tried(run: Run, action: Action) -> bool:
    """Do an action and assert that it shows; return whether it was done, and not refused."""
    if not action.applies(run):
        return False
    before = run.view()
    try:
        action.act(run)
    except action.refusals:
        # A step that fails may come after others that were completed.
        if not isinstance(action, Step):
            run.view().assert_near(before, 0)
        return isinstance(action, Step)
    action.shows(run, before, run.view())
    return True


@dataclass(frozen=True)
class Setting:
    """A setter of a bound integrator, and the constructor's argument: both give the same run, or are refused.

    Attributes:
        aged: whether steps were made before, and undone by a checkpoint.
        loaded: whether a checkpoint of before the setter is loaded after it, which brings back no setting.
    """

    mixture: Mixture
    method: Method
    setting: Set
    aged: bool = False
    platform: str = "Reference"
    loaded: bool = False

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        # A checkpoint from before the first noise does not bring back the generator of the Reference and CPU platforms.
        if self.aged and not run.method.draws_from_openmm:
            start = run.context.createCheckpoint()
            end(run)
            run.context.loadCheckpoint(start)
        before = run.context.createCheckpoint()
        is_accepted = tried(run, self.setting)
        if not is_accepted and run.method.engine == "kernels":
            # Its program is written for a Context, and may not follow another setting there.
            reject()
        if self.loaded:
            run.context.loadCheckpoint(before)
        found = outcome(run) if is_accepted else None
        for other, settings in self.others(run.method):
            try:
                expected = outcome(Run(self.mixture, other, self.platform, settings))
            except REFUSALS:
                expected = None
            refused = ["accepted" if result else "refused" for result in (found, expected)]
            assert refused[0] == refused[1], f"the setter is {refused[0]}, and {settings or other} is {refused[1]}"
            if found is not None:
                assert_alike(found, expected, *SAME[other.engine])

    def check_effect(self) -> None:
        """Assert that a setter that is accepted changes a run."""
        run = started(self.mixture, self.method, self.platform)
        if tried(run, self.setting):
            found, unchanged = outcome(run), outcome(run.twin(()))
            assert not np.array_equal(found[0], unchanged[0]), f"{self.setting} changes no positions"

    def others(self, method: Method) -> list[tuple[Method, list]]:
        """Return methods and earlier settings that give the same integrator."""
        # A seed is for the next Context.
        settings = [] if self.setting.name == "setRandomNumberSeed" else [self.setting]
        argument = argument_of(method, self.setting.name)
        # An integrator that was made without a pressure keeps its volume.
        if argument == "pressure" and method.get("pressure") is None:
            return [(method, settings)]
        by_argument = [] if argument is None else [(method.having(**{argument: self.setting.value}), [])]
        return [(method, settings), *by_argument]


def argument_of(method: Method, setter: str) -> str | None:
    """Return the name of the constructor's argument that a setter sets; None if there is none."""
    name = setter[3].lower() + setter[4:]
    names = [*inspect.signature(method.cls).parameters, *dict(method.arguments)]
    return next((argument for argument in names if argument.startswith(name)), None)


def outcome(run: Run) -> tuple | None:
    """Return all that a run is after some steps, or None if they are refused."""
    return None if end(run, 3) else run.everything()


@st.composite
def requests(draw: st.DrawFn, platform: str) -> Requests:
    method = draw(methods())
    return Requests(draw(mixtures()), method, draw(actions(method.kind)), platform)


def settings(platform: str) -> st.SearchStrategy[Setting]:
    return moved(methods()).flatmap(
        lambda drawn: st.builds(
            Setting, *map(st.just, drawn), setters_of(drawn[1].kind), st.booleans(), st.just(platform), st.booleans()
        )
    )


#: Setters that change a short run of a molecule of water only where they happen to: noise of the next Context, another
#: rounding, groups without forces, and chances of a trial that is accepted.
WITHOUT_EFFECT = (
    "setRandomNumberSeed",
    "setConstraintTolerance",
    "setIntegrationForceGroups",
    "setExtraChances",
    "setBarostatInterval",
)

#: Methods and arguments without setters, which change a run of `WITH_BODIES`.
ARGUMENTS = [
    (SIMPLE[0], {"scheme": "SIER2"}),
    (SIMPLE[0], {"substeps": 3}),
    (SIMPLE[2], {"rotationalFriction": 20.0}),
    (SIMPLE[4], {"rate": 50.0}),
    (SIMPLE[4], {"every": 2}),
    (SIMPLE[4], {"pressure": 1e3, "barostatInterval": 1}),
]

REQUESTS = Law("requests", requests, few=15)
SETTINGS = Law("settings", settings, few=5)


@REQUESTS.numbers()
def test_what_is_asked_for_is_there(examples):
    REQUESTS.hold(examples)


@pytest.mark.parametrize(("engine", "bodies"), [("exact", "named"), ("exact", "held"), ("native", "held")])
def test_every_change_shows_between_steps(engine, bodies):
    asked = tuple(action for change in EVERY_CHANGE for action in (Step(2), change))
    asked += tuple(Ask(name) for name in (*QUESTIONS, *questions(SIMPLE[0].cls)))
    # A CMMotionRemover acts in some of these steps.
    Requests(replace(WITH_BODIES[bodies], remover=3), replace(SIMPLE[0], engine=engine), asked).check()


@pytest.mark.parametrize("engine", ["exact", "native"])
@pytest.mark.parametrize("simple", SIMPLE, ids=lambda simple: simple.kind)
def test_every_setter_does_what_the_argument_does(simple, engine):
    for name in setters(simple.cls):
        setting = Setting(Mixture((Water(),)), replace(simple, engine=engine), Set(name, values_of(name)[0]), True)
        setting.check()
        replace(setting, aged=False, loaded=True).check()
        if name not in WITHOUT_EFFECT:
            setting.check_effect()


@pytest.mark.parametrize(("plain", "arguments"), ARGUMENTS, ids=lambda each: str(each)[:24])
def test_every_argument_changes_a_run(plain, arguments):
    runs = [outcome(Run(WITH_BODIES["named"], each)) for each in (plain, plain.having(**arguments))]
    assert not np.array_equal(runs[0][0], runs[1][0])


@SETTINGS.numbers()
def test_a_setter_does_what_the_argument_does(examples):
    SETTINGS.hold(examples)
