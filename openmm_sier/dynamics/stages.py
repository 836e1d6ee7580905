"""Stages of splitting schemes."""

from typing import NamedTuple

KICK = "kick"
GRADIENT_KICK = "gradient kick"
DRIFT = "drift"
BATH = "bath"

#: Drifts on either side of a bath. With fast forces the bath is in the middle of an inner step, see `constrained`.
DRIFT_TO_BATH = "drift to bath"
DRIFT_FROM_BATH = "drift from bath"

#: The flow of the exact motion that an operator is a part of, if not its own. Flows are the letters of the free algebra
#: in `order`.
FLOWS = {GRADIENT_KICK: KICK, DRIFT_TO_BATH: DRIFT, DRIFT_FROM_BATH: DRIFT}


class Stage(NamedTuple):
    """One operator of a step.

    Attributes:
        operator: name of the operator.
        fraction: fraction of the step by which it advances.
        shift: displacement of the force of a gradient kick, divided by (step)^2 times the acceleration.
    """

    operator: str
    fraction: float
    shift: float = 0.0

    @property
    def flow(self) -> str:
        """Name of the operator whose exact flow this stage is a part of."""
        return FLOWS.get(self.operator, self.operator)
