"""Errors and interrupts at any line of the package."""

import pathlib
import sys
from contextlib import contextmanager

import openmm_sier
from openmm_sier.engines import interrupts

PACKAGE = str(pathlib.Path(openmm_sier.__file__).parent)

#: What replaces the handlers of signals, which `tests/engines/test_interrupts.py` interrupts.
HANDLERS = interrupts.__file__


class Fault(Exception):
    """Like Ctrl-C, or an error of the machine, it may come at any line."""


@contextmanager
def deferred():
    """Let signals wait until the end of the block."""
    handlers = None
    try:
        handlers = interrupts.defer()
        yield
    finally:
        interrupts.release(handlers)


def lines_run(action, fault_at=None, error=Fault):
    """Number of lines of the package that an action runs; an error is raised at one of them, counted from 1.

    Signals wait meanwhile: after an error at the line that puts their handlers back, they would wait for ever, also in
    the tests that follow.
    """
    count = 0

    def trace(frame, event, _argument):
        nonlocal count
        name = frame.f_code.co_filename
        if not name.startswith(PACKAGE) or name == HANDLERS:
            return None
        if event == "line":
            count += 1
            if count == fault_at:
                raise error
        return trace

    before = sys.gettrace()
    try:
        with deferred():
            sys.settrace(trace)
            action()
    except error:
        if fault_at is None or count < fault_at:
            raise
    finally:
        sys.settrace(before)
    return count
