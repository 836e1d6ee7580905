"""Frames are as heavy and as inert as their bodies, for bodies of every shape."""

import numpy as np
import pytest

from openmm_sier.dynamics.species import Species
from openmm_sier.prepare.frame_shapes import FrameShape
from tests.support.framed import SHAPES


def made(name):
    masses, places = SHAPES[name]
    species = Species.from_coordinates([range(len(masses))], masses, places)
    return species, FrameShape.of(species)


@pytest.mark.parametrize("name", SHAPES)
def test_mass_centre_and_moments_are_those_of_the_body(name):
    """To the rounding of sums of up to 200 terms."""
    species, frame = made(name)
    sums = np.einsum("k,ak,bk->ab", species.masses, species.sites, species.sites)
    result = np.einsum("k,ak,bk->ab", frame.masses, frame.corners, frame.corners)
    assert frame.masses.sum() == pytest.approx(species.mass, rel=1e-14)
    assert np.abs(frame.corners @ frame.masses).max() < 1e-13 * species.mass
    assert result == pytest.approx(sums, abs=1e-13 * sums.max())
    again = Species.from_sites([range(len(frame.masses))], frame.masses, frame.corners)
    assert again.moments == pytest.approx(species.moments, rel=1e-12)
    assert (frame.masses > 0).all()


@pytest.mark.parametrize(
    ("name", "size"), [("C60", 4), ("rod", 4), ("benzene", 3), ("water", 3), ("carbon dioxide", 2), ("N2", 2)]
)
def test_as_many_particles_as_the_shape_needs(name, size):
    _, frame = made(name)
    assert len(frame.masses) == size


@pytest.mark.parametrize("name", SHAPES)
def test_corners_keep_clear_of_atoms(name):
    """Equal masses would lie on the atoms of N2 and of a cube."""
    species, frame = made(name)
    apart = np.linalg.norm(frame.corners[:, :, None] - species.sites[:, None, :], axis=0)
    # Forces may divide by the distance; atoms and corners of these bodies are some 0.1 nm apart.
    assert apart.min() > 1e-3


@pytest.mark.parametrize("name", ["thin", "rod", "ribbon"])
def test_frames_of_thin_bodies_are_not_thin(name):
    """Spans of four equal masses are 2.31 c and 2.83 a, so that their ratio is at most 0.82 of that of the extents."""
    species, frame = made(name)
    squares = (species.masses * species.sites**2).sum(axis=1)
    ratio = np.sqrt(squares.min() / squares.max())
    spans = np.ptp(frame.corners, axis=1)
    assert ratio < 0.02
    assert spans.min() / spans.max() > 4 * 0.82 * ratio


def test_the_first_corner_of_a_flat_frame_is_as_far_from_both_others():
    """OpenMM moves such triangles by SETTLE, if the others weigh the same; it compares lengths in single precision."""
    for name in ("benzene", "water"):
        _, frame = made(name)
        first, one, other = frame.corners.T
        assert np.float32(np.linalg.norm(one - first)) == np.float32(np.linalg.norm(other - first))
        assert frame.masses[1] == frame.masses[2]
