"""The dipole in a field in miniature."""

import functools

import numpy as np
import pytest

from studies.methods import PAPER
from studies.paper import dipole, published
from studies.paper.dipole import DipoleSettings, Field
from tests.support.oracles import random_attitudes, skew

NAMES = [method.name for method in PAPER]


@functools.cache
def miniature():
    return dipole.find(DipoleSettings(bodies=1500, span=1.5)).tables["rows"].set_index(["method", "force_step_fs"])


@pytest.mark.slow
@pytest.mark.parametrize("step", [4.2, 11.0, 21.0])
def test_energies_are_those_of_table_1(step):
    """Within the factor 2 that the paper's unknown ensemble leaves; the order of the methods is the paper's."""
    found = {name: miniature()["energy"][name, step] for name in NAMES}
    for name in NAMES:
        assert 0.5 < found[name] / published.ENERGY[name, step][0] < 2
    ranks = sorted(("SIER2", "SIER4", "MRDL"), key=lambda name: found[name])
    assert ranks == sorted(ranks, key=lambda name: published.ENERGY[name, step][0])
    # In the paper they agree to two digits.
    assert found["SEJ4"] == pytest.approx(found["SIER2"], rel=0.01)


@pytest.mark.parametrize("step", [4.2, 11.0, 21.0])
def test_angular_momenta_are_those_of_table_1(step):
    """Rounding, below 1e-13 in a few hundred steps, and for SEJ4 within a factor 3 of the paper."""
    for name in ("MRDL", "SIER2", "SIER4"):
        assert 0 < miniature()["momentum"][name, step] < 1e-13
    assert 1 / 3 < miniature()["momentum"]["SEJ4", step] / published.MOMENTUM["SEJ4", step][0] < 3


def test_the_field_is_2_7_megavolts_per_metre():
    """Two orders of magnitude more, which the paper's comparison with a molecule at 7 A would mean, is not Table 1.

    The energy error of SIER2 hardly depends on a weak field, that of MRDL as its inverse: rms(V) grows, the error of
    free rotation stays.
    """
    strong = dipole.find(DipoleSettings(field=270.0, bodies=500, span=1.0, force_steps_fs=(11.0,)))
    found = strong.tables["rows"].set_index("method")["energy"]
    assert found["MRDL"] < published.ENERGY["MRDL", 11.0][0] / 4


def test_torque_belongs_to_the_potential(rng):
    """The torque's component along n is -dV/dangle for a turn about n; central differences err by 1e-10."""
    field = Field(0.7, np.array([0.6, 0.0, 0.8]))
    A = random_attitudes(rng, 50)
    _, torque = field.forces(np.zeros((3, 50)), A)
    for axis in np.eye(3):
        angle = 1e-5
        turned = [field.potential(_turned(A, axis, s * angle)) for s in (-1, 1)]
        assert np.abs((turned[0] - turned[1]) / (2 * angle) - axis @ torque).max() < 1e-9
    assert np.abs(dipole.Z @ torque).max() < 1e-15


def _turned(A, axis, angle):
    """Bodies turned in the lab: rows of A turn as vectors."""
    S = np.eye(3) + np.sin(angle) * skew(axis) + (1 - np.cos(angle)) * skew(axis) @ skew(axis)
    return np.einsum("xy,ayn->axn", S, A)
