"""Show what `tune` finds: schemes with their steps, trial lengths, and what they cost, as tables."""

import math
from typing import NamedTuple

from openmm_sier.dynamics.acceptance import spread_at
from openmm_sier.dynamics.schemes import Scheme


class StepFound(NamedTuple):
    """Results of trials at one step size.

    Attributes:
        step: ps.
        spread: standard deviation of the energy error, kT; infinite if most trajectories failed, or were refused.
        acceptance: mean of min(1, exp(-error)).
        seconds: for a ps of trajectories.
    """

    step: float
    spread: float
    acceptance: float
    seconds: float = math.nan


class SchemeFound(NamedTuple):
    """Results of trials with one scheme.

    Attributes:
        scheme: with which trials were made.
        step: the best one that was found, ps; NaN if there is none.
        acceptance: predicted from the spread of the energy errors at this step.
        seconds: for a ps of trajectories that are accepted; infinite if there is no step.
        tried: the steps that were tried, in order.
        refused: the reason, if none can be taken.
        substeps: number of steps into which drifts were divided; None for the usual one.
    """

    scheme: Scheme
    step: float
    acceptance: float
    seconds: float
    tried: tuple[StepFound, ...]
    refused: str = ""
    substeps: int | None = None

    def is_of(self, scheme: Scheme, substeps: int | None) -> bool:
        """Return whether a step was found for a scheme and its substeps."""
        return not self.refused and (self.scheme, self.substeps) == (scheme, substeps)

    @property
    def name(self) -> str:
        """Return the name of the scheme, with the number of substeps if it is not the usual one."""
        return self.scheme.name if self.substeps is None else f"{self.scheme.name}/{self.substeps}"

    def __str__(self) -> str:
        """Return every step that was tried, and the best one."""
        if self.refused:
            return f"{self.name:>10}  {self.refused}"
        lines = [
            f"{self.name:>10}{1e3 * each.step:10.4g}{each.spread:10.3g}{each.acceptance:12.3f}"
            f"{each.seconds / each.acceptance if each.acceptance else math.inf:12.3g}"
            for each in self.tried
        ]
        best = f"{'taken':>10}{1e3 * self.step:10.4g}{spread_at(self.acceptance):10.3g}{self.acceptance:12.3f}"
        return "\n".join([*lines, f"{best}{self.seconds:12.3g}"])


class LengthFound(NamedTuple):
    """Results of trials of one length.

    Attributes:
        steps: number of steps in a trial.
        acceptance: mean of min(1, exp(-error)).
        forces: number of force evaluations in a trial.
        inefficiency: number of trials per independent sample of the potential energy, with its standard error.
        seconds: for a trial.
        refused: the reason, if there were no trials.
    """

    steps: int
    acceptance: float = math.nan
    forces: float = math.nan
    inefficiency: tuple[float, float] = (math.inf, math.nan)
    seconds: float = math.nan
    refused: str = ""

    @property
    def cost(self) -> tuple[float, float]:
        """Return force evaluations per independent sample of the potential energy, with the standard error."""
        value, error = self.inefficiency
        return value * self.forces, error * self.forces

    @property
    def duration(self) -> tuple[float, float]:
        """Return seconds per independent sample of the potential energy, with the standard error."""
        value, error = self.inefficiency
        return value * self.seconds, error * self.seconds

    def __str__(self) -> str:
        """Return trials, forces and seconds for an independent potential energy; ? marks an unknown error."""
        if self.refused:
            return f"{self.steps:10}  {self.refused}"
        (trials, error), (forces, uncertain), (seconds, beside) = self.inefficiency, self.cost, self.duration
        known = math.isfinite(error)
        errors = (f"{error:.1f}", f"{uncertain:.0f}", f"{beside:.2g}") if known else ("?", "?", "?")
        costs = f"{trials:.1f} ± {errors[0]}, {forces:.0f} ± {errors[1]}, {seconds:.3g} ± {errors[2]}"
        return f"{self.steps:10}{self.acceptance:12.3f}  {costs}"


class Tuning(NamedTuple):
    """Results of `tune`; print them as tables.

    Attributes:
        scheme: the cheapest.
        schemeStepSize: ps.
        stepsPerTrial: number of steps in a trial.
        schemes: the schemes that were compared; each has `scheme`, `step` in ps, `acceptance`, `seconds`, `tried` and
            `refused`.
        lengths: the lengths that were compared with the cheapest scheme; each has `steps`, `acceptance`, `forces`,
            `inefficiency`, `seconds` and `refused`.
        isSet: whether the Context has it; otherwise scheme or substeps are others, which need a new integrator.
        substeps: number of steps into which a drift is divided; None for the usual one.
    """

    scheme: Scheme
    schemeStepSize: float
    stepsPerTrial: int
    schemes: tuple[SchemeFound, ...]
    lengths: tuple[LengthFound, ...]
    isSet: bool = True
    substeps: int | None = None

    def __str__(self) -> str:
        trial = f"{self.stepsPerTrial} in a trial"
        if self.substeps is not None:
            trial += f", drifts in {self.substeps} substeps"
        lines = [
            "Hybrid Monte Carlo tuned:",
            f"{self.scheme.name}, steps of {1e3 * self.schemeStepSize:.4g} fs, {trial}",
            "",
            "    scheme   step/fs     sd/kT  acceptance  s for an accepted ps",
        ]
        lines += [str(each) for each in self.schemes]
        lines += ["", "     steps  acceptance  trials, forces and s for an independent potential energy"]
        lines += [str(each) for each in self.lengths]
        if not self.isSet:
            lines += [
                "",
                "The Context keeps its scheme and substeps, with the best step: make a new integrator for this.",
            ]
        return "\n".join(lines)
