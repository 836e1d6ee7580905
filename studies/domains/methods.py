"""Integrators of the study, by their names in tables: rigid bodies, springs, or frames of four masses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier import SIER2, FramedSystem, SIERHMCIntegrator, SIERLangevinIntegrator, with_frames
from studies.domains.models import FAST, LINKERS, Model
from studies.units import md


class Made(NamedTuple):
    """Arguments of a Context.

    Attributes:
        system, integrator: of the Context.
        positions: (N, 3), nm.
        framed: the System of frames, if there are any.
    """

    system: openmm.System
    integrator: openmm.Integrator
    positions: np.ndarray
    framed: FramedSystem | None = None


@dataclass(frozen=True)
class Method:
    """An integrator in a bath.

    Attributes:
        name: for tables.
        make: model, step in ps, friction in 1/ps and seed -> what a Context is made of.
        springs: whether springs hold bodies, which are rigid otherwise.
        exact: whether averages have no error of the step.
        inner: whether some forces act in inner steps, whose number follows from the step.
    """

    name: str
    make: Callable[[Model, float, float, int], Made]
    springs: bool = False
    exact: bool = False
    inner: bool = False


#: Steps of a trial of hybrid Monte Carlo.
TRIAL = 10


def _sier2(model: Model, step: float, friction: float, seed: int, fast: set[int] | None = None) -> Made:
    bath = SIERLangevinIntegrator(
        model.temperature,
        friction,
        step,
        SIER2,
        bodies=model.rigid_bodies,
        fastForceGroups=fast,
    )
    bath.setRandomNumberSeed(seed)
    return Made(openmm.XmlSerializer.clone(model.rigid), bath, model.positions)


def _inner(model: Model, step: float, friction: float, seed: int) -> Made:
    """The bonds of linkers act in inner steps, though such a model does not need it at its usual step."""
    moving = _sier2(model, step, friction, seed, {FAST})
    for force in moving.system.getForces():
        if force.getName() == LINKERS:
            force.setForceGroup(FAST)
    return moving


def _hybrid(model: Model, step: float, friction: float, seed: int) -> Made:
    trials = SIERHMCIntegrator(
        model.temperature,
        step,
        stepsPerTrial=TRIAL,
        frictionCoeff=friction,
        bodies=model.rigid_bodies,
    )
    trials.setRandomNumberSeed(seed)
    return Made(openmm.XmlSerializer.clone(model.rigid), trials, model.positions)


def _hybrid_springs(model: Model, step: float, friction: float, seed: int) -> Made:
    trials = SIERHMCIntegrator(model.temperature, step, stepsPerTrial=TRIAL, frictionCoeff=friction)
    trials.setRandomNumberSeed(seed)
    return Made(openmm.XmlSerializer.clone(model.network), trials, model.positions)


def _middle(model: Model, step: float, friction: float, seed: int) -> Made:
    network = openmm.XmlSerializer.clone(model.network)
    return Made(network, _langevin_middle(model, step, friction, seed), model.positions)


def _frames(model: Model, step: float, friction: float, seed: int) -> Made:
    framed = with_frames(model.rigid, model.positions, model.bodies)
    middle = _langevin_middle(model, step, friction, seed)
    return Made(framed.system, middle, np.asarray(md(framed.positions)), framed)


def _langevin_middle(model: Model, step: float, friction: float, seed: int) -> openmm.LangevinMiddleIntegrator:
    middle = openmm.LangevinMiddleIntegrator(model.temperature, friction, step)
    middle.setRandomNumberSeed(seed)
    return middle


#: By the names that the command has.
METHODS = {
    "sier2": Method("SIER2", _sier2),
    "inner": Method("SIER2, bonds in inner steps", _inner, inner=True),
    "hmc": Method("SIER4G HMC", _hybrid, exact=True),
    "langevinmiddle": Method("LangevinMiddle, springs", _middle, springs=True),
    "springs-hmc": Method("SIER4G HMC, springs", _hybrid_springs, springs=True, exact=True),
    "frames": Method("LangevinMiddle, frames", _frames),
}
