"""Temperatures that only a broken run reaches, and a watch for them at the end of calls of `step`.

Energy that an integrator creates ends as heat, so temperatures show every runaway, with all heat baths alike.
"""

import math
from collections.abc import Callable

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.system import tables

#: Temperature in K above which rigid molecules are no model. Runs of the comparisons of integrators end there too.
HOTTEST = 3000.0

#: Minus the logarithm of the probability that a few bodies are hotter than `hottest` by chance.
UNLIKELY = 50.0

#: Number of steps between two looks. To read the velocities of 24,000 atoms takes 0.3 ms, as long as a step on a GPU.
#: Other calls of `step` cost 1 us.
INTERVAL = 500

#: Number of steps before the first look after a start, since the worst runaways take a dozen steps. It is doubled after
#: each look, up to `INTERVAL`.
FIRST_LOOK = 5

#: Smallest number of atoms with mass whose heat is judged: a few ions that fall towards each other become as hot.
FEWEST_ATOMS = 60

#: Smallest growth of the temperature of a runaway, so that a hot start of the user is none.
GROWTH = 2.0


def hottest(temperature: float, freedoms: float) -> float:
    """Return an upper bound in K of the temperature of `freedoms` degrees of freedom in a run that works.

    It is `HOTTEST`, or more if a few of them may be so hot by chance: Laurent and Massart, Ann. Statist. 28, 1302
    (2000), Lemma 1, for the chi-squared distribution. It is at least `GROWTH` times the temperature of the user.

    Args:
        temperature: of the equilibrium or of the start, K.
        freedoms: number of degrees of freedom.
    """
    excess = UNLIKELY / max(1, freedoms)
    return max(HOTTEST, temperature * max(GROWTH, 1 + 2 * math.sqrt(excess) + 2 * excess))


class RunawayError(openmm.OpenMMException):
    """Steps have made a System hotter than `hottest`."""


class RunawayWatch:
    """A watch that raises an error if steps have made a System far too hot, or velocities not finite.

    At the end of a call of `step` the caller counts its steps, and looks if a look is due: every `INTERVAL` steps, and
    more often after a start. The watch reads the velocities of the Context, unless there is another way to their
    energy, and does not change it.

    Attributes:
        steps: number of steps since the last look.
        pause: number of steps at which a look is due.
    """

    def __init__(
        self, system: openmm.System, freedoms: float, kinetic_energy: Callable[[], float] | None = None
    ) -> None:
        """
        Args:
            system: openmm.System.
            freedoms: number of degrees of freedom.
            kinetic_energy: returns that of all atoms, kJ/mol, and no finite number where it is no number; None: it is
                computed from the velocities of the Context.
        """
        self._kinetic_energy = kinetic_energy
        self._masses = tables.masses(system)
        self._atoms = int(np.count_nonzero(self._masses))
        self._freedoms = max(1, freedoms)
        self.forget()

    def forget(self) -> None:
        """Forget the start, since positions or velocities were set."""
        self._start: float | None = None
        self.steps = 0
        self.pause = FIRST_LOOK

    def begin(self, context: openmm.Context) -> None:
        """Store the temperature of a new start, before its first step."""
        if self._start is None:
            self._start = self._temperature(context)

    def look(self, context: openmm.Context, step: float, bath: float = 0.0) -> None:
        """Check the temperature after steps.

        Args:
            context: openmm.Context, for which `begin` was called before the steps.
            step: length of a step, ps.
            bath: temperature of the heat bath, K; 0 without one.

        Raises:
            RunawayError: the System is too hot, or a velocity is not finite.
        """
        # A System that a hot bath has heated may be cooled later.
        start = max(self._start or 0.0, bath)
        self._start = start
        self.steps = 0
        self.pause = min(2 * self.pause, INTERVAL)
        temperature = self._temperature(context)
        if not math.isfinite(temperature):
            raise RunawayError(
                f"Steps of {1000 * step:.3g} fs have made velocities that are not finite. Is the step too long, or did "
                "atoms overlap at the start? Take a shorter step, or minimize the energy first; with engine='native' "
                "also try engine='exact', since OpenMM cannot satisfy all constraints"
            )
        if self._atoms >= FEWEST_ATOMS and temperature > hottest(start, self._freedoms):
            raise RunawayError(
                f"Steps of {1000 * step:.3g} fs have raised the temperature to {temperature:.3g} K; "
                f"above {HOTTEST:g} K rigid molecules make no sense. Is the step too long, or did atoms overlap at the "
                "start? Take a shorter step, or minimize the energy first. If nothing helps, call "
                "print(check_forces(context)): it names each Force that is not the gradient of its energy"
            )

    def _temperature(self, context: openmm.Context) -> float:
        """Return the temperature of all atoms, K."""
        energy = self._energy_of(context) if self._kinetic_energy is None else self._kinetic_energy()
        return float(2 * energy / (self._freedoms * GAS_CONSTANT))

    def _energy_of(self, context: openmm.Context) -> float:
        """Return the kinetic energy of all atoms, kJ/mol."""
        state = openmm.Context.getState(context, velocities=True)
        velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        return 0.5 * float(np.einsum("i,ix,ix->", self._masses, velocities, velocities))
