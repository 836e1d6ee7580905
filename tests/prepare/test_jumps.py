"""Energies that end at the cut-off with a jump, of which `prepare_system` tells, and those that do not."""

import copy
import re

import numpy as np
import openmm
import pytest

from openmm_sier import prepare_system
from openmm_sier.prepare.jumps import LEAST
from tests.support.containers import scaled
from tests.support.systems import assembled

#: Lennard-Jones in the form of Ashbaugh and Hatch, less its value at the cut-off.
ASHBAUGH_HATCH = (
    "select(step(r-2^(1/6)*s), lambda*(u-end), u-lambda*end+(1-lambda)*depth);"
    "u=4*depth*((s/r)^12-(s/r)^6); end=shifted*4*depth*((s/2)^12-(s/2)^6); s=(s1+s2)/2; lambda=(lambda1+lambda2)/2"
)


def custom(expression, kinds, cutoff=2.0, parameters=(), **constants):
    """A CustomNonbondedForce for particles with such parameters."""
    force = openmm.CustomNonbondedForce(expression)
    for name in parameters:
        force.addPerParticleParameter(name)
    for name, value in constants.items():
        force.addGlobalParameter(name, value)
    for kind in kinds:
        force.addParticle(kind)
    force.setNonbondedMethod(openmm.CustomNonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(cutoff)
    return force


def ashbaugh_hatch(shifted):
    kinds = [(0.5, 0.6), (0.6, 0.0), (0.5, 0.6)]
    return custom(ASHBAUGH_HATCH, kinds, parameters=("s", "lambda"), depth=0.8, shifted=shifted)


def yukawa(shift):
    return custom(f"q1*q2*(exp(-r/0.8)/r-{shift})", [(1.0,), (-1.0,)], 4.0, ("q",))


def limits(force):
    system = assembled([1.0] * force.getNumParticles(), copy.deepcopy(force))
    system.setDefaultPeriodicBoxVectors(*(10 * np.eye(3)))
    return prepare_system(system).limits


def tabulated(last):
    force = custom("f(r)*extra1*extra2", [(), ()])
    force.addTabulatedFunction("f", openmm.Continuous1DFunction([1.0, 0.4, last], 0.0, 2.0))
    force.addComputedValue("extra", "2")
    return force


SMOOTH = {
    "Ashbaugh-Hatch": lambda: ashbaugh_hatch(1),
    "Yukawa": lambda: yukawa(np.exp(-5) / 4),
    "a step before the cut-off": lambda: custom("step(1.9-r)", [(), ()]),
    "a table": lambda: tabulated(0.0),
    "nothing": lambda: custom("1/r", []),
    "decayed": lambda: custom("exp(-r/0.1)", [(), ()]),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_a_force_that_ends_at_zero_has_no_jump(name):
    assert limits(SMOOTH[name]()) == ()


#: What jumps, with the size in kJ/mol.
JUMPS = {
    # Largest between atoms 0 and 2: 0.6*4*0.8*(0.25^6 - 0.25^12).
    "Ashbaugh-Hatch": (lambda: ashbaugh_hatch(0), r"0\.0005 kJ/mol between atoms 0 and 2"),
    "Yukawa": (lambda: yukawa(0), r"0\.002 kJ/mol between atoms 0 and 1"),
    "a step at the cut-off": (lambda: custom("step(2-r)", [(), ()]), r"1 kJ/mol between atoms 0 and 1"),
    "a table": (lambda: tabulated(0.1), r"0\.4 kJ/mol between atoms 0 and 1"),
}


@pytest.mark.parametrize("name", JUMPS)
def test_a_jump_is_told_with_its_size_and_the_remedy_of_its_force(name):
    make, size = JUMPS[name]
    force = make()
    (said,) = limits(force)
    cutoff = force.getCutoffDistance()._value
    assert said.startswith(f"CustomNonbondedForce ends with a jump of the energy at {cutoff:g} nm")
    assert "water" not in said
    assert "create the System" not in said
    start = {2.0: "1.7", 4.0: "3.3"}[cutoff]
    for expected in (size, rf"setUseSwitchingFunction\(True\) and setSwitchingDistance\({start}\*nanometer\)"):
        assert re.search(expected, said)
    switched = make()
    switched.setUseSwitchingFunction(True)
    switched.setSwitchingDistance(float(start))
    assert limits(switched) == ()


def test_kinds_that_do_not_interact_have_no_jump():
    """Only atoms 0 and 1 do, and they are neutral to each other; a single atom does not meet its like."""
    expression, parameters = "a1*a2", ("a",)
    kinds = [(0.0,), (1.0,), (3.0,)]
    assert "of 3 kJ/mol between atoms" in limits(custom(expression, kinds, parameters=parameters))[0]
    grouped = custom(expression, kinds, parameters=parameters)
    grouped.addInteractionGroup([0], [1, 2])
    assert limits(grouped) == ()
    grouped.addInteractionGroup([2], [1])
    assert "of 3 kJ/mol between atoms" in limits(grouped)[0]
    assert limits(custom(expression, kinds[:2], parameters=parameters)) == ()


def test_a_force_within_another_counts_by_its_factor():
    for factor, told in ((1.0, 1), (LEAST / 2, 0)):
        system = assembled([1.0, 1.0], scaled(custom("1", [(), ()]), factor))
        system.setDefaultPeriodicBoxVectors(*(10 * np.eye(3)))
        assert len(prepare_system(system).limits) == told


@pytest.mark.parametrize("epsilon", [np.nan, np.inf])
def test_the_largest_jump_of_all_atoms_counts(epsilon):
    """Wherever it is, and beside one that is no number."""
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
    said = limits(force)
    assert len(said) == told
    for sentence in said:
        assert "switchDistance=0.75*nanometer, or call setUseSwitchingFunction(True)" in sentence
