"""Completed steps: after errors, signals and interrupts whoever looks sees one, and the run goes on undisturbed."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import openmm
import pytest
from hypothesis import reject
from hypothesis import strategies as st

from openmm_sier.engines.snapshot import HOST_PLATFORMS
from tests.laws.law import Law
from tests.laws.mechanics import centre_of
from tests.laws.methods import Method, method, methods
from tests.laws.mixture_strategies import mixtures, moved
from tests.laws.mixtures import Mixture
from tests.laws.molecules import Body, Water
from tests.laws.runs import REFUSALS, SAME, WITH_ANOTHER_LIST, Run, View, assert_alike, end, started
from tests.support.faults import Fault, lines_run

#: Signals that a program may handle.
SIGNALS = [name for name in ("SIGTERM", "SIGUSR1", "SIGINT", "SIGHUP", "SIGUSR2", "SIGALRM") if hasattr(signal, name)]

#: Number of steps of an undisturbed run, and of the call that is disturbed.
STEPS, DISTURBED = 6, 4


@dataclass(frozen=True)
class Event:
    """Something that happens during a call of `step`.

    Attributes:
        what: name of a signal, "error" or "nan".
        force: number of the force evaluation, from 1, at which it happens.
        reply: of the handler of a signal: "look", "save" or "raise".
    """

    what: str
    force: int
    reply: str = "look"


class Probe:
    """A PythonForce that exerts no force, and at one of whose evaluations something happens."""

    def __init__(self, particles: int):
        self._zeros = np.zeros((particles, 3))
        self._remaining = 0
        self._act = None

    def force(self) -> openmm.PythonForce:
        """Return the force for a System."""
        return openmm.PythonForce(self._compute)

    @contextlib.contextmanager
    def armed(self, number: int, act: Callable[[], np.ndarray | None]) -> Iterator[None]:
        """Within this, let a function act at an evaluation; the forces there are what it returns, if not None."""
        self._remaining = number
        self._act = act
        try:
            yield
        finally:
            self._remaining = 0

    def _compute(self, state: openmm.State) -> tuple[float, np.ndarray]:
        self._remaining -= 1
        forces = self._act() if self._remaining == 0 else None
        return 0.0, self._zeros if forces is None else forces


@contextlib.contextmanager
def handling(name: str, handler: Callable) -> Iterator[None]:
    """Handle a signal by a function."""
    number = getattr(signal, name)
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


class Undisturbed:
    """The states of an undisturbed run, by step number."""

    def __init__(self, mixture: Mixture, method: Method, platform: str):
        self.run = started(mixture, method, platform, forces=[Probe(count(mixture)).force])
        self.method = self.run.method
        self.tolerances = SAME[self.method.engine]
        self.states = [self.run.everything()]
        for _ in range(STEPS):
            # A volume move may end a run where the box becomes too small.
            if end(self.run, 1):
                reject()
            self.states.append(self.run.everything())

    def assert_has(self, everything: tuple, view: View, run: Run) -> None:
        """The state of a run is that of its step here."""
        assert 0 <= view.steps <= STEPS, f"step {view.steps}"
        assert_alike(everything, self.states[view.steps], *self.tolerances)
        run.assert_rigid(view, 1e-6)

    def assert_ends(self, run: Run) -> None:
        """A run that goes on to the last step is there the same."""
        run.integrator.step(STEPS - run.view().steps)
        self.assert_has(run.everything(), run.view(), run)


def count(mixture: Mixture) -> int:
    """Return the number of particles of a mixture."""
    return sum(len(molecule.parts().masses) for molecule in mixture.molecules)


def probed(mixture: Mixture, method: Method, platform: str) -> tuple[Run, Probe]:
    """Return a run that is ready to make steps, and the probe in it."""
    probe = Probe(count(mixture))
    run = Run(mixture, method, platform, forces=[probe.force])
    run.integrator.step(0)
    return run, probe


class Observer:
    """Looks at a run from handlers of signals and after errors."""

    def __init__(self, run: Run):
        self._run = run
        self.seen = []
        self.threads = []
        self.checkpoints = []

    def look(self) -> None:
        self.threads.append(threading.current_thread())
        self.seen.append((self._run.everything(), self._run.view()))

    def handler(self, reply: str) -> Callable:
        """Return a handler of signals."""

        def handle(number, frame):
            self.look()
            if reply == "save":
                self.checkpoints.append(self._run.context.createCheckpoint())
            if reply == "raise":
                raise Fault

        return handle


@dataclass(frozen=True)
class Interruption:
    """A signal, an error or a force that is not finite at a force evaluation."""

    mixture: Mixture
    method: Method
    event: Event
    platform: str = "Reference"

    def check(self) -> None:
        event = self.event
        if event.what not in SIGNALS and self.method.engine != "exact":
            # OpenMM's own steps are left where an error occurred.
            reject()
        undisturbed = Undisturbed(self.mixture, self.method, self.platform)
        if self.platform == "CPU":
            # Checkpoints and steps that are undone leave another past, on which the last bits of forces depend there.
            undisturbed.tolerances = WITH_ANOTHER_LIST
        run, probe = probed(self.mixture, undisturbed.method, self.platform)
        observer = Observer(run)
        is_signal = event.what in SIGNALS

        def act() -> np.ndarray | None:
            if is_signal:
                signal.raise_signal(getattr(signal, event.what))
            elif event.what == "error":
                raise Fault
            return np.full((count(self.mixture), 3), np.nan) if event.what == "nan" else None

        handled = handling(event.what, observer.handler(event.reply)) if is_signal else contextlib.nullcontext()
        with handled, probe.armed(event.force, act):
            try:
                run.integrator.step(DISTURBED)
            except (Fault, *REFUSALS):
                observer.look()
        for everything, view in observer.seen:
            undisturbed.assert_has(everything, view, run)
        undisturbed.assert_ends(run)
        for checkpoint in observer.checkpoints:
            other, _ = probed(self.mixture, undisturbed.method, self.platform)
            other.context.loadCheckpoint(checkpoint)
            undisturbed.assert_ends(other)


@dataclass(frozen=True)
class Interrupt:
    """A KeyboardInterrupt at a line of the package, counted from the beginning of a call of `step`."""

    mixture: Mixture
    method: Method
    line: int
    platform: str = "Reference"

    def check(self) -> None:
        if self.method.engine != "exact":
            reject()
        undisturbed = Undisturbed(self.mixture, self.method, self.platform)
        run, _ = probed(self.mixture, undisturbed.method, self.platform)
        lines_run(lambda: run.integrator.step(2), self.line, KeyboardInterrupt)
        undisturbed.assert_has(run.everything(), run.view(), run)
        undisturbed.assert_ends(run)


@dataclass(frozen=True)
class Threads:
    """A signal while the main thread makes steps, before another thread makes some in another Context."""

    mixture: Mixture
    method: Method
    event: Event
    platform: str = "Reference"

    def check(self) -> None:
        method = started(self.mixture, self.method, self.platform).method
        run, probe = probed(self.mixture, method, self.platform)
        other, _ = probed(self.mixture, method, self.platform)
        observer = Observer(run)

        def act() -> None:
            signal.raise_signal(getattr(signal, self.event.what))
            thread = threading.Thread(target=end, args=(other, 2))
            thread.start()
            thread.join(60)

        with handling(self.event.what, observer.handler("look")), probe.armed(self.event.force, act):
            # A volume move may end a run where the box becomes too small.
            if end(run, DISTURBED):
                reject()
        found = {thread.name for thread in observer.threads} - {threading.main_thread().name}
        assert not found, f"the handler was called by {found}"


@dataclass(frozen=True)
class Rejection:
    """A force that is not finite within a trial, and an energy that is not finite where one begins.

    The first rejects the trial, at a sample. The second is an error that changes nothing.

    Attributes:
        force: number of the force evaluation, from 1, after a first trial.
    """

    mixture: Mixture
    method: Method
    force: int
    platform: str = "Reference"

    def check(self) -> None:
        method = started(self.mixture, self.method, self.platform).method
        run, probe = probed(self.mixture, method, self.platform)
        # A volume move may end a run where the box becomes too small.
        if end(run, 1):
            reject()
        lost = np.full((count(self.mixture), 3), np.nan)
        with probe.armed(self.force, lambda: lost):
            if end(run, 2):
                # Forces are computed at the start too, after a change.
                reject()
        view = run.view()
        assert view.steps == run.integrator.trials == 3, f"{run.integrator.trials} trials in {view.steps} steps"
        assert np.isfinite(run.potential_energy())
        run.assert_rigid(view, 1e-6)
        if self.mixture.remover:
            velocity = centre_of(run.masses, view.velocities)
            assert np.abs(velocity).max() < 1e-9, f"the centre of mass moves with {velocity} nm/ps"
        before = run.everything()
        run.context.setParameter("pull", np.nan)
        assert end(run, 1), "a trial began where the energy is not finite"
        run.context.setParameter("pull", view.parameters["pull"])
        # The error of the rejected trial is infinite.
        changed = [k for k, pair in enumerate(zip(run.everything(), before, strict=True)) if not np.array_equal(*pair)]
        assert not changed, f"numbers {changed} of all changed in a trial that was refused"


# --- strategies -------------------------------------------------------------------------------------------------------

forces = st.integers(1, 12)
signals = st.builds(Event, st.sampled_from(SIGNALS), forces, st.sampled_from(["look", "save", "raise"]))
faults = st.builds(Event, st.sampled_from(["error", "nan"]), forces)


@st.composite
def interruptions(draw: st.DrawFn, platform: str) -> Interruption:
    mixture, method = draw(moved(methods()))
    event = draw(st.one_of(signals, faults))
    if event.what not in SIGNALS:
        # OpenMM's own steps are left where an error occurred.
        method = dataclasses.replace(method, engine="exact")
    if event.what == "nan" and (method.kind == "SIERHMCIntegrator" or platform not in HOST_PLATFORMS):
        # A trial is rejected, and the run is another one. GPU platforms sum forces in fixed point, where NaN is -2^31.
        event = dataclasses.replace(event, what="error")
    return Interruption(mixture, method, event, platform)


def interrupts(platform: str) -> st.SearchStrategy[Interrupt]:
    # OpenMM's own steps are left where an error occurred.
    exact = methods().map(lambda method: dataclasses.replace(method, engine="exact"))
    return st.builds(Interrupt, mixtures(), exact, st.integers(1, 300), st.just(platform))


def of_threads(platform: str) -> st.SearchStrategy[Threads]:
    return st.builds(Threads, mixtures(), methods(), signals, st.just(platform))


def rejections(platform: str) -> st.SearchStrategy[Rejection]:
    rest = st.integers(1, 6), st.just(platform)
    trials = moved(methods(("SIERHMCIntegrator",)))
    return trials.flatmap(lambda drawn: st.builds(Rejection, *map(st.just, drawn), *rest))


#: Methods whose forces come after a bath, a move or a draw in each step.
WAYS = [
    method("SIERLangevinIntegrator", temperature=300.0, frictionCoeff=5.0, scheme="SIER4G", stepSize=0.001),
    method("SIERHMCIntegrator", temperature=300.0, scheme="SIER4G", schemeStepSize=0.001, stepsPerTrial=1),
    method(
        "SIERThermostatIntegrator",
        temperature=300.0,
        rate=50.0,
        every=1,
        pressure=1e3,
        barostatInterval=1,
        scheme="SIER4G",
        stepSize=0.001,
    ),
]

INTERRUPTIONS = Law("interruptions", interruptions, few=15)
INTERRUPTS = Law("interrupts", interrupts, few=6)
THREADS = Law("threads", of_threads, few=4)
REJECTIONS = Law("rejections", rejections, few=8)


@INTERRUPTIONS.numbers()
def test_whoever_looks_sees_a_completed_step(examples):
    INTERRUPTIONS.hold(examples)


@pytest.mark.parametrize("number", [2, 5])
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.kind)
def test_an_error_leaves_a_completed_step(way, number):
    Interruption(Mixture((Water(), Body("bent")), surroundings="cut-off"), way, Event("error", number)).check()


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.kind)
def test_an_energy_that_is_not_finite_changes_nothing(way):
    """No PythonForce is there, which lets each step be one transaction."""
    runs = [Run(Mixture((Water(), Body("bent")), surroundings="cut-off"), way) for _ in range(2)]
    for run in runs:
        run.integrator.step(1)
    runs[0].context.setParameter("pull", np.nan)
    assert end(runs[0], 1), "a step was made where forces are not finite"
    runs[0].context.setParameter("pull", runs[1].view().parameters["pull"])
    for run in runs:
        run.integrator.step(2)
    assert_alike(runs[0].everything(), runs[1].everything())


@INTERRUPTS.numbers()
def test_an_interrupt_at_any_line_leaves_a_completed_step(examples):
    INTERRUPTS.hold(examples)


@THREADS.numbers()
def test_handlers_are_called_by_the_main_thread(examples):
    THREADS.hold(examples)


@REJECTIONS.numbers()
def test_what_is_not_finite_rejects_a_trial_or_is_refused(examples):
    REJECTIONS.hold(examples)
