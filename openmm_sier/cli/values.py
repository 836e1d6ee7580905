"""Numbers on the command line, as types of argparse."""

from __future__ import annotations

import argparse
import math


def any_number(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}")
    return value


def positive(text: str) -> float:
    """A number above 0."""
    if (value := any_number(text)) <= 0:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text!r}")
    return value


def not_negative(text: str) -> float:
    """A number of at least 0."""
    if (value := any_number(text)) < 0:
        raise argparse.ArgumentTypeError(f"expected a number not below 0, got {text!r}")
    return value


def whole(text: str) -> int:
    """A whole number above 0."""
    if not text.isdigit() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, got {text!r}")
    return int(text)
