"""The examples in the docstrings of the dynamics."""

import doctest
import importlib
import pkgutil

import pytest

from openmm_sier import dynamics

MODULES = [found.name for found in pkgutil.walk_packages(dynamics.__path__, "openmm_sier.dynamics.")]


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_every_free_rotation_map_has_an_example():
    finder = doctest.DocTestFinder(recurse=False)
    maps = importlib.import_module("openmm_sier.dynamics.rotation")
    for name in maps.__all__:
        assert any(found.examples for found in finder.find(getattr(maps, name))), name
