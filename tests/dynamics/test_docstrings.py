"""The examples in the docstrings of the dynamics."""

import doctest
import importlib
import pkgutil

from openmm_sier import dynamics

MODULES = [module.name for module in pkgutil.walk_packages(dynamics.__path__, "openmm_sier.dynamics.")]


def test_examples():
    failures = {name: doctest.testmod(importlib.import_module(name)).failed for name in MODULES}
    assert [name for name in MODULES if failures[name]] == []
