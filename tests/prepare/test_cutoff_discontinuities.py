"""Lennard-Jones energies that end at the cut-off with a jump, of which `prepare_system` warns."""

import copy

import numpy as np
import openmm
import pytest

from openmm_sier import prepare_system
from tests.support.systems import assembled


def limits(force):
    system = assembled([1.0] * force.getNumParticles(), copy.deepcopy(force))
    system.setDefaultPeriodicBoxVectors(*(10 * np.eye(3)))
    return prepare_system(system).limits


@pytest.mark.parametrize("epsilon", [np.nan, np.inf])
def test_the_largest_jump_of_all_atoms_counts(epsilon):
    """In any place, and together with one that is not a number."""
    force = openmm.NonbondedForce()
    for well in (0.0, epsilon, 0.64, 0.0):
        force.addParticle(0, 0.315, well)
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(0.9)
    assert len(limits(force)) == 1


@pytest.mark.parametrize(("cutoff", "told"), [(0.9, 1), (2.5, 0)])
def test_lennard_jones_by_its_size_at_the_cutoff(cutoff, told):
    """Of water's oxygen it is 4*0.64*(0.315/0.9)^6 = 5e-3 kJ/mol, and 1e-5 at 2.5 nm."""
    force = openmm.NonbondedForce()
    for _ in range(2):
        force.addParticle(0, 0.315, 0.64)
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(cutoff)
    sentences = limits(force)
    assert len(sentences) == told
    for sentence in sentences:
        assert "switchDistance=0.75*nanometer, or call setUseSwitchingFunction(True)" in sentence
    switched = copy.deepcopy(force)
    switched.setUseSwitchingFunction(True)
    switched.setSwitchingDistance(0.8 * cutoff)
    assert limits(switched) == ()
