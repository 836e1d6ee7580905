"""Signals wait for the end of a step, in whatever moment they come."""

import _signal
import signal

import numpy as np
import openmm
import pytest

from openmm_sier.engines import interrupts
from tests.loops import interrupts as loop
from tests.support.faults import deferred
from tests.support.matrices import representatives

#: Signals with a handler in Python.
HANDLED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


@pytest.fixture
def handled():
    """Handlers in Python for some signals, which raise KeyboardInterrupt, and those of before at the end."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in HANDLED}
    yield before
    for number, handler in before.items():
        signal.signal(number, handler)
    interrupts._deferred.clear()
    interrupts.pending.clear()


def deferring():
    """Whether a signal waits for the end of a block, and comes then."""
    reached = False
    try:
        with deferred():
            signal.raise_signal(signal.SIGINT)
            reached = True
    except KeyboardInterrupt:
        return reached
    return False


@pytest.mark.parametrize("number", range(1, 2 * len(HANDLED) + 1))
@pytest.mark.parametrize("which", HANDLED)
def test_a_signal_while_handlers_change_leaves_them_in_place(handled, monkeypatch, which, number):
    """All are replaced at the beginning of a block and put back at its end; a signal comes right after one change."""
    assert deferring()
    calls, change = 0, _signal.signal

    def interrupted(changed, handler):
        nonlocal calls
        results, calls = change(changed, handler), calls + 1
        if calls == number:
            signal.raise_signal(which)
        return results

    with monkeypatch.context() as patched:
        patched.setattr(_signal, "signal", interrupted)
        with pytest.raises(KeyboardInterrupt), deferred():
            pass
    assert calls >= 2 * len(HANDLED) or number < len(HANDLED)
    assert {signal.getsignal(each) for each in HANDLED} == {signal.default_int_handler}
    assert deferring()


#: Ctrl-C, and signals of batch systems, of terminals, of users and of clocks.
KINDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGALRM)

#: What engines ask of OpenMM in the middle of steps.
MOMENTS = ((openmm.Context, "getState"), (openmm.Context, "setPositions"), (openmm.CustomIntegrator, "step"))


@pytest.fixture
def at_moments(monkeypatch):
    """A function that has another one called at the next of the moments in the middle of steps."""
    waiting = []

    def watched(method):
        def wrapper(*args, **kwargs):
            if waiting:
                waiting.pop()()
            return method(*args, **kwargs)

        return wrapper

    for cls, name in MOMENTS:
        monkeypatch.setattr(cls, name, watched(getattr(cls, name)))
    return waiting.append


@pytest.fixture
def handle():
    """A function that gives all kinds of signals a handler; those of before are put back at the end."""
    before = {kind: signal.getsignal(kind) for kind in KINDS}
    yield lambda handler: [signal.signal(kind, handler) for kind in KINDS]
    for kind, handler in before.items():
        signal.signal(kind, handler)


@pytest.fixture(scope="module")
def start():
    return loop.start_of(SETTINGS)


SETTINGS = loop.InterruptSettings()


@pytest.mark.parametrize("engine", loop.ENGINES)
def test_handlers_that_raise_take_no_signal_from_others(engine, start, at_moments, handle):
    """The Context is at a completed step, and the run goes on as if there had been none."""
    context, found = loop.begun("langevin", engine, start, SETTINGS), []

    def fail(number, _frame):
        found.append((number, context.getStepCount()))
        raise KeyboardInterrupt

    handle(fail)
    at_moments(lambda: [signal.raise_signal(kind) for kind in KINDS])
    with pytest.raises(KeyboardInterrupt):
        context.getIntegrator().step(20)
    steps = context.getStepCount()
    assert steps < 21
    assert [number for number, _ in found] == list(KINDS)
    assert {step for _, step in found} == {steps}
    context.getIntegrator().step(21 - steps)
    undisturbed = loop.begun("langevin", engine, start, SETTINGS)
    undisturbed.getIntegrator().step(20)
    assert np.array_equal(loop.place(context), loop.place(undisturbed))


def test_nothing_is_saved_between_two_steps(start, at_moments):
    """A handler in the main thread would save a mixture of two steps of another thread's run."""
    context, errors = loop.begun("langevin", "exact", start, SETTINGS), []

    def save():
        try:
            context.createCheckpoint()
        except openmm.OpenMMException as error:
            errors.append(str(error))

    at_moments(save)
    context.getIntegrator().step(2)
    assert "is between two steps" in errors[0]
    context.createCheckpoint()


@pytest.mark.parametrize("run", representatives(["langevin", "pressure", "barostat", "hmc"], "langevin"))
def test_interrupts_at_random_moments_leave_no_trace(run, tmp_path):
    """Each leaves a completed step of the run that nothing disturbed. `python -m tests.loops.interrupts` makes 2000."""
    rows = loop.study(loop.InterruptSettings(interrupts=20, runs=(run,), out=tmp_path))
    assert [row["engine"] for row in rows] == ["exact", "native"]
    assert all(row["steps"] > 20 for row in rows)
