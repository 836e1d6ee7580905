"""Arguments that no integrator can have are named when it is made."""

from functools import partial

import pytest
from openmm import unit

from openmm_sier import (
    SIER2,
    Scheme,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    SIERThermostatIntegrator,
)
from openmm_sier.ensembles import VelocityRescaling

langevin = partial(SIERLangevinIntegrator, 300, 1, 0.002)
trials = partial(SIERHMCIntegrator, 300, 0.002)
CROOKED = Scheme("Euler", (("kick", 1.0), ("drift", 1.0)))
LISTS = r"bodies must be RigidBodies, got .* take their shape from positions: bodies=RigidBodies\.from_system"
NAN = float("nan")

REFUSED = [
    (partial(SIERLangevinIntegrator, -1, 1, 0.002), "temperature"),
    (partial(SIERLangevinIntegrator, 300 * unit.picosecond, 1, 0.002), "temperature"),
    (partial(SIERLangevinIntegrator, "300", 1, 0.001), "temperature must be a quantity or a number in K, got '300'"),
    (partial(SIERLangevinIntegrator, 300, -1, 0.002), "frictionCoeff"),
    (partial(SIERLangevinIntegrator, 300, NAN, 0.002), "frictionCoeff"),
    (partial(SIERLangevinIntegrator, 300, 1, -0.002), "stepSize"),
    (partial(SIERIntegrator, "0.001"), "stepSize must be a quantity or a number in ps, got '0.001'"),
    (partial(langevin, pressure=NAN), "pressure must be finite"),
    (partial(langevin, pressure=1 * unit.kelvin), "pressure must be in units like bar"),
    (partial(langevin, pressure="high"), "pressure must be a quantity or a number in bar"),
    (partial(langevin, pressure=1, barostatInterval=0), "barostatInterval must be at least 1"),
    (partial(langevin, pressure=1, barostatInterval=2.5), "barostatInterval must be a whole number"),
    (partial(SIERHMCIntegrator, 0, 0.002), "temperature must be above zero"),
    (partial(trials, frictionCoeff=0), "frictionCoeff must be above zero"),
    (partial(trials, stepsPerTrial=0), "stepsPerTrial must be at least 1"),
    (partial(trials, stepsPerTrial=2.5), "stepsPerTrial must be a whole number"),
    (partial(trials, scheme=SIER2.with_bath()), "has a bath"),
    (partial(trials, scheme=CROOKED), "is not a palindrome"),
    (partial(VelocityRescaling, -1, 1), "temperature must be at least 0, got -1.0 K"),
    (partial(VelocityRescaling, 300, -1 / unit.picosecond), "rate must be at least 0, got -1.0 1/ps"),
    (partial(VelocityRescaling, 300, 1 * unit.picosecond), "rate must be in units like 1/ps"),
    (partial(VelocityRescaling, 300, 1, 0), "every must be at least 1"),
    (partial(VelocityRescaling, 300, 1, 1.5), "every must be a whole number"),
    (partial(SIERThermostatIntegrator, 300, 0.002), "thermostat must be like VelocityRescaling.*, got 300"),
    (partial(langevin().setRandomNumberSeed, 2**40), "seed must be at most 2147483647, got 1099511627776"),
    (partial(SIERIntegrator, 0.002, engine=0), "engine"),
    (partial(SIERIntegrator, 0.004, "SIER2", 1), "bodies must be .* got 1"),
    (partial(SIERIntegrator, 0.002, substeps=0), "substeps"),
    (partial(SIERIntegrator, 0.002, substeps=True), "substeps must be a whole number .* got True"),
    (partial(SIERIntegrator, 10**400), "stepSize must be finite"),
    (partial(SIERIntegrator, 0.002, rotation="exact"), r"rotation must be a free-rotation map, .*, got 'exact'"),
    (partial(SIERIntegrator, 0.002, ensemble="npt"), "ensemble must be one of .*, got 'npt'"),
    (partial(SIERIntegrator, 0.002, ensemble=0), "ensemble must be one of .*, got 0"),
    (partial(langevin, countsHeat="no"), "countsHeat must be True, False or None, got 'no'"),
    *((partial(SIERIntegrator, 0.004, fastForceGroups=groups), "fastForceGroups") for groups in ({32}, {-1}, "a", 2.5)),
    *((partial(SIERIntegrator, 0.001, "SIER2", bodies), LISTS) for bodies in (3, "0 1 2", [[0, 1.5]], [0, 1, 2])),
]


BATH = (300 * unit.kelvin, 1 / unit.picosecond, 4 * unit.femtoseconds)
OTHERS = (4 * unit.nanometer, 1 / unit.picosecond, 300 * unit.kelvin)
THERMOSTAT = VelocityRescaling(300, 1)

#: Every constructor and method that takes a step, as a function of the step.
STEPS = [
    SIERIntegrator,
    partial(SIERLangevinIntegrator, 300, 1),
    partial(SIERHMCIntegrator, 300),
    partial(SIERHMCIntegrator, 300, stepsPerTrial=8),
    partial(SIERThermostatIntegrator, THERMOSTAT),
    SIERIntegrator(0.001, "SIER2").setStepSize,
    trials().setSchemeStepSize,
]


@pytest.mark.parametrize("make", STEPS)
@pytest.mark.parametrize("size", OTHERS, ids=str)
def test_a_step_that_is_no_time_is_refused(make, size):
    expected = "a time, got the temperature 300 K" if size.unit == unit.kelvin else "in units like ps, got"
    with pytest.raises(TypeError, match=f"stepSize must be {expected}"):
        make(size)


def test_arguments_of_a_heat_bath_name_the_temperature():
    """Those of LangevinMiddleIntegrator, given to an integrator of constant energy."""
    with pytest.raises(TypeError, match=r"stepSize .*300 K\..*SIERLangevin"):
        SIERIntegrator(*BATH)


@pytest.mark.parametrize(("make", "message"), REFUSED)
def test_impossible_arguments_are_named(make, message):
    with pytest.raises((ValueError, TypeError), match=message):
        make()
