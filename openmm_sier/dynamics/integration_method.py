"""Integration methods: a splitting scheme with its step and all that its operators need."""

from dataclasses import dataclass

from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.plan import inner_steps, steps_with_bath
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck

#: Fewest inner steps of a drift with a bath in its middle. They follow bonds up to usual steps, so that a program that
#: was written for a shorter step serves.
FEWEST_WITH_BATH = 3


@dataclass(frozen=True)
class IntegrationMethod:
    """A splitting scheme with its step and all that its operators need, which an engine executes.

    Attributes:
        scheme: the scheme.
        step: its step, ps.
        rotation: free-rotation map.
        substeps: number of steps into which a drift is divided; None leaves it to the engine.
        fast_groups: bit mask of the force groups that act within drifts.
        bath: the heat bath; None for a scheme without one.
        constant_energy: whether the energy is to be conserved, so that steps that make it drift draw a warning.
        updates_context: whether Forces that change velocities, positions or the box act before each step.
        counts_heat: whether the heat of the bath is counted; None leaves it to the engine.
        trial_steps: number of steps of each trial of hybrid Monte Carlo; 0 without trials.
    """

    scheme: Scheme
    step: float
    rotation: Rotation = exact
    substeps: int | None = None
    fast_groups: int = 0
    bath: OrnsteinUhlenbeck | None = None
    constant_energy: bool = False
    updates_context: bool = True
    counts_heat: bool | None = None
    trial_steps: int = 0

    def inner_step(self, longest: float) -> float:
        """Return the length of the inner steps in the longest drift, ps.

        Args:
            longest: their upper bound, ps, if `substeps` leaves the number open.
        """
        scheme, h = self.scheme, self.step
        if self.substeps is not None:
            return h * scheme.inner_fraction(self.substeps)
        if scheme.bath_divides_drift:
            return h / max(FEWEST_WITH_BATH, steps_with_bath(h, longest))
        drift = h * scheme.longest_drift
        return drift / inner_steps(drift, longest)
