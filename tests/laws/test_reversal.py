"""Reversal: with reversed velocities a run at constant energy goes back to its start, and keeps its angular momentum.

No other trajectory is needed for that, so that mixtures of any kind and size can be tried. A step that begins with
forces or sites of another place, or whose operations are no palindrome, does not come back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from hypothesis import strategies as st

from tests.laws.law import Law
from tests.laws.mechanics import cross
from tests.laws.methods import Method, methods
from tests.laws.mixture_strategies import moved
from tests.laws.mixtures import Mixture, is_frozen
from tests.laws.molecules import Molecule
from tests.laws.runs import started
from tests.support.waters import phase_point

#: Number of steps there, and back.
STEPS = 5

#: nm: rounding, and the relative tolerance of 1e-9 of OpenMM's solvers, which SETTLE's single precision exceeds. Forces
#: of single precision differ by 1e-7 where positions differ by rounding. A force of the place before displaces an atom
#: by 1e-5 nm or more.
MISSED = {"exact": 1e-9, "native": 1e-7, "kernels": 1e-9}
MISSED_IN_SINGLE_PRECISION = 1e-6


#: dalton nm^2/ps, of some 10 that all atoms have: rounding, and constraints that are solved to 1e-13 of their lengths.
TURNED = 1e-8


@dataclass(frozen=True)
class Reversal:
    """A mixture that goes there and back by a method at constant energy."""

    mixture: Mixture
    method: Method
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        start, velocities = phase_point(run.context)
        run.integrator.step(STEPS)
        if self._keeps_turning(run.method.engine):
            turn = turning(run.masses, *phase_point(run.context)) - turning(run.masses, start, velocities)
            assert abs(turn) < TURNED, f"the angular momentum about z changed by {turn:.1e} dalton nm^2/ps"
        for steps in (STEPS, 0):
            run.context.setVelocities(-phase_point(run.context)[1])
            run.integrator.step(steps)
        end, _ = phase_point(run.context)
        missed = float(np.abs(end - start).max())
        allowed = MISSED[run.method.engine] if self.platform == "Reference" else MISSED_IN_SINGLE_PRECISION
        assert missed < allowed, f"{run.method.engine} engine: the start is missed by {missed:.1e} nm"

    def _keeps_turning(self, engine: str) -> bool:
        """Whether nothing turns all atoms about z, along which `Run` pulls; the exact engine keeps what forces do."""
        is_alone = self.mixture.surroundings == "vacuum" and not is_frozen(self.mixture)
        has_direction = any(map(_has_direction, self.mixture.molecules))
        return is_alone and not has_direction and engine == "exact" and self.platform == "Reference"


def _has_direction(molecule: Molecule) -> bool:
    """Return whether a site is displaced along axes of the lab, so that forces on it turn the molecule."""
    within = getattr(molecule, "molecule", None)
    return getattr(molecule, "site", None) == "shifted" or (within is not None and _has_direction(within))


def turning(masses: np.ndarray, x: np.ndarray, v: np.ndarray) -> float:
    """Return the angular momentum of all atoms about the z axis, dalton nm^2/ps."""
    return float((masses[:, None] * cross(x, v)).sum(axis=0)[2])


def cases(platform: str) -> st.SearchStrategy[Reversal]:
    """Draw a mixture without a CMMotionRemover, whose action has no reverse, and a method."""
    drawn = moved(methods(("SIERIntegrator",)))
    return drawn.map(lambda pair: Reversal(replace(pair[0], remover=0), pair[1], platform))


LAW = Law("reversal", cases, few=30)


@LAW.numbers()
def test_reversed_velocities_lead_back_to_the_start(examples):
    LAW.hold(examples)
