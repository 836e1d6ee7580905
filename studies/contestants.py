"""Integrators at steps, with the System that each is given: what studies of speed and of averages compare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import openmm

from openmm_sier import SIERHMCIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics.schemes import SIER2, SIER4G, Scheme
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.prepare.masses import set_hydrogen_masses


class Bath(NamedTuple):
    """Temperature in K, friction in 1/ps, and pressure in bar if one is kept."""

    temperature: float
    friction: float
    pressure: float | None = None


@dataclass(frozen=True)
class Contestant:
    """An integrator at a step.

    Attributes:
        method: name without the step.
        step: fs.
        make: (bath, step in ps) -> integrator.
        forces: evaluations in a step.
        hydrogens: their mass in dalton, in water too; None leaves them as the box has them.
        prepared: whether its System is.
        detail: what its name has after the step.
        steps: made by one call of `step(1)`, as in a trial of hybrid Monte Carlo.
        friction: of its bath, 1/ps; None takes that of the study.
        has_bath: whether it keeps a temperature.
        only_rigid: whether its step is too long for anything but rigid molecules.
    """

    method: str
    step: float
    make: Callable[[Bath, float], openmm.Integrator]
    forces: int = 1
    hydrogens: float | None = None
    prepared: bool = False
    detail: str = ""
    steps: int = 1
    friction: float | None = None
    has_bath: bool = True
    only_rigid: bool = False

    @property
    def name(self) -> str:
        return f"{self.method}, {self.step:g} fs{', ' if self.detail else ''}{self.detail}"

    @property
    def duration(self) -> float:
        """Simulated time of one call of `step(1)`, fs."""
        return self.step * self.steps

    def integrator(self, bath: Bath) -> openmm.Integrator:
        """Return a new integrator."""
        mine = bath if self.friction is None else bath._replace(friction=self.friction)
        return self.make(mine, 1e-3 * self.step)

    def fit(self, system: openmm.System) -> None:
        """Give the System masses of hydrogens, and prepare it."""
        if self.prepared:
            prepare_system(system, hydrogenMass=self.hydrogens)
        elif self.hydrogens is not None:
            set_hydrogen_masses(system, self.hydrogens)


# --- functions that make integrators ---


def verlet(_: Bath, step: float) -> openmm.Integrator:
    return openmm.VerletIntegrator(step)


def middle(bath: Bath, step: float) -> openmm.Integrator:
    return openmm.LangevinMiddleIntegrator(bath.temperature, bath.friction, step)


def several_steps(bath: Bath, step: float) -> openmm.Integrator:
    """Return OpenMM's MTSLangevin, with four inner steps of the forces that preparing puts into group 1."""
    return openmm.MTSLangevinIntegrator(bath.temperature, bath.friction, step, [(0, 1), (1, 4)])


def in_bath(bath: Bath, step: float, scheme: Scheme = SIER2, **options: Any) -> openmm.Integrator:
    return SIERLangevinIntegrator(bath.temperature, bath.friction, step, scheme, pressure=bath.pressure, **options)


def at_constant_energy(_: Bath, step: float, scheme: Scheme) -> openmm.Integrator:
    return SIERIntegrator(step, scheme)


def trials(bath: Bath, step: float, steps: int) -> openmm.Integrator:
    return SIERHMCIntegrator(bath.temperature, step, SIER4G, steps, bath.friction, bath.pressure)


# --- what several studies compare ---

#: In a bath with heavy hydrogens OpenMM's own integrator bears the steps of SIER2 too, in rigid water alone.
MIDDLE_IN_RIGID_WATER = Contestant("LangevinMiddle", 9, middle, hydrogens=4.0, prepared=True, only_rigid=True)

SEVERAL_STEPS = Contestant("MTSLangevin", 8, several_steps, hydrogens=4.0, prepared=True)


def own(step: float, **more: Any) -> Contestant:
    """Return SIER2 in a bath, with heavy hydrogens unless `more` says otherwise."""
    return Contestant("SIER2", step, in_bath, **({"hydrogens": 4.0, "prepared": True} | more))


def turned_more(step: float, friction: float) -> Contestant:
    """Return SIER2 in a bath with 1/ps for translations and a larger friction for rotations, 1/ps."""
    make = partial(in_bath, rotationalFriction=friction)
    return replace(own(step), make=make, friction=1.0, detail=f"1/ps, rotations {friction:g}/ps")


def exact(step: float, steps: int) -> Contestant:
    """Return hybrid Monte Carlo with trials of so many steps."""
    make = partial(trials, steps=steps)
    return Contestant("SIER4G HMC", step, make, SIER4G.force_evaluations, 4.0, prepared=True, steps=steps)
