"""Tests that no warnings occur."""

import warnings
from contextlib import contextmanager


@contextmanager
def silence(*but):
    """Turn warnings into errors, except those whose messages match one of the patterns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for message in but:
            warnings.filterwarnings("ignore", message)
        yield
