"""Energies: in short steps all energy that a Context gains is heat, and every trial is accepted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import reject
from hypothesis import strategies as st

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.engines.snapshot import HOST_PLATFORMS
from tests.laws.examples import WITH_BODIES
from tests.laws.law import Law
from tests.laws.methods import Method, method, methods
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import TEMPERATURE, Mixture
from tests.laws.runs import Run, end, started

#: ps: a step in which a bath of `FRICTION`, 1/ps, draws a fifth of the momenta.
SHORT, FRICTION = 0.0001, 2000.0

#: Largest change of the energy less the heat, in kT for each degree of freedom, of which a bath gives and takes as much
#: as one within five steps.
LOST = 0.01


@dataclass(frozen=True)
class Gain:
    """A run with a strong bath, in short steps."""

    mixture: Mixture
    method: Method
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        if self.platform not in HOST_PLATFORMS and run.is_periodic:
            # The force of `Run` depends on the image of an atom, and GPU platforms bring molecules into the box.
            reject()
        if np.isnan(run.integrator.countedHeat):
            return
        thermal = GAS_CONSTANT * TEMPERATURE * run.freedoms(run.view())
        last = own_energy(run)
        for _ in range(4):
            # A volume move may end a run where the box becomes too small.
            if end(run, 2):
                return
            energy = own_energy(run)
            gain = (energy - last) / thermal
            assert abs(gain) < LOST, f"the energy less the heat grew by {gain:.3f} kT for each degree of freedom"
            last = energy
        if run.method.kind == "SIERHMCIntegrator":
            rate = run.integrator.acceptanceRate
            assert rate == 1, f"a part of {rate} of trials is accepted, whose energy has no error"


def own_energy(run: Run) -> float:
    """Return the total energy less what a run counts as heat, kJ/mol."""
    return run.potential_energy() + run.kinetic_energy(run.view()) - run.integrator.countedHeat


@st.composite
def gains(draw: st.DrawFn, platform: str) -> Gain:
    """Draw a method of any class, whose steps are short and whose bath is strong."""
    return Gain(draw(mixtures()), in_short_steps(draw(methods())), platform)


def in_short_steps(method: Method) -> Method:
    """Return a method with short steps, and with a strong bath if it has one."""
    names = {"stepSize": SHORT, "schemeStepSize": SHORT, "frictionCoeff": FRICTION, "rotationalFriction": 2 * FRICTION}
    names |= {"rate": FRICTION}
    return method.having(**{name: value for name, value in names.items() if method.get(name)})


#: bar: moves to a larger volume are refused, and those to a smaller one are accepted.
REFUSING = 3e4

#: A method of each class that gives heat, with moves of the volume where there are any.
BATHS = [
    method("SIERLangevinIntegrator", temperature=300.0, frictionCoeff=1.0, scheme="SIER4G", stepSize=SHORT),
    method("SIERLangevinIntegrator", temperature=300.0, frictionCoeff=1.0, scheme="SIER2", stepSize=SHORT),
    method("SIERHMCIntegrator", temperature=300.0, frictionCoeff=1.0, schemeStepSize=SHORT, stepsPerTrial=2),
    method("SIERThermostatIntegrator", temperature=300.0, rate=1.0, every=1, stepSize=SHORT),
]

GAINS = Law("gains", gains, few=12)


@GAINS.numbers()
def test_what_is_gained_is_heat(examples):
    GAINS.hold(examples)


@pytest.mark.parametrize("pressure", [None, REFUSING])
@pytest.mark.parametrize("bath", BATHS, ids=lambda bath: bath.kind)
@pytest.mark.parametrize(("engine", "bodies"), [("exact", "named"), ("native", "held")])
def test_what_each_bath_gives_is_heat(bath, engine, bodies, pressure):
    bath = in_short_steps(bath).having(pressure=pressure, barostatInterval=pressure and 1)
    Gain(replace(WITH_BODIES[bodies], remover=True), replace(bath, engine=engine)).check()
