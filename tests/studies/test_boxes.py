"""Boxes of many sizes, made of one, and which of them are refused."""

import math

import numpy as np
import pytest

from openmm_sier.inputs import forcefields
from studies import boxes
from tests.support.commands import SYSTEMS
from tests.support.matrices import representatives
from tests.support.waters import plain_context


@pytest.mark.parametrize(("times", "copies"), [(1, (1, 1, 1)), (2, (1, 1, 2)), (64, (4, 4, 4)), (192, (4, 6, 8))])
def test_boxes_are_as_cubic_as_they_can_be(times, copies):
    assert boxes.copies_for(512 * times, 512) == copies


@pytest.mark.parametrize("name", representatives(["tip3p-512.pdb", "tip4p2005-512.pdb"], "tip3p-512.pdb"))
def test_repeated_box_has_the_energy_of_its_copies(name):
    result = forcefields.read_box(SYSTEMS / name)
    energies = []
    for copies in ((1, 1, 1), (1, 2, 1)):
        replica = boxes.repeated(result, SYSTEMS, copies)
        assert replica.molecules == 512 * math.prod(copies)
        context = plain_context(replica.system, replica.positions, "CPU")
        energies.append(context.getState(energy=True).getPotentialEnergy()._value)
    # PME on meshes of two shapes, at a tolerance of 1e-5.
    assert energies[1] == pytest.approx(2 * energies[0], rel=1e-4)


@pytest.mark.thorough
def test_part_of_a_box():
    result = forcefields.read_box(SYSTEMS / "tip3p-512.pdb")
    part = boxes.of_size(result, SYSTEMS, 64)
    assert part.molecules == 64
    assert part.positions.shape == (192, 3)
    edges = [
        np.array([vector[i]._value for i, vector in enumerate(system.getDefaultPeriodicBoxVectors())])
        for system in (part.system, result.system)
    ]
    # An eighth of the molecules in an eighth of the volume.
    assert edges[0] == pytest.approx(edges[1] / 2)
    waters = part.positions.reshape(64, 3, 3)
    assert np.linalg.norm(waters[:, 1] - waters[:, 0], axis=1) == pytest.approx(0.09572, abs=1e-4)
    assert (waters.mean(axis=1) < edges[0] * (1 + 1e-9)).all()
    # No two molecules of the liquid come closer than they were, but for faces and the change of size.
    apart = np.linalg.norm(waters[:, None, 0] - waters[None, :, 0], axis=2)[np.triu_indices(64, 1)]
    assert apart.min() > 0.22
    assert boxes.of_size(result, SYSTEMS, 1024).molecules == 1024
    with pytest.raises(ValueError, match="1 to 511, got 0"):
        boxes.of_size(result, SYSTEMS, 0)
