"""Hybrid Monte Carlo of rigid bodies and constrained molecules, for OpenMM users."""

import math

from openmm import unit

from openmm_sier.dynamics.acceptance import TRIAL_FRICTION, usual_steps
from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2V2, Scheme
from openmm_sier.ensembles.metropolis import ACCEPTED, CHECKED_STEP, ERROR, REVERSAL, TRIALS, Metropolis
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.system.arguments import ForceGroups, Quantity, step_size


class SIERHMCIntegrator(SIERThermostatIntegrator):
    """Sample the canonical ensemble by hybrid Monte Carlo, without any error of the step.

    `integrator.step(1)` makes a trial: it draws momenta, follows `stepsPerTrial` steps of the scheme, and accepts or
    rejects the end by its true energy. A trajectory that would be rejected continues, up to twice, and its next end may
    be accepted. After a rejection the Context is back at the start of the trial, with reversed velocities. A step that
    is too long lowers the acceptance and causes no bias. Every state of the Context is a sample, also after an
    interrupt or an error.

    >>> integrator = SIERHMCIntegrator(300*kelvin, 6*femtoseconds, frictionCoeff=2/picosecond)
    >>> simulation = Simulation(topology, system, integrator)
    >>> simulation.context.setPositions(positions)
    >>> simulation.step(2)
    >>> integrator.trials
    2

    The usual step of SIER2V2, the default scheme, is 9 fs with heavy hydrogens, see `prepare_system`, and 6 fs
    otherwise; for other schemes see `heavy_trial_step` and `trial_step`.

    Note: `schemeStepSize`, `getSchemeStepSize` and `setSchemeStepSize` are for the step of the scheme (9 fs). A step
    of the integrator is a trial, so that `getStepSize` and `setStepSize` are for its length (72 fs with 8 steps), as
    are the Context's time and the times of reporters.

    A trial is also rejected if its trajectory has a force that is not finite or constraints that cannot be satisfied.
    The first trajectory at each step size, or of longer trials, is also integrated backwards. If it does not reach its
    start, the integrator stops; `reversalError` is the distance. On a GPU mixed precision makes it smaller than single
    precision, OpenMM's default: `Simulation(topology, system, integrator, platform, {'Precision': 'mixed'})`.

    Random numbers are a function of the seed and of the number of draws so far. Checkpoints contain both, and a State
    the number. Other engines than the exact one take the directions of momenta from OpenMM's random numbers, which
    checkpoints contain. The total energy less the heat changes only by the energy errors of accepted ends.

    With a CMMotionRemover in the System the motion of the centre of mass is removed after each trial. Barostats and
    AndersenThermostats in the System are refused.

    Sources: Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247
    (1991); Campos and Sanz-Serna, J. Comput. Phys. 281, 365 (2015).
    """

    def __init__(
        self,
        temperature: Quantity,
        schemeStepSize: Quantity,
        scheme: Scheme | str = SIER2V2,
        stepsPerTrial: int | None = None,
        frictionCoeff: Quantity | None = TRIAL_FRICTION,
        pressure: Quantity | None = None,
        barostatInterval: int = 1,
        bodies: BodySet | None = None,
        rotation: Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
        extraChances: int | None = None,
    ):
        """
        Args:
            temperature: a quantity or a number in K, above zero.
            schemeStepSize: the step of the scheme, a time quantity or a number in ps.
            scheme: the splitting scheme or its name. It must be a palindrome without a bath.
            stepsPerTrial: number of steps of the scheme in each trial, at least 1; None makes trials of 72 fs.
            frictionCoeff: a quantity or a number in 1/ps, above zero. Momenta keep a factor exp(-friction t) in a trial
                of length t, and the rest is random. None draws all momenta at random, for trials of 0.15 ps or more.
            pressure: for constant pressure, a quantity or a number in bar; None keeps the volume.
            barostatInterval: number of trials between attempts to change the volume, at least 1.
            bodies: the rigid bodies, as in `SIERIntegrator`; None finds them in the System's constraints.
            rotation: see `SIERIntegrator`.
            engine: see `SIERIntegrator`.
            substeps: see `SIERIntegrator`. Fewer steps make a trial cheaper and its energy errors larger; samples are
                exact with any number.
            fastForceGroups: see `SIERIntegrator`.
            extraChances: number of times that a trajectory whose end would be rejected continues by `stepsPerTrial`
                steps; None: 2 for trials of up to 72 fs, 1 up to 108 fs, and 0 for longer ones.

        Raises:
            ValueError: a value is not finite or has the wrong sign, or the scheme has a bath or is not a palindrome.
            TypeError: a quantity has the wrong dimension.
        """
        steps = usual_steps(step_size(schemeStepSize)) if stepsPerTrial is None else stepsPerTrial
        trials = Metropolis(
            temperature, frictionCoeff, steps, extraChances, pressure=pressure, interval=barostatInterval
        )
        super().__init__(trials, schemeStepSize, scheme, bodies, rotation, engine, substeps, fastForceGroups)

    # --- settings and statistics ---

    def getStepsPerTrial(self) -> int:
        """Return the number of steps of the scheme in each trial."""
        return self.impl.ensemble.steps_per_trial

    def setStepsPerTrial(self, steps: int) -> None:
        """Set the number of steps in each trial, at least 1; the step of the scheme stays."""
        before = self.impl.ensemble.steps_per_trial
        self._change_ensemble(steps_per_trial=steps)
        if self.impl.ensemble.steps_per_trial > before:
            self._counts[CHECKED_STEP] = 0.0

    def getExtraChances(self) -> int | None:
        """Return the number of times that a trajectory may continue; None if it depends on the length of trials."""
        return self.impl.ensemble.extra_chances

    def setExtraChances(self, chances: int | None) -> None:
        """Set the number of times that a trajectory whose end would be rejected continues; None: the usual number."""
        self._change_ensemble(extra_chances=chances)
        self._counts[CHECKED_STEP] = 0.0

    def getSchemeStepSize(self) -> unit.Quantity:
        """Return the step of the scheme, a quantity in ps."""
        return self.impl.settings.step * unit.picosecond

    def setSchemeStepSize(self, size: Quantity) -> None:
        """Set the step of the scheme, a time quantity or a number in ps; the number of steps in a trial stays."""
        self.impl.change(step=step_size(size))

    def getFriction(self) -> unit.Quantity:
        """Return the friction for partial draws of momenta, a quantity in 1/ps; infinite for complete draws."""
        friction = self.impl.ensemble.friction
        return (math.inf if friction is None else friction) / unit.picosecond

    def setFriction(self, coeff: Quantity | None) -> None:
        """Set the friction, a quantity or a number in 1/ps; None draws all momenta at random."""
        self._change_ensemble(friction=coeff)

    @property
    def _counts(self) -> dict[str, float]:
        """Numbers of the tally, by name."""
        return self.impl.tally.counts

    @property
    def trials(self) -> int:
        """Number of completed trials."""
        return int(self._counts[TRIALS])

    @property
    def accepted(self) -> int:
        """Number of accepted trials."""
        return int(self._counts[ACCEPTED])

    @property
    def acceptanceRate(self) -> float:
        """Fraction of trials that were accepted; NaN before the first one."""
        return self.accepted / self.trials if self.trials else math.nan

    @property
    def lastEnergyError(self) -> float:
        """Energy after `stepsPerTrial` steps of the last trial minus that at its start, in kT.

        Infinite if the trajectory failed. Later ends, see `extraChances`, do not count. NaN before the first trial and
        after `resetStatistics`.
        """
        return self._counts[ERROR] if self.trials else math.nan

    @property
    def reversalError(self) -> float:
        """Largest displacement of an atom after the first trajectory was integrated forwards and backwards, nm.

        NaN before the first trial, and after the trials were made longer.
        """
        return self._counts[REVERSAL] if self._counts[CHECKED_STEP] else math.nan

    def reported(self) -> dict[str, float]:
        """Return two more columns for `ConservationReporter`: the acceptance rate, and the last energy error."""
        return {"Acceptance": self.acceptanceRate, "Energy Error (kT)": self.lastEnergyError}

    def resetStatistics(self) -> None:
        """Reset the counts of trials to zero."""
        for name in (TRIALS, ACCEPTED):
            self._counts[name] = 0.0
