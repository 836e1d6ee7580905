"""Hybrid Monte Carlo of rigid bodies and constrained molecules, for OpenMM users."""

import math

from openmm import unit

from openmm_sier.dynamics.acceptance import usual_steps
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import SIER2V2, Scheme
from openmm_sier.ensembles.metropolis import ACCEPTED, CHECKED_STEP, ERROR, REVERSAL, TRIALS, Metropolis
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.system.arguments import Bodies, ForceGroups, Quantity, step_size


class SIERHMCIntegrator(SIERThermostatIntegrator):
    """Hybrid Monte Carlo: samples of the canonical ensemble without time-step error.

    `integrator.step(1)` makes a trial: a trajectory of `stepsPerTrial` steps of the scheme, from momenta that are drawn
    anew, fully or in part. Its end is accepted or rejected by its true energy; after a rejection the Context is back at
    the start of the trial, with reversed velocities. A step that is too long lowers the acceptance, but causes no bias.
    Every state that the Context ever shows is a sample. An interrupt or an error leaves it at the last one.

    The usual step of SIER2V2, the default scheme, is 9 fs with heavy hydrogens, see `prepare_system`, and 6 fs
    otherwise; other schemes have theirs as `heavy_trial_step` and `trial_step`.

    Note: the constructor takes the step of the scheme (9 fs); `getStepSize()` returns the length of a trial (153 fs
    with 17 steps), and `setStepSize` takes that. The Context's time is that of trials. `getSchemeStepSize` and
    `setSchemeStepSize` are for the step of the scheme.

    A trajectory that cannot be followed to its end, because a force is not finite or constraints cannot be satisfied,
    is rejected. As a check, the first trajectory at each step size, or of longer trials, is run backwards. If it misses
    its start, the integrator stops; `reversalError` is the distance.

    With either engine, random numbers are a function of the seed and of the number of draws so far. Both travel in
    checkpoints, and a State brings the number alone. The total energy less the heat changes only by the energy errors
    of accepted trials.

    With a CMMotionRemover in the System the motion of the centre of mass is removed after each trial. Barostats and
    AndersenThermostats in the System are refused.

    Sources: Duane, Kennedy, Pendleton and Roweth, Phys. Lett. B 195, 216 (1987); Horowitz, Phys. Lett. B 268, 247
    (1991).
    """

    def __init__(
        self,
        temperature: Quantity,
        stepSize: Quantity,
        scheme: Scheme | str = SIER2V2,
        stepsPerTrial: int | None = None,
        frictionCoeff: Quantity | None = None,
        pressure: Quantity | None = None,
        barostatInterval: int = 1,
        bodies: Bodies = None,
        rotation: Rotation = exact,
        engine: str = "auto",
        substeps: int | None = None,
        fastForceGroups: ForceGroups | None = None,
    ):
        """
        Args:
            temperature: a quantity or a number in K, above zero.
            stepSize: step of the scheme, a time quantity or a number in ps.
            scheme: splitting scheme without a bath, or its name; it must be a palindrome.
            stepsPerTrial: steps of the scheme in each trial; None: as many as make 0.15 ps.
            frictionCoeff: a quantity or a number in 1/ps. Momenta keep a factor exp(-friction t) in a trial of length
                t, and the rest is drawn anew; None draws all of them anew.
            pressure: for constant pressure, a quantity or a number in bar; see `SIERLangevinIntegrator`.
            barostatInterval: number of trials between attempts to change the volume.
            bodies, rotation, engine, substeps, fastForceGroups: see `SIERIntegrator`.

        Raises:
            ValueError: a value is not finite or has the wrong sign, or the scheme has a bath or is not a palindrome.
            TypeError: a quantity has the wrong dimension.
        """
        steps = usual_steps(step_size(stepSize)) if stepsPerTrial is None else stepsPerTrial
        trials = Metropolis(temperature, frictionCoeff, steps, pressure=pressure, interval=barostatInterval)
        super().__init__(trials, stepSize, scheme, bodies, rotation, engine, substeps, fastForceGroups)

    # --- what users ask ---

    def getStepsPerTrial(self) -> int:
        """Steps of the scheme in each trial."""
        return self.binding.ensemble.steps_per_trial

    def setStepsPerTrial(self, steps: int) -> None:
        """Set the steps of each trial; the step of the scheme stays."""
        before = self.binding.ensemble.steps_per_trial
        self._change_ensemble(steps_per_trial=steps)
        if self.binding.ensemble.steps_per_trial > before:
            self.setGlobalVariableByName(CHECKED_STEP, 0)

    def getSchemeStepSize(self) -> unit.Quantity:
        """The step of the scheme, a quantity in ps."""
        return self.binding.settings.step * unit.picosecond

    def setSchemeStepSize(self, size: Quantity) -> None:
        """Set the step of the scheme, a time quantity or a number in ps; the number of steps in a trial stays."""
        self.binding.change(step=step_size(size))

    def getFriction(self) -> unit.Quantity:
        """Friction by which momenta are drawn in part, a quantity in 1/ps; infinite where they are drawn anew."""
        friction = self.binding.ensemble.friction
        return (math.inf if friction is None else friction) / unit.picosecond

    def setFriction(self, coeff: Quantity | None) -> None:
        """Set the friction, a quantity or a number in 1/ps; None draws all momenta anew."""
        self._change_ensemble(friction=coeff)

    @property
    def trials(self) -> int:
        """Number of completed trials."""
        return int(self.getGlobalVariableByName(TRIALS))

    @property
    def accepted(self) -> int:
        """Number of accepted trials."""
        return int(self.getGlobalVariableByName(ACCEPTED))

    @property
    def acceptanceRate(self) -> float:
        """The fraction of trials that were accepted; NaN before the first one."""
        return self.accepted / self.trials if self.trials else math.nan

    @property
    def lastEnergyError(self) -> float:
        """Energy at the end of the last trial minus that at its start, in kT; infinite if its trajectory failed.

        NaN before the first trial and after `resetStatistics`.
        """
        return self.getGlobalVariableByName(ERROR) if self.trials else math.nan

    @property
    def reversalError(self) -> float:
        """Largest distance in nm by which an atom missed its start when the first trajectory was followed back.

        NaN before the first trial, and after the trials were made longer.
        """
        return self.getGlobalVariableByName(REVERSAL) if self.getGlobalVariableByName(CHECKED_STEP) else math.nan

    def reported(self) -> dict[str, float]:
        """Additional columns for `ConservationReporter`: the fraction of trials accepted, and the last energy error."""
        return {"Acceptance": self.acceptanceRate, "Energy Error (kT)": self.lastEnergyError}

    def resetStatistics(self) -> None:
        """Count trials from zero again."""
        for name in (TRIALS, ACCEPTED):
            self.setGlobalVariableByName(name, 0)
