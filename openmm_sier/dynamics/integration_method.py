"""Integration methods: a splitting scheme with its step and all that its operators need."""

from dataclasses import dataclass

from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.rotation import exact
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import Thermostat


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
    bath: Thermostat | None = None
    constant_energy: bool = False
    updates_context: bool = True
    counts_heat: bool | None = None
    trial_steps: int = 0
