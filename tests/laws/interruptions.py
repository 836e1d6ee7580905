"""Law 5: after errors, signals and interrupts, whoever looks sees a completed step, and the run goes on undisturbed."""

import contextlib
import signal
import threading
from dataclasses import dataclass

import numpy as np
import openmm
from hypothesis import reject
from hypothesis import strategies as st

from tests.laws.runs import REFUSALS, Run, started
from tests.laws.use import assert_alike, end
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


def events(errors):
    """Return a strategy of events: signals and, if `errors`, errors of forces too."""
    forces = st.integers(1, 12)
    signals = st.builds(Event, st.sampled_from(SIGNALS), forces, st.sampled_from(["look", "save", "raise"]))
    return st.one_of(signals, st.builds(Event, st.sampled_from(["error", "nan"]), forces)) if errors else signals


class Probe:
    """A PythonForce that exerts no force, and at one of whose evaluations something happens."""

    def __init__(self, particles):
        self._zeros = np.zeros((particles, 3))
        self._remaining, self._act = 0, None

    def force(self):
        """Return the force for a System."""
        return openmm.PythonForce(self._compute)

    @contextlib.contextmanager
    def armed(self, number, act):
        """Within this, let a function act at an evaluation; the forces there are what it returns, if not None."""
        self._remaining, self._act = number, act
        try:
            yield
        finally:
            self._remaining = 0

    def _compute(self, state):
        self._remaining -= 1
        forces = self._act() if self._remaining == 0 else None
        return 0.0, self._zeros if forces is None else forces


@contextlib.contextmanager
def handling(name, handler):
    """Handle a signal by a function."""
    number = getattr(signal, name)
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


class Undisturbed:
    """The states of an undisturbed run, by step number."""

    def __init__(self, mixture, method):
        probe = Probe(count(mixture))
        self.run = started(mixture, method, forces=[probe.force])
        self.method = self.run.method
        self.states = [self.run.everything()]
        for _ in range(STEPS):
            # A volume move may end a run where the box becomes too small.
            if end(self.run, 1):
                reject()
            self.states.append(self.run.everything())

    def assert_has(self, everything, view, run):
        """The state of a run is that of its step here."""
        assert 0 <= view.steps <= STEPS
        assert_alike(self.method.engine, everything, self.states[view.steps])
        run.assert_rigid(view, 1e-6)


def count(mixture):
    """Number of particles of a mixture."""
    return sum(len(molecule.parts().masses) for molecule in mixture.molecules)


class Observer:
    """Looks at a run from handlers of signals and after errors."""

    def __init__(self, run):
        self._run = run
        self.seen = []
        self.threads = []
        self.checkpoints = []

    def look(self):
        self.threads.append(threading.current_thread())
        self.seen.append((self._run.everything(), self._run.view()))

    def handler(self, reply):
        """Return a handler of signals."""

        def handle(number, frame):
            self.look()
            if reply == "save":
                self.checkpoints.append(self._run.context.createCheckpoint())
            if reply == "raise":
                raise Fault

        return handle


def whoever_looks_sees_a_completed_step(mixture, method, event):
    """Law 5, for signals and errors at a force."""
    undisturbed = Undisturbed(mixture, method)
    probe = Probe(count(mixture))
    run = Run(mixture, undisturbed.method, forces=[probe.force])
    run.integrator.step(0)
    observer = Observer(run)
    is_signal = event.what in SIGNALS

    def act():
        if is_signal:
            signal.raise_signal(getattr(signal, event.what))
        elif event.what == "error":
            raise Fault
        return np.full((count(mixture), 3), np.nan) if event.what == "nan" else None

    handled = handling(event.what, observer.handler(event.reply)) if is_signal else contextlib.nullcontext()
    with handled, probe.armed(event.force, act):
        try:
            run.integrator.step(DISTURBED)
        except (Fault, *REFUSALS):
            observer.look()
    for everything, view in observer.seen:
        undisturbed.assert_has(everything, view, run)
    run.integrator.step(STEPS - run.view().steps)
    undisturbed.assert_has(run.everything(), run.view(), run)
    for checkpoint in observer.checkpoints:
        other = Run(mixture, undisturbed.method, forces=[Probe(count(mixture)).force])
        other.context.loadCheckpoint(checkpoint)
        other.integrator.step(STEPS - other.view().steps)
        undisturbed.assert_has(other.everything(), other.view(), other)


def an_interrupt_at_any_line_leaves_a_completed_step(mixture, method, line):
    """Law 5, for a KeyboardInterrupt at a line of the package."""
    undisturbed = Undisturbed(mixture, method)
    run = Run(mixture, undisturbed.method, forces=[Probe(count(mixture)).force])
    run.integrator.step(0)
    lines_run(lambda: run.integrator.step(2), line, KeyboardInterrupt)
    undisturbed.assert_has(run.everything(), run.view(), run)
    run.integrator.step(STEPS - run.view().steps)
    undisturbed.assert_has(run.everything(), run.view(), run)


def handlers_are_called_by_the_main_thread(mixture, method, event):
    """Law 5: where another thread makes steps of another Context while a signal waits."""
    probe = Probe(count(mixture))
    run = started(mixture, method, forces=[probe.force])
    other = Run(mixture, run.method, forces=[Probe(count(mixture)).force])
    other.integrator.step(0)
    observer = Observer(run)

    def act():
        signal.raise_signal(getattr(signal, event.what))
        thread = threading.Thread(target=other.integrator.step, args=(2,))
        thread.start()
        thread.join(60)

    with handling(event.what, observer.handler("look")), probe.armed(event.force, act):
        run.integrator.step(DISTURBED)
    assert {thread.name for thread in observer.threads} <= {threading.main_thread().name}
