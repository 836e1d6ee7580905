"""Signals wait for the end of a step, in whatever moment they come."""

import _signal
import signal

import pytest

from openmm_sier.engines import interrupts
from tests.loops import interrupts as loop
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
        with interrupts.deferred():
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
        with pytest.raises(KeyboardInterrupt), interrupts.deferred():
            pass
    assert calls >= 2 * len(HANDLED) or number < len(HANDLED)
    assert {signal.getsignal(each) for each in HANDLED} == {signal.default_int_handler}
    assert deferring()


@pytest.mark.parametrize("run", representatives(["langevin", "pressure", "barostat", "hmc"], "langevin"))
def test_interrupts_at_random_moments_leave_no_trace(run, tmp_path):
    """Each leaves a completed step of the run that nothing disturbed. `python -m tests.loops.interrupts` makes 2000."""
    rows = loop.study(loop.InterruptSettings(interrupts=20, runs=(run,), out=tmp_path))
    assert [row["engine"] for row in rows] == ["exact", "native"]
    assert all(row["steps"] > 20 for row in rows)
