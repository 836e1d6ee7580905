"""Checks of forces: `check_forces` finds the Force that is not the gradient of its energy, and blames no other one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import openmm
from hypothesis import strategies as st

from openmm_sier import check_forces
from tests.laws.law import Law
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import SURROUNDINGS, Mixture, is_frozen
from tests.support.waters import phase_point, plain_context

#: kJ/mol/nm^2.
STRENGTH = 100.0


def well(state: openmm.State) -> tuple[float, np.ndarray]:
    """Return the energy and the forces of wells."""
    x = state.getPositions(asNumpy=True)._value
    return STRENGTH * float((x**2).sum()) / 2, -STRENGTH * x


def too_strong(state: openmm.State) -> tuple[float, np.ndarray]:
    """Return the energy of wells, and forces that are a tenth too large."""
    energy, forces = well(state)
    return energy, 1.1 * forces


def twist(state: openmm.State) -> tuple[float, np.ndarray]:
    """Return no energy, and forces about an axis."""
    x = state.getPositions(asNumpy=True)._value
    return 0.0, STRENGTH * np.stack([-x[:, 1], x[:, 0], np.zeros(len(x))], axis=1)


#: Forces, and whether they are the gradient of their energy.
FORCES = {"well": (well, True), "too strong": (too_strong, False), "twist": (twist, False)}


@dataclass(frozen=True)
class ForceChecks:
    """A mixture with one more Force, of which `FORCES` says whether it is the gradient of its energy."""

    mixture: Mixture
    added: str
    platform: str = "Reference"

    def check(self) -> None:
        built = self.mixture.build()
        function, is_gradient = FORCES[self.added]
        added = built.system.addForce(openmm.PythonForce(function))
        context = plain_context(built.system, built.positions, self.platform)
        before = phase_point(context)
        result = check_forces(context)
        found = [fault.number for fault in result.faults]
        assert found == ([] if is_gradient else [added]), f"faults of Forces {found}, and {added} is {self.added}"
        assert added not in [doubt.number for doubt in result.doubts], f"{added} is in doubt"
        assert all(map(np.array_equal, phase_point(context), before)), "the Context is another one"


# --- the law ----------------------------------------------------------------------------------------------------------


def cases(platform: str) -> st.SearchStrategy[ForceChecks]:
    """Draw a mixture without frozen atoms, on which forces are not compared."""
    moving = mixtures(SURROUNDINGS).filter(lambda each: not is_frozen(each))
    return st.builds(ForceChecks, moving, st.sampled_from(list(FORCES)), st.just(platform))


FORCE_CHECKS = Law("force-checks", cases, few=5)


@FORCE_CHECKS.numbers()
def test_the_force_that_is_no_gradient_is_found(examples):
    FORCE_CHECKS.hold(examples)
