"""Symplecticity: trajectories from one place with all velocities form a Lagrangian manifold at any time.

Let two of them differ from a third by little. The sum of m (dx1 dv2 - dx2 dv1) over all atoms, which is zero at the
start, stays so: it is the canonical form, since bodies and constraints allow atoms no other motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import strategies as st

from tests.laws.examples import SIMPLE, WITH_BODIES
from tests.laws.law import Law
from tests.laws.methods import Method, methods
from tests.laws.mixture_strategies import moved
from tests.laws.mixtures import Mixture
from tests.laws.runs import Run, started
from tests.support.waters import phase_point

#: Number of steps.
STEPS = 4

#: Differences of velocities, of thermal ones.
SMALL = 1e-3

#: Relative to the products of which the form is the sum: rounding over `SMALL`, and OpenMM's solvers, which stop at
#: 1e-10 nm, over differences of 1e-6 nm or more; of third derivatives the square of `SMALL` times powers of step and
#: frequency. Torques that are wrong by 1 % give 1e-6.
FORM = {"exact": 1e-8, "native": 1e-6, "kernels": 1e-8}

#: In a box a pair may cross the cut-off between two trajectories, where its force jumps: once in a thousand runs. A map
#: that is not canonical shows in each of so many pairs of directions.
DRAWS = 3

#: Forces of single precision are good to 1e-7 of 10^4 kJ/mol/nm, which displace a hydrogen by 1e-8 nm.
FORM_IN_SINGLE_PRECISION = 0.02

#: This scheme displaces atoms by finite distances, and is symplectic to the fifth order of the step only.
ALMOST = "SIER4G"


@dataclass(frozen=True)
class Symplectic:
    """A mixture that a method at constant energy moves from one place with several velocities."""

    mixture: Mixture
    method: Method
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        allowed = FORM[run.method.engine] if self.platform == "Reference" else FORM_IN_SINGLE_PRECISION
        forms = []
        for draw in range(DRAWS if run.is_periodic else 1):
            forms.append(self._form(run, draw))
            if abs(forms[-1]) <= allowed:
                return
        raise AssertionError(f"the canonical form is {', '.join(f'{form:.1e}' for form in forms)} of its terms")

    def _form(self, run: Run, draw: int) -> float:
        """Return the canonical form of two directions, relative to its terms."""
        (x1, v1), (x2, v2) = self._differences(run, draw)
        size = np.linalg.norm(x1) * np.linalg.norm(v2) + np.linalg.norm(x2) * np.linalg.norm(v1)
        return float(np.sum(x1 * v2 - x2 * v1) / size)

    def _differences(self, run: Run, draw: int) -> list[np.ndarray]:
        """Return derivatives of positions and velocities at the end by two of the start, weighted by roots of masses.

        Each is of the shape (2, N, 3).
        """
        x, v = phase_point(run.context)
        roots = np.sqrt(run.masses)[:, None]
        rng = np.random.default_rng([self.mixture.seed, draw])
        view = run.view()
        result = []
        for _ in range(2):
            view.velocities = SMALL * np.divide(rng.normal(size=x.shape), roots, out=np.zeros_like(x), where=roots > 0)
            change = run.projected(view)
            ends = []
            for sign in (1, -1):
                run.context.setPositions(x)
                run.context.setVelocities(v + sign * change)
                run.integrator.step(STEPS)
                ends.append(np.array(phase_point(run.context)))
            result.append(roots * (ends[0] - ends[1]))
        return result


def cases(platform: str) -> st.SearchStrategy[Symplectic]:
    """Draw a mixture without a CMMotionRemover, which is no canonical map, and a method that is symplectic."""
    drawn = moved(methods(("SIERIntegrator",)))
    return drawn.map(lambda pair: Symplectic(replace(pair[0], remover=0), symplectic(pair[1]), platform))


def symplectic(method: Method) -> Method:
    """Return a method with a scheme that is symplectic."""
    return method.having(scheme="SIER4") if method.get("scheme") == ALMOST else method


LAW = Law("symplectic", cases, few=12)


@LAW.numbers()
def test_trajectories_from_one_place_keep_the_canonical_form(examples):
    LAW.hold(examples)


@pytest.mark.parametrize("scheme", ["SIER2", "SIER2V2", "SIER4", "SIER4V"])
@pytest.mark.parametrize(("engine", "bodies"), [("exact", "named"), ("native", "held"), ("native", "free")])
def test_each_scheme_keeps_the_canonical_form(engine, bodies, scheme):
    method = replace(SIMPLE[0], engine=engine).having(scheme=scheme)
    Symplectic(replace(WITH_BODIES[bodies], surroundings="vacuum"), method).check()
