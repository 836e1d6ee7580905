"""Integrators compared by studies: those of this package by scheme and free rotation, and OpenMM's own.

A `Method` has any step. A `Contestant` is one at a step, with what its System needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import openmm

from openmm_sier import SIERHMCIntegrator, prepare_system
from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2, SIER4, SIER4G, Scheme
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.prepare.masses import set_hydrogen_masses


class Bath(NamedTuple):
    """Temperature in K, friction in 1/ps, and pressure in bar if one is kept."""

    temperature: float
    friction: float
    pressure: float | None = None


@dataclass(frozen=True)
class Method:
    """An integrator to compare.

    Attributes:
        name: for tables.
        make: step in ps -> integrator; with a bath, step and `Bath` -> integrator.
        forces: evaluations per step.
        order: of its energy error in the step.
        has_bath: whether it keeps a temperature.
    """

    name: str
    make: Callable[..., openmm.Integrator]
    forces: int = 1
    order: int = 2
    has_bath: bool = False

    def at(self, step: float, **needs: Any) -> Contestant:
        """Return this method at a step in fs; `needs` are attributes of `Contestant`."""
        return Contestant(self, step, **needs)

    def of_openmm(self) -> Method:
        """Return this method with its name in comparisons with the package."""
        return replace(self, name=f"OpenMM {self.name}")


@dataclass(frozen=True)
class OwnMethod(Method):
    """An integrator of this package, with its scheme and the free-rotation map in it."""

    scheme: Scheme = SIER2
    rotation: Rotation = rotation.exact


@dataclass(frozen=True)
class Contestant:
    """A method at a step, with the System that it is given.

    Attributes:
        method: without a step.
        step: fs.
        hydrogens: their mass in dalton, in water too; None leaves them as the box has them.
        prepared: whether its System is.
        detail: what its name has after the step.
        steps: made by one call of `step(1)`, as in a trial of hybrid Monte Carlo.
        friction: of its bath, 1/ps; None takes that of the study.
        only_rigid: whether its step is too long for anything but rigid molecules.
    """

    method: Method
    step: float
    hydrogens: float | None = None
    prepared: bool = False
    detail: str = ""
    steps: int = 1
    friction: float | None = None
    only_rigid: bool = False

    @property
    def name(self) -> str:
        return f"{self.method.name}, {self.step:g} fs{self.detail}"

    @property
    def duration(self) -> float:
        """Simulated time of one call of `step(1)`, fs."""
        return self.step * self.steps

    @property
    def forces(self) -> int:
        """Evaluations in a step."""
        return self.method.forces

    def of_openmm(self) -> Contestant:
        """Return this contestant with the name that it has beside those of the package."""
        return replace(self, method=self.method.of_openmm())

    def integrator(self, bath: Bath) -> openmm.Integrator:
        """Return a new integrator."""
        if not self.method.has_bath:
            return self.method.make(1e-3 * self.step)
        own_bath = bath if self.friction is None else bath._replace(friction=self.friction)
        return self.method.make(1e-3 * self.step, own_bath)

    def fit(self, system: openmm.System) -> None:
        """Set the masses of hydrogens in the System, and prepare it."""
        if self.prepared:
            prepare_system(system, hydrogenMass=self.hydrogens)
        elif self.hydrogens is not None:
            set_hydrogen_masses(system, self.hydrogens)


# --- OpenMM's own ---


def _middle(step: float, bath: Bath) -> openmm.Integrator:
    return openmm.LangevinMiddleIntegrator(bath.temperature, bath.friction, step)


def _several_steps(step: float, bath: Bath) -> openmm.Integrator:
    """Return OpenMM's MTSLangevin, with four inner steps of the forces that preparing puts into group 1."""
    return openmm.MTSLangevinIntegrator(bath.temperature, bath.friction, step, [(0, 1), (1, 4)])


VERLET = Method("Verlet", openmm.VerletIntegrator)
MIDDLE = Method("LangevinMiddle", _middle, has_bath=True)
SEVERAL_STEPS = Method("MTSLangevin", _several_steps, has_bath=True)


# --- of this package ---


def of_scheme(scheme: Scheme, turn: Rotation = rotation.exact, name: str = "", **options: Any) -> OwnMethod:
    """A scheme at constant energy.

    Args:
        scheme: what is done in a step.
        turn: the free-rotation map in it.
        name: for tables; that of the scheme unless given.
        options: of `SIERIntegrator`.
    """
    make = partial(SIERIntegrator, scheme=scheme, rotation=turn, **options)
    return OwnMethod(name or scheme.name, make, scheme.force_evaluations, scheme.order, False, scheme, turn)


def in_bath(scheme: Scheme = SIER2, name: str = "", **options: Any) -> OwnMethod:
    """A scheme in a heat bath; `options` are those of `SIERLangevinIntegrator`, others as of `of_scheme`."""

    def make(step: float, bath: Bath) -> openmm.Integrator:
        return SIERLangevinIntegrator(bath.temperature, bath.friction, step, scheme, pressure=bath.pressure, **options)

    return OwnMethod(name or scheme.name, make, scheme.force_evaluations, scheme.order, True, scheme)


def trials(scheme: Scheme, steps: int, name: str = "", **options: Any) -> OwnMethod:
    """Hybrid Monte Carlo with trials of a number of steps; `options` are those of `SIERHMCIntegrator`.

    Momenta keep a part by the friction of the bath, unless an option says otherwise.
    """

    def make(step: float, bath: Bath) -> openmm.Integrator:
        arguments = {"frictionCoeff": bath.friction, "pressure": bath.pressure} | options
        return SIERHMCIntegrator(bath.temperature, step, scheme, steps, **arguments)

    return OwnMethod(name or f"{scheme.name} HMC", make, scheme.force_evaluations, scheme.order, True, scheme=scheme)


#: The four integrators that van Zon and Schofield (2007) compare.
PAPER = (
    of_scheme(SIER2, rotation.mrdl, "MRDL"),
    of_scheme(SIER2, rotation.sej4, "SEJ4"),
    of_scheme(SIER2),
    of_scheme(SIER4),
)

#: The schemes of the catalogue, by lower-case name.
SCHEMES = {name: of_scheme(scheme) for name, scheme in CATALOGUE.items()}

#: OpenMM's Verlet with SETTLE and the schemes of the catalogue.
CONSTANT_ENERGY: dict[str, Method] = {"verlet": VERLET.of_openmm(), **SCHEMES}

# --- methods of several studies ---

#: What a System gets for long steps in a bath.
HEAVY: dict[str, Any] = {"hydrogens": 4.0, "prepared": True}


def middle_in_rigid_water(step: float, detail: str = "") -> Contestant:
    """Return LangevinMiddle with heavy hydrogens, at a step of SIER2, which it bears in rigid water alone."""
    return MIDDLE.at(step, **HEAVY, only_rigid=True, detail=detail)


def several_steps(step: float, **more: Any) -> Contestant:
    """Return MTSLangevin with heavy hydrogens."""
    return SEVERAL_STEPS.at(step, **HEAVY, **more)


def own(step: float, **more: Any) -> Contestant:
    """Return SIER2 in a bath, with heavy hydrogens unless `more` says otherwise."""
    return in_bath().at(step, **(HEAVY | more))


def more_inner_steps(step: float, substeps: int, detail: str) -> Contestant:
    """Return SIER2 in a bath, with heavy hydrogens and so many inner steps in half a step."""
    return in_bath(substeps=substeps).at(step, **HEAVY, detail=detail)


def turned_more(step: float, friction: float) -> Contestant:
    """Return SIER2 in a bath with 1/ps for translations and a larger friction for rotations, 1/ps."""
    method = in_bath(rotationalFriction=friction)
    return method.at(step, **HEAVY, friction=1.0, detail=f", 1/ps, rotations {friction:g}/ps")


def exact(step: float, steps: int) -> Contestant:
    """Return hybrid Monte Carlo with trials of a number of steps."""
    return trials(SIER4G, steps).at(step, **HEAVY, steps=steps)
