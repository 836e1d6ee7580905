"""Pressures: the diagonal of a molecular pressure tensor follows from momenta of molecules and energies in other boxes.

Another Context of OpenMM stretches the box along an axis, with the centres of molecules, which it does not turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import openmm
from hypothesis import reject
from hypothesis import strategies as st

from openmm_sier.dynamics.constants import BAR
from openmm_sier.observe.pressure import STRAIN, MolecularPressure
from tests.laws.law import Law
from tests.laws.mechanics import with_centres
from tests.laws.methods import Method, methods
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import SURROUNDINGS, Mixture, is_frozen
from tests.laws.runs import SINGLE_ENERGY, Run, View, started
from tests.support.waters import plain_context, platform, properties_of

#: Of energies, kJ/mol.
ROUNDING = {"Reference": 0.0, "CPU": SINGLE_ENERGY, "OpenCL": 0.0}

#: Relative to a derivative or 1 kJ/mol: that of higher ones, beyond what shorter strains show.
CURVATURE = 1e-3


@dataclass(frozen=True)
class Pressure:
    """A mixture in a box, and a method whose integrator may have bodies."""

    mixture: Mixture
    method: Method
    platform: str = "Reference"

    def check(self) -> None:
        run = started(self.mixture, self.method, self.platform)
        context = without_fields(run)
        found = MolecularPressure(context).components(context.getState(positions=True, velocities=True))
        view = View(context)
        potential, shorter = (slopes(run, context, view, strain) for strain in (STRAIN, STRAIN / 2))
        changes = np.abs(potential - shorter)
        rounding = ROUNDING[self.platform] / STRAIN + CURVATURE * (1 + np.abs(potential))
        if (changes > 2 * rounding).any():
            # A pair crosses the cut-off.
            reject()
        masses = [run.masses[atoms].sum() for atoms in run.molecules]
        momenta = [run.masses[atoms] @ view.velocities[atoms] for atoms in run.molecules]
        kinetic = sum(p**2 / m for p, m in zip(momenta, masses, strict=True))
        unit = np.linalg.det(view.box) * BAR
        wrong, allowed = np.abs((kinetic - potential) / unit - found[:3]), (changes + rounding) / unit
        assert (wrong <= allowed).all(), f"components are off by {wrong} bar, and may be by {allowed}"


def without_fields(run: Run) -> openmm.Context:
    """Return a Context of the System of a run without the force that depends on places, at its start."""
    system = openmm.XmlSerializer.clone(run.system)
    for number in reversed(range(system.getNumForces())):
        if isinstance(system.getForce(number), openmm.CustomExternalForce):
            system.removeForce(number)
    integrator = run.method.make(run.built.bodies, ())
    context = openmm.Context(system, integrator, platform(run.name), properties_of(run.name))
    context.setPositions(run.start)
    context.setVelocities(run.built.velocities)
    return context


def slopes(run: Run, context: openmm.Context, view: View, strain: float) -> np.ndarray:
    """Return derivatives of the potential energy by strains along the axes, (3,), kJ/mol."""
    found = []
    for axis in range(3):
        energies = []
        for sign in (1, -1):
            stretch = np.eye(3)
            stretch[axis, axis] += sign * strain
            positions = with_centres(run.masses, view.positions, run.molecules, stretch)
            other = plain_context(context.getSystem(), positions, run.name)
            other.setPeriodicBoxVectors(*(view.box @ stretch))
            other.computeVirtualSites()
            groups = run.integrator.getIntegrationForceGroups()
            energies.append(other.getState(energy=True, groups=groups).getPotentialEnergy()._value)
        found.append((energies[0] - energies[1]) / (2 * strain))
    return np.array(found)


# --- the law ----------------------------------------------------------------------------------------------------------


@st.composite
def cases(draw: st.DrawFn, platform: str) -> Pressure:
    """Draw a mixture in a box, which moves all but frozen atoms."""
    way = draw(methods(("SIERIntegrator",)))
    boxed = mixtures(SURROUNDINGS[1:], named=way.engine == "exact").filter(lambda each: each.form != "none")
    return Pressure(draw(boxed.filter(lambda each: not is_frozen(each))), way, platform)


PRESSURES = Law("pressures", cases, few=8)


@PRESSURES.numbers()
def test_pressures_are_those_of_other_boxes(examples):
    PRESSURES.hold(examples)
