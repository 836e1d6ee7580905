"""Boxes of many sizes, made of one; which of them are refused."""

from __future__ import annotations

import math

import openmm
import pytest

from openmm_sier.measure import forcefields
from studies import boxes
from tests.support.commands import SYSTEMS
from tests.support.waters import platform


@pytest.mark.parametrize(("times", "copies"), [(1, (1, 1, 1)), (2, (1, 1, 2)), (64, (4, 4, 4)), (192, (4, 6, 8))])
def test_boxes_are_as_cubic_as_they_can_be(times, copies):
    assert boxes.copies_for(512 * times, 512) == copies


@pytest.mark.parametrize("name", ["tip3p-512.pdb", "tip4p2005-512.pdb"])
def test_repeated_box_has_the_energy_of_its_copies(name):
    found = forcefields.read_box(SYSTEMS / name)
    energies = []
    for copies in ((1, 1, 1), (1, 2, 1)):
        replica = boxes.repeated(found, SYSTEMS, copies)
        assert replica.molecules == 512 * math.prod(copies)
        context = openmm.Context(replica.system, openmm.VerletIntegrator(0.001), platform("CPU"))
        context.setPositions(replica.positions)
        energies.append(context.getState(energy=True).getPotentialEnergy()._value)
    # PME on meshes of two shapes, at a tolerance of 1e-5.
    assert energies[1] == pytest.approx(2 * energies[0], rel=1e-4)
