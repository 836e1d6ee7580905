"""Bounds at which a run stops because its energy or temperature runs away, and at which its table warns.

The conserved energy H is the total energy less the heat that a heat bath and moves of the volume have added. It is
compared with the kinetic energy K, since energy that an integrator creates ends as heat, about half of it as kinetic
energy: a liquid whose H has grown by K/10 is hotter by a twentieth.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from openmm_sier.cli.plan import Plan
from openmm_sier.dynamics.bodies import NotFiniteError
from openmm_sier.engines.temperature import DegreesOfFreedom
from openmm_sier.measure.observables import energy_error, number_of_windows
from openmm_sier.measure.statistics import rms
from openmm_sier.observe import conservation
from openmm_sier.observe.stock import BrokenDownError
from openmm_sier.system.runaway import hottest

#: Column of the log with H.
ENERGY = "Conserved Energy (kJ/mole)"

#: Exit code of a run that was stopped for this reason.
EXIT_CODE = 3

#: Change of H within `WINDOW` ps, over K, that stops a run. A liquid is then heated by 15 K/ps. In water at 297 K the
#: change is at most 0.0009 for SIER2 at its usual 2 fs and 0.016 at 8 fs, and 0.0001 for SIER4G at its usual 6 fs.
FASTEST, WINDOW = 0.1, 1.0

#: Change of H since the start, over K, that stops a run at constant energy. The liquid is then hotter or colder by a
#: quarter. With a heat bath there is no such bound, since the bath takes up what slowly accumulates.
LARGEST = 0.5

#: rms(H)/rms(V) above which the final table warns. Recommended steps give SIER2 0.9 to 1.3 % and the schemes of fourth
#: order 0.01 to 0.41 %, by water model; these bounds are two to three times the largest values.
LARGEST_FLUCTUATION = {2: 0.03, 4: 0.01}

#: Fewest rows of a log that tell a fluctuation.
FEWEST_ROWS = 10


class Runaway(RuntimeError):
    """Energy or temperature has run away."""

    exit_code = EXIT_CODE


class Guard:
    """Watches one run.

    Attributes:
        start: H at the start of the run, kJ/mol; None before the first row.
    """

    def __init__(self, plan: Plan, dof: DegreesOfFreedom, log: Mapping[str, np.ndarray] | None = None):
        """Watch a run with these degrees of freedom; the log is that of a run that is continued."""
        self._plan = plan
        self._bounds = [hottest(plan.temperature, number) for number in dof]
        self._start: float | None = None if log is None else float(log[ENERGY][0])
        self._recent: deque[tuple[float, float]] = deque()
        self._kinetic_sum, self._looks = 0.0, 0

    def look(self, values: Mapping[str, float]) -> None:
        """Compare a row of the log with the bounds.

        Raises:
            Runaway: a bound is passed.
        """
        self.look_at_temperatures(*(values.get(name, math.nan) for name in conservation.TEMPERATURES))
        time, energy = values["Time (ps)"], values[ENERGY]
        if not math.isfinite(energy if self._plan.counts_heat else values["Total Energy (kJ/mole)"]):
            raise Runaway("the energy is not finite")
        if not self._plan.counts_heat:
            return
        self._kinetic_sum, self._looks = self._kinetic_sum + values["Kinetic Energy (kJ/mole)"], self._looks + 1
        typical = self._kinetic_sum / self._looks
        self._start = energy if self._start is None else self._start
        self._recent.append((time, energy))
        # The first row kept is the last one from before the window, so that no change goes unseen.
        while len(self._recent) > 1 and time - self._recent[1][0] >= WINDOW:
            self._recent.popleft()
        then, before = self._recent[0]
        bounds = [(energy - before, FASTEST * max(1.0, (time - then) / WINDOW), f"within {time - then:.3g} ps")]
        if self._plan.ensemble == "nve":
            bounds.append((energy - self._start, LARGEST, "since the start"))
        for change, part, when in bounds:
            # Rounding moves the energy of bodies at rest.
            if abs(change) > part * typical + 1e-6 * (1 + abs(self._start)):
                raise Runaway(
                    f"the conserved energy has changed by {change:+.3g} kJ/mol {when}, by more than the "
                    f"{part * typical:.3g} kJ/mol that its kinetic energy allows"
                )

    def look_at_temperatures(self, *temperatures: float) -> None:
        """Compare temperatures in K, in the order of `TEMPERATURES`, with the bounds.

        NaN stands for no degrees of freedom; the last temperatures may be left out.

        Raises:
            Runaway: a bound is passed.
        """
        for name, value, bound in zip(("T_trans", "T_rot", "T_flexible"), temperatures, self._bounds, strict=False):
            if value > bound:
                raise Runaway(f"{name} is {value:.3g} K, above {bound:.4g} K")


def is_runaway(error: BaseException) -> bool:
    """Whether a step failed because forces or positions are not finite."""
    # OpenMM has one class for all its errors.
    broken = isinstance(error, BrokenDownError) or isinstance(error.__context__, NotFiniteError)
    return broken or "coordinate is NaN" in str(error)


def likely_cause(plan: Plan) -> str:
    """Why a run with this plan may have run away, and what to do."""
    usual, name = plan.method.usual_step, plan.method.name
    if plan.dt > usual:
        return f"the step of {plan.dt:g} fs is too long for {name}, for which {usual:g} fs is usual: --dt {usual:g}"
    return (
        f"the step of {plan.dt:g} fs is not above the {usual:g} fs that is usual for {name} and rigid water: flexible "
        "bonds, overlaps at the start (--minimize) or too short an equilibration may be the cause"
    )


def fluctuation_warning(plan: Plan, log: Mapping[str, np.ndarray]) -> str | None:
    """A warning where the energy fluctuates more than it does with the scheme's usual step; None where it does not.

    Hybrid Monte Carlo draws none: too long a step costs acceptance there, not exactness.

    H is taken about a straight line in each window, so that neither a slow drift counts nor the random walk that a heat
    bath causes; see `energy_fluctuation`.

    Args:
        plan: of the run.
        log: its columns, see `openmm_sier.observe.conservation.COLUMNS`.
    """
    t, H, V = (log[name] for name in ("Time (ps)", ENERGY, "Potential Energy (kJ/mole)"))
    # Where the potential energy hardly changes, the ratio shows only rounding to single precision.
    if plan.ensemble == "hmc" or np.isnan(H).any() or len(t) < FEWEST_ROWS or rms(V) < 1e-6 * (1 + np.abs(V).mean()):
        return None
    bound = LARGEST_FLUCTUATION[2 if plan.method.order == 2 else 4]
    if plan.ensemble != "nve":
        # The random walk goes further in the longer windows of sparse rows.
        bound *= math.sqrt(max(1.0, (t[-1] - t[0]) / number_of_windows(t)))
    found = energy_error(t, H, V)
    if found <= bound:
        return None
    return f"{100 * found:.2g} %, more than the {100 * bound:.2g} % of a good step; {likely_cause(plan)}"
