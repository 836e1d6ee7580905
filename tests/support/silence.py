"""Where nothing is to be said."""

import warnings
from contextlib import contextmanager


@contextmanager
def silence(*but):
    """Warnings are errors, but those whose messages begin as is said."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for message in but:
            warnings.filterwarnings("ignore", message)
        yield
