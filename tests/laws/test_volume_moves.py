"""Volume moves: each scales centres of molecules with the box, and is accepted as often as it should be.

Steps without length leave what a move does, whose random numbers are chosen. Another Context of OpenMM and Metropolis'
rule say where a move leads and with which probability it is accepted: a little below it is, a little above it is not.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import reject
from hypothesis import strategies as st

from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from tests.laws.examples import WITH_BODIES
from tests.laws.law import Law
from tests.laws.mechanics import with_centres
from tests.laws.methods import Method, method, methods
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import SURROUNDINGS, Mixture, is_frozen
from tests.laws.runs import ROUNDING, SINGLE_ENERGY, Run, View, started
from tests.support.waters import phase_point, plain_context

#: nm and nm/ps: after a move that was not accepted. The exact engine writes the atoms of its bodies.
STILL = {"exact": (1e-13, 1e-13), "native": (0.0, 0.0), "kernels": (0.0, 0.0)}

#: Number of steps after the last move.
STEPS = 2

#: How far from the probability a random number is, of that: forces in single precision have energies that are good to
#: 0.01 kT.
MARGIN = {"Reference": 1e-3, "CPU": 0.05, "OpenCL": 0.05}

#: Probabilities below are taken for none.
RARE = 1e-6

#: kJ/mol, relative to the energy or 1: sums of rounded terms.
ROUNDING_OF_HEAT = {"Reference": 1e-7, "CPU": SINGLE_ENERGY, "OpenCL": SINGLE_ENERGY}


@dataclass(frozen=True)
class Move:
    """A move of the volume.

    Attributes:
        growth: of ln V.
        favoured: whether the random number is one with which it is accepted, and not one with which it is rejected.
    """

    growth: float
    favoured: bool


@dataclass(frozen=True)
class VolumeMoves:
    """A mixture in a box whose volume is moved, and a method that draws no other random numbers, unless in trials."""

    mixture: Mixture
    method: Method
    moves: tuple[Move, ...]
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        if run.method.get("pressure") is None:
            reject()
        step = self.method.get("stepSize") or self.method.get("schemeStepSize")
        set_step(run, 0.0)
        for move in self.moves:
            self._check_move(run, move)
        set_step(run, step)
        if run.method.kind != "SIERHMCIntegrator":
            self._goes_on(run)

    def _check_move(self, run: Run, move: Move) -> None:
        before, heat = run.view(), run.integrator.countedHeat
        energy = run.potential_energy()
        after, energy_after = scaled(run, before, move.growth)
        gain, margin = energy_after - energy, MARGIN[self.platform]
        probability = self._probability(run, before, move.growth, gain)
        is_accepted = probability >= 1 or (move.favoured and probability > RARE)
        # The package accepts where one less the random number is the probability or less.
        bound = min(1.0, probability * (1 - margin if is_accepted else 1 + margin)) if probability > RARE else 0.5
        with drawn(move.growth, 1 - bound):
            run.integrator.step(1)
        (after if is_accepted else before).steps = before.steps + 1
        tolerances = ROUNDING[run.method.engine] if is_accepted else STILL[run.method.engine]
        now = run.view()
        if run.method.kind == "SIERHMCIntegrator" and np.sum(now.velocities * before.velocities) < 0:
            # Rounding may reject the trial without length that follows.
            now.velocities *= -1
        now.assert_near(after if is_accepted else before, *tolerances)
        given, expected = run.integrator.countedHeat - heat, gain * is_accepted
        rounding = ROUNDING_OF_HEAT[self.platform] * (1 + abs(energy) + abs(energy_after))
        # NaN where heat is not counted.
        assert not abs(given - expected) > rounding, f"{given} kJ/mol are heat in place of {expected}"

    def _probability(self, run: Run, before: View, growth: float, gain: float) -> float:
        """Return the probability of a move that gains an energy, with ln V as the variable."""
        thermal, volume = GAS_CONSTANT * run.method.get("temperature"), abs(np.linalg.det(before.box))
        work = BAR * run.method.get("pressure") * volume * (math.exp(growth) - 1)
        # The centres of molecules, of which each has a volume V, and ln V itself.
        exponent = (len(run.molecules) + 1) * growth - (gain + work) / thermal
        return math.exp(min(exponent, 0.0))

    def _goes_on(self, run: Run) -> None:
        """Steps after moves are those of a Context that never made any."""
        other = run.at_same_view()
        with drawn(-1e-3, 0.0):
            for each in (run, other):
                each.integrator.step(STEPS)
        run.view().assert_near(other.view(), *ROUNDING[run.method.engine])


def set_step(run: Run, step: float) -> None:
    """Set the step of the scheme, ps."""
    integrator = run.integrator
    getattr(integrator, "setSchemeStepSize", integrator.setStepSize)(step)


def drawn(growth: float, chance: float) -> AbstractContextManager:
    """Let moves have a change of ln V and the random number that decides on them."""

    def chosen(seed: int, draw: int, molecules: int, largest: float) -> MonteCarloVolumeMove:
        return MonteCarloVolumeMove(molecules, growth, chance)

    return patch.object(MonteCarloVolumeMove, "drawn", chosen)


def scaled(run: Run, before: View, growth: float) -> tuple[View, float]:
    """Return the view after a move, and its potential energy by OpenMM, kJ/mol."""
    after, factor = run.view(), math.exp(growth / 3)
    after.box = factor * before.box
    after.positions = with_centres(run.masses, before.positions, run.molecules, factor * np.eye(3))
    context = plain_context(run.system, after.positions, run.name)
    after.show_in(context)
    context.computeVirtualSites()
    after.positions = phase_point(context)[0]
    groups = run.integrator.getIntegrationForceGroups()
    return after, context.getState(energy=True, groups=groups).getPotentialEnergy()._value


# --- the law ----------------------------------------------------------------------------------------------------------

#: Those that lead far are improbable in one direction; none makes a box too small, which has room for a tenth.
moves = st.builds(Move, st.sampled_from([0.01, -0.01, 0.05, -0.05, 0.001]), st.booleans())


@st.composite
def cases(draw: st.DrawFn, platform: str) -> VolumeMoves:
    """Draw a mixture of what a box moves, which is all but frozen atoms, and a method."""
    way = draw(methods(("SIERLangevinIntegrator", "SIERHMCIntegrator", "SIERThermostatIntegrator")))
    mixture = draw(mixtures(SURROUNDINGS[1:], named=way.engine == "exact").filter(lambda each: not is_frozen(each)))
    asked = without_noise(way).having(pressure=draw(st.sampled_from([1e3, -1e3, 3e4])), barostatInterval=1)
    several = draw(st.lists(moves, min_size=2, max_size=4))
    return VolumeMoves(replace(mixture, remover=0), asked, tuple(several), platform)


def without_noise(method: Method) -> Method:
    """Return a method whose bath does nothing."""
    if method.kind == "SIERThermostatIntegrator":
        return method.having(rate=0.0)
    if method.kind == "SIERLangevinIntegrator":
        return method.having(frictionCoeff=0.0, rotationalFriction=None, countsHeat=True)
    return method


#: A move of each kind, which is taken and not.
EVERY_MOVE = tuple(Move(growth, favoured) for growth in (0.01, -0.01) for favoured in (False, True))

#: A method of each class.
KINDS = [
    method("SIERLangevinIntegrator", temperature=300.0, frictionCoeff=0.0, stepSize=0.001, countsHeat=True),
    method("SIERHMCIntegrator", temperature=300.0, schemeStepSize=0.001, stepsPerTrial=2),
    method("SIERThermostatIntegrator", temperature=300.0, rate=0.0, every=1, stepSize=0.001),
]

#: Engines, and mixtures of `WITH_BODIES`.
VOLUMES = [("exact", "named"), ("exact", "joining"), ("native", "held"), ("native", "free")]

LAW = Law("moves", cases, few=12)


@LAW.numbers()
def test_volume_moves_are_those_of_metropolis(examples):
    LAW.hold(examples)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.kind)
@pytest.mark.parametrize(("engine", "bodies"), VOLUMES)
def test_each_volume_move_is_that_of_metropolis(kind, engine, bodies):
    asked = replace(kind, engine=engine).having(pressure=1e3, barostatInterval=1)
    VolumeMoves(replace(WITH_BODIES[bodies], crossing=True), asked, EVERY_MOVE).check()
