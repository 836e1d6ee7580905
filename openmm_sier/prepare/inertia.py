"""A mass and moments of inertia that a user gives to bodies, by the masses of their atoms.

A coarse-grained body has few beads, whose masses need not have the moments of what they stand for. Since a body moves
by its mass, its centre and its moments alone, any masses of its beads that have these move it alike. So kinetic
energies, velocities that are drawn and all integrators, those of OpenMM with frames too, agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.index_ranges import as_ranges
from openmm_sier.dynamics.species import Species
from openmm_sier.system import tables
from openmm_sier.system.arguments import Positions, Quantity, checked_positions, checked_system, quantity_to_float
from openmm_sier.system.bound_systems import refuse_bound
from openmm_sier.system.cut_molecules import Wholeness

#: The least mass of an atom over the mean one: an atom without mass would be frozen.
LEAST = 1e-3

#: Relative error of mass and moments up to which masses have them.
ACCURACY = 1e-9

#: Pairs of axes of the products of inertia.
PAIRS = ((0, 1), (0, 2), (1, 2))

_MOMENT = unit.dalton * unit.nanometer**2


def set_inertia(
    system: openmm.System,
    positions: Positions,
    bodies: Sequence[Sequence[int]],
    mass: Quantity,
    moments: Sequence[Quantity] | Quantity,
) -> None:
    """Give bodies a mass and moments of inertia, by the masses of their atoms.

    Call it before the bodies are made, and before `prepare_system`. The centre and the principal axes of each body stay
    where they are.

    >>> set_inertia(system, positions, [range(60)], 500*dalton, [80, 120, 150])

    Args:
        system: the System, in which the masses of the bodies' atoms change.
        positions: positions of its particles, (N, 3), nm or a Quantity, with bodies whole.
        bodies: particle indices of each body, as `select_bodies` returns them. Virtual sites among them are left out.
        mass: mass of each body, a quantity or a number in dalton.
        moments: principal moments of each body, in ascending order, three quantities or numbers in dalton nm^2.

    Raises:
        TypeError: it is no System, or a number is none.
        ValueError: moments are not in ascending order, or one is above the sum of the others, which no body has; or no
            masses of the atoms have them: the message says which multiples of them some have. Add particles without
            interactions then, further out or further in. Or the System has a Context with a SIER integrator already.
            The System is unchanged.
        RigidityError: the periodic boundary cuts a body.
    """
    system = checked_system(system)
    refuse_bound(system)
    x = checked_positions(positions, system.getNumParticles())
    whole = quantity_to_float("mass", mass, unit.dalton, "dalton")
    wanted = _checked_moments(moments)
    if whole <= 0:
        raise ValueError(f"mass must be positive, got {whole:g} dalton")
    present = tables.masses(system)
    wholeness = Wholeness(system)
    found: dict[int, float] = {}
    for body in bodies:
        atoms = np.array([i for i in body if not system.isVirtualSite(int(i))], dtype=np.int64)
        if not len(atoms) or not (present[atoms] > 0).all():
            got = f"atoms {as_ranges(body)}" if len(body) else "no atoms"
            raise ValueError(f"a body must have atoms, and each of them a mass, got {got}")
        wholeness.refuse_cut(x, atoms[None], _described)
        shape = Species.from_coordinates(atoms[None], present[atoms], x[atoms])
        masses = _masses(shape, whole, wanted, _described(atoms))
        found |= dict(zip(atoms.tolist(), masses.tolist(), strict=True))
    for atom, each in found.items():
        system.setParticleMass(atom, each)


def _described(atoms: Any) -> str:
    return f"atoms {as_ranges(atoms)}"


def _checked_moments(moments: Any) -> np.ndarray:
    found = np.array([quantity_to_float("moments", value, _MOMENT, "dalton nm^2") for value in moments])
    if found.shape != (3,) or (np.diff(found) < 0).any() or found[0] < 0:
        raise ValueError(
            f"moments must be three numbers in ascending order, none of them negative, got {found.tolist()}"
        )
    if found[2] > found[0] + found[1] + ACCURACY * found[2]:
        raise ValueError(
            f"moments must be those of a body, the largest at most the sum of the two others, got {found.tolist()}"
        )
    return found


def _masses(shape: Species, mass: float, moments: np.ndarray, name: str) -> np.ndarray:
    """Return masses (k,) of a body's atoms with a mass and moments, about its centre and axes.

    Raises:
        ValueError: there are none; `name` is that of the body in the message.
    """
    sites = shape.sites
    # In these units mass and moments are of the order of 1, and equations are satisfied alike.
    length = max(np.sqrt((sites**2).sum(axis=0).mean()), np.finfo(float).tiny)
    r = sites / length
    squares = np.maximum(moments.sum() / 2 - moments, 0) / (mass * length**2)
    rows = np.vstack([np.ones(r.shape[1]), r, r**2, [r[i] * r[j] for i, j in PAIRS]])
    wanted = np.concatenate([[1.0], np.zeros(3), squares, np.zeros(3)])
    mean = 1 / r.shape[1]
    # As little as possible from shares that are equal.
    shares = mean + np.linalg.lstsq(rows, wanted - rows.sum(axis=1) * mean, rcond=None)[0]
    if not _are_right(rows, wanted, shares, LEAST * mean):
        shares = _bounded(rows, wanted, LEAST * mean, name, moments)
    return mass * shares


def _are_right(rows: np.ndarray, wanted: np.ndarray, shares: np.ndarray, least: float) -> bool:
    return bool((shares >= 0.5 * least).all() and np.abs(rows @ shares - wanted).max() <= ACCURACY)


def _bounded(rows: np.ndarray, wanted: np.ndarray, least: float, name: str, moments: np.ndarray) -> np.ndarray:
    """Return shares of the mass, (k,), at least `least`, of which the largest is as small as possible."""
    from scipy.optimize import linprog

    count = rows.shape[1]
    largest = np.column_stack([np.eye(count), -np.ones(count)])
    equations = np.column_stack([rows, np.zeros(len(rows))])
    cost = np.append(np.zeros(count), 1.0)
    bounds = [*[(least, None)] * count, (None, None)]
    found = linprog(cost, A_ub=largest, b_ub=np.zeros(count), A_eq=equations, b_eq=wanted, bounds=bounds)
    if found.success:
        shares = found.x[:count]
        free = shares > 1.1 * least
        # It is right to 1e-7, and those that may change make it right to rounding.
        shares[free] += np.linalg.lstsq(rows[:, free], wanted - rows @ shares, rcond=None)[0]
        if _are_right(rows, wanted, shares, least):
            return shares
    raise ValueError(
        f"no choice of masses gives {name} the moments {', '.join(f'{each:.4g}' for each in moments)} dalton nm^2 "
        f"about their centre and axes; {_range(rows, wanted, least)}. "
        "Add particles without interactions to the body, further out for larger moments and at its centre for smaller "
        "ones"
    )


def _range(rows: np.ndarray, wanted: np.ndarray, least: float) -> str:
    """Say which multiples of the moments some shares of the mass have."""
    from scipy.optimize import linprog

    count = rows.shape[1]
    squares = np.where((np.arange(len(wanted)) >= 4) & (np.arange(len(wanted)) < 7), wanted, 0.0)
    equations = np.column_stack([rows, -squares])
    bounds = [*[(least, None)] * count, (0, None)]
    ends = []
    for sign in (1, -1):
        cost = np.append(np.zeros(count), sign)
        found = linprog(cost, A_eq=equations, b_eq=wanted - squares, bounds=bounds)
        if not found.success:
            return "no others in these proportions are possible either"
        ends.append(found.x[count])
    return f"possible are {ends[0]:.3g} to {ends[1]:.3g} times these"
