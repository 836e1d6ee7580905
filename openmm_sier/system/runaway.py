"""Temperatures that only a broken run reaches, and a watch for them at the end of calls of `step`."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol

import numpy as np
import openmm

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.system import tables
from openmm_sier.system.notices import tell

#: A temperature in K that rigid molecules are not meant for. Runs of the comparisons of integrators end there too.
HOTTEST = 3000.0

#: A few bodies may be hotter by chance. They exceed what `hottest` allows with a probability below exp(-this).
UNLIKELY = 50.0

#: The watch looks after at least so many steps, which cost as many forces or more. Reading the velocities of 24,000
#: atoms takes 0.3 ms, a step of them some 50 ms on two cores. Other calls of `step` cost 1 us.
INTERVAL = 100

#: Fewer atoms with mass are not judged: a few ions that fall towards each other become as hot by Coulomb's law.
FEWEST_ATOMS = 60

#: The heat must also have grown by this factor since velocities or positions were last set from outside, so that a
#: user's own hot start is no runaway.
GROWTH = 2.0


def hottest(temperature: float, freedoms: float) -> float:
    """A temperature in K that so many degrees of freedom do not exceed unless a run has broken down.

    It is `HOTTEST`, or more where a few of them may be so hot by chance: Laurent and Massart, Ann. Statist. 28, 1302
    (2000), Lemma 1, for the chi-squared distribution.

    Args:
        temperature: of the equilibrium, K.
        freedoms: number of degrees of freedom; 0 where there are none.
    """
    if freedoms < 1:
        return HOTTEST
    excess = UNLIKELY / freedoms
    return max(HOTTEST, temperature * (1 + 2 * math.sqrt(excess) + 2 * excess))


class Bathed(Protocol):
    """An integrator as the watch sees it."""

    def computeSystemTemperature(self) -> Any: ...

    def getStepSize(self) -> Any: ...


class RunawayWatch:
    """Warns if steps have made a System hotter than rigid molecules are meant for; once after each change from outside.

    It looks at the velocities in the Context every `INTERVAL` steps, at the end of a call of `step`.
    """

    def __init__(self, context: openmm.Context):
        # The Context owns its integrator, which holds this.
        self._context = weakref.ref(context)
        self._masses: np.ndarray | None = None
        self._start: float | None = None
        self._steps = 0
        self._warned = self._stepping = False

    def forget(self) -> None:
        """Positions or velocities were set. Unless steps did so, what they are then is a new start."""
        if not self._stepping:
            self._start = None
            self._warned = False

    def over(self, make: Callable[[int], None], steps: int, integrator: Bathed) -> None:
        """Make steps and look.

        Args:
            make: makes a number of steps.
            steps: how many to make.
            integrator: gives the exact temperature, which is asked only if there is a suspicion, and that of its bath.
        """
        if self._start is None:
            self._start, self._steps = self._largest_temperature(), 0
        self._stepping = True
        try:
            make(steps)
        finally:
            self._stepping = False
        self._steps += steps
        if self._steps >= INTERVAL and not self._warned:
            self._steps = 0
            self._look(integrator)

    def _look(self, integrator: Bathed) -> None:
        now = self._largest_temperature()
        atoms = 0 if self._masses is None else int(np.count_nonzero(self._masses))
        if now <= max(HOTTEST, GROWTH * (self._start or 0.0)) or atoms < FEWEST_ATOMS:
            return
        found, bath = now, getattr(integrator, "getTemperature", lambda: None)()
        # Molecules that are torn have no temperature.
        with suppress(ValueError, openmm.OpenMMException):
            found = integrator.computeSystemTemperature()._value
        if bath is not None and found <= hottest(bath._value, atoms):
            # A hot bath, which may be cooled later.
            self._start = now
        elif not found <= HOTTEST:
            self._warned = True
            step = 1000 * integrator.getStepSize()._value
            tell(
                f"Steps of {step:.3g} fs have raised the temperature to {found:.3g} K; above {HOTTEST:g} K "
                "rigid molecules make no sense. Is the step too long, or did atoms overlap at the start? Take a "
                "shorter step, or minimize the energy first"
            )

    def _largest_temperature(self) -> float:
        """A bound of the temperature in K that needs no constraints: one degree of freedom for each atom with mass."""
        context = self._context()
        if context is None:
            return 0.0
        if self._masses is None:
            self._masses = tables.masses(context.getSystem())
        velocities = context.getState(velocities=True).getVelocities(asNumpy=True)._value
        energy = 0.5 * np.einsum("i,ix,ix->", self._masses, velocities, velocities)
        return float(2 * energy / (max(1, int(np.count_nonzero(self._masses))) * GAS_CONSTANT))
