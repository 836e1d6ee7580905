"""Draw velocities and satisfy constraints of a Context by this package, where OpenMM's solvers cannot."""

import secrets
from dataclasses import replace
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodyState, RigidBodies
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.noise import generator
from openmm_sier.engines import own_methods
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system import tables
from openmm_sier.system.arguments import quantity_to_float


def draw_velocities(
    context: openmm.Context, bodies: RigidBodies, state: BodyState, temperature: Any, seed: int | None
) -> None:
    """Set velocities from the canonical distribution, as `Context.setVelocitiesToTemperature` does.

    Velocities of single atoms are drawn; the rigid part of their motion, without that along constraints, is canonical
    for bodies.

    Args:
        context: openmm.Context.
        bodies: its bodies.
        state: where they are.
        temperature: a quantity or a number in K.
        seed: of the random numbers; None takes another one each time.

    Raises:
        ValueError: the temperature is negative or not finite.
    """
    kelvins = quantity_to_float("temperature", temperature, unit.kelvin, "K")
    if kelvins < 0:
        raise ValueError(f"temperature must not be negative, got {kelvins} K")
    masses = tables.masses(context.getSystem())
    spread = np.sqrt(GAS_CONSTANT * kelvins * np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0))
    random = generator(secrets.randbelow(2**31) if seed is None else abs(int(seed)), 0, stream=4)
    p, L = bodies.momenta(spread[:, None] * random.standard_normal((len(masses), 3)), state.A)
    write_velocities(context, bodies, replace(state, p=bodies.constraints.project(state.q, p), L=L))


def write_velocities(context: openmm.Context, bodies: RigidBodies, state: BodyState) -> None:
    """Set the velocities of a state's atoms; those of other particles stay."""
    own_methods.set_velocities(context, bodies.move(state, Snapshot(context).velocities))


def write_positions(context: openmm.Context, bodies: RigidBodies, state: BodyState) -> None:
    """Set the positions of a state's atoms and of virtual sites; those of other particles stay."""
    own_methods.set_positions(context, bodies.place(state.q, state.A, Snapshot(context).positions))
    context.computeVirtualSites()
