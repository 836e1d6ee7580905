"""Matrices of parameters, of which the default run takes representatives."""

import pytest


def representatives(values, *quick):
    """Return values as parameters; all but the quick ones are thorough. Tuples have a value for each argument."""
    values = list(values)
    assert all(value in values for value in quick)
    return [value if value in quick else thorough(value) for value in values]


def thorough(value, **options):
    """A value as a parameter that the default run leaves out."""
    values = value if isinstance(value, tuple) else (value,)
    return pytest.param(*values, marks=pytest.mark.thorough, **options)
