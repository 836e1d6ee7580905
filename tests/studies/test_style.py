"""One look for every method in every figure."""

from __future__ import annotations

import inspect

import pytest
from matplotlib.colors import to_rgb
from studies.paper.methods import METHODS

from openmm_sier.measure import sampling
from studies import schemes, style
from studies.bench import peers
from tests.support.reports import Told

COMPARED = {method.name for method, _ in schemes.known().values()}
COMPARED |= {method.name for method in (*sampling.nve_methods().values(), *METHODS)}
COMPARED |= {method.name for method in sampling.nvt_methods(300, 1, 1).values()}


@pytest.mark.parametrize("name", sorted(COMPARED))
def test_every_method_that_can_be_compared_has_a_look(name):
    assert style.of_method(name)["color"] != style.UNKNOWN[0]


def test_peers_have_a_look():
    source = inspect.getsource(peers.installed)
    assert all(name in style.METHODS for name in style.METHODS if name.startswith(("LAMMPS", "GROMACS")))
    for name in ("LAMMPS rigid/nve/small", "GROMACS md-vv, mixed", "GROMACS md-vv, double"):
        assert name in source
        assert name in style.METHODS


def test_no_two_methods_look_alike():
    looks = [tuple(style.of_method(name)[key] for key in ("color", "marker")) for name in style.METHODS]
    assert len(set(looks)) == len(looks)
    # Two methods with one colour, OpenMM's, are never in one figure: one is at constant energy, one has a bath.
    colours = [to_rgb(colour) for colour, _ in style.METHODS.values()]
    assert len(set(colours)) == len(colours) - 1


def test_a_heat_bath_does_not_change_the_look():
    assert style.of_method("SIER4G Langevin") == style.of_method("SIER4G")
    assert style.of_method("SIER4G")["ls"] == "-"
    assert style.of_method("OpenMM LangevinMiddle")["ls"] == "--"


def test_a_missing_matplotlib_is_noted(monkeypatch):
    monkeypatch.setattr(figures, "find_spec", lambda name: None)
    told = Told()
    assert not style.can_draw(told)
    (note,) = told.notes
    assert note.startswith("no figure: ")
    assert "openmm-sier[plots]" in note
    with pytest.raises(ModuleNotFoundError, match=r"openmm-sier\[plots\]"):
        style.require()
