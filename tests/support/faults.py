"""Errors and interrupts at any line of the package."""

from __future__ import annotations

import pathlib
import sys

import openmm_sier

PACKAGE = str(pathlib.Path(openmm_sier.__file__).parent)


class Fault(Exception):
    """Like Ctrl-C, or an error of the machine, it may come at any line."""


def lines_run(action, fault_at=None, error=Fault):
    """Number of lines of the package that an action runs; an error is raised at one of them, counted from 1."""
    count = 0

    def trace(frame, event, _argument):
        nonlocal count
        if not frame.f_code.co_filename.startswith(PACKAGE):
            return None
        if event == "line":
            count += 1
            if count == fault_at:
                raise error
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    except error:
        if fault_at is None or count < fault_at:
            raise
    finally:
        sys.settrace(before)
    return count
