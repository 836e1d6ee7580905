"""The four integrators that the paper compares, a scheme and a free-rotation map inside it; what experiments share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.schemes import SIER2, SIER4, Scheme

#: ps in one fs.
FS = 1e-3

#: Progress of an experiment: what is being done, and the fraction of the whole that is done.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Method:
    """An integrator.

    Attributes:
        name: as in the paper.
        scheme: what is done in a step.
        rotation: the free-rotation map in it.
    """

    name: str
    scheme: Scheme
    rotation: Rotation

    @property
    def forces(self) -> int:
        """Force evaluations per step, the paper's f."""
        return self.scheme.force_evaluations


METHODS = (
    Method("MRDL", SIER2, rotation.mrdl),
    Method("SEJ4", SIER2, rotation.sej4),
    Method("SIER2", SIER2, rotation.exact),
    Method("SIER4", SIER4, rotation.exact),
)
