"""Measure how fast bonded Forces whose energy is an expression move their atoms, where the atoms are.

Each term gets atoms of its own, on the Reference platform. So one displacement of all of them gives a column of the
second derivatives of every term.
"""

import re
from collections.abc import Collection
from itertools import combinations
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.system.second_context import follow_parameters, reference_context

#: Displacement in nm. In double precision it gives second derivatives to 1e-6 of those of a bond.
DISPLACEMENT = 1e-5

#: kJ/mol. A motion that is further from its minimum than this is no vibration, and its curvature tells no period: the
#: repulsion of two atoms that overlap in a start, or a restraint that is far from where it holds.
FAR = 25.0

#: Pairs of places in the terms, with the terms, (t,), in which their distance is fixed.
HeldPairs = list[tuple[int, int, np.ndarray]]

_FORCE = unit.kilojoule_per_mole / unit.nanometer


class Vibration(NamedTuple):
    """The fastest motion that a term causes.

    Attributes:
        square: of its angular frequency, 1/ps^2.
        atoms: particle indices of the term.
    """

    square: float
    atoms: tuple[int, ...]


def fastest_vibration(
    force: openmm.Force,
    weight: float,
    context: openmm.Context,
    bodies: BodySet,
    mobility: np.ndarray,
    held: Collection[tuple[int, int]],
) -> Vibration | None:
    """Return the fastest motion that one term of a Force that is an expression causes; None if there is none.

    Args:
        force: of the Context's System, or within a Force of it.
        weight: the factor of its energy there.
        context: with positions, box and parameters.
        bodies: of that System. What a term does within one body is no motion.
        mobility: inverse effective masses, (N,), 1/dalton.
        held: pairs of particles whose distances constraints hold, the smaller first.
    """
    atoms, alone = _terms_alone(force, context)
    if not len(atoms):
        return None
    state = openmm.Context.getState(context, positions=True)
    x = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)[atoms]
    gradient, curvature = _derivatives(alone, x)
    weights = np.sqrt(np.repeat(mobility[atoms], 3, axis=1))
    gradient = weight * gradient * weights
    curvature = weight * curvature * weights[:, :, None] * weights[:, None]
    owner = bodies.owners[atoms]
    usable = np.isfinite(curvature).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1)
    if atoms.shape[1] > 1:
        usable &= (owner != owner[:, :1]).any(axis=1) | (owner[:, 0] < 0)
    gradient[~usable], curvature[~usable] = 0, 0
    curvature = _without_held(curvature, x, weights, _held_pairs(atoms, owner, held))
    squares, modes = (part[..., -1] for part in np.linalg.eigh(curvature))
    squares = np.maximum(squares, 0)
    far = np.einsum("ti,ti->t", gradient, modes) ** 2 > 2 * FAR * squares
    squares[far] = 0
    fastest = int(squares.argmax())
    return Vibration(float(squares[fastest]), tuple(atoms[fastest].tolist())) if squares[fastest] > 0 else None


def _terms_alone(force: openmm.Force, context: openmm.Context) -> tuple[np.ndarray, openmm.Context]:
    """Return particles of each term, (t, k), and a Context of copies of all terms, each on k particles of its own."""
    root = ElementTree.fromstring(openmm.XmlSerializer.serialize(force))
    rows: list[list[int]] = []
    for term in (*root.iter("Bond"), *root.iter("Particle")):
        names = sorted((name for name in term.attrib if re.fullmatch(r"index|p\d+", name)), key=lambda n: (len(n), n))
        first = len(rows) * len(names)
        rows.append([int(term.attrib[name]) for name in names])
        term.attrib.update({name: str(first + i) for i, name in enumerate(names)})
    atoms = np.array(rows, dtype=np.int64)
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*openmm.Context.getState(context).getPeriodicBoxVectors())
    system.addForce(openmm.XmlSerializer.deserialize(ElementTree.tostring(root, encoding="unicode")))
    for _ in range(max(1, atoms.size)):
        system.addParticle(1.0)
    alone = reference_context(system)
    follow_parameters(context, alone)
    return atoms, alone


def _derivatives(alone: openmm.Context, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return first (t, 3k) and second (t, 3k, 3k) derivatives of the terms' energies at x (t, k, 3), kJ/mol, nm."""
    terms, k, _ = x.shape

    def forces(places: np.ndarray) -> np.ndarray:
        alone.setPositions(places.reshape(-1, 3))
        found = alone.getState(forces=True).getForces(asNumpy=True).value_in_unit(_FORCE)
        return np.array(found).reshape(terms, 3 * k)

    columns = []
    for shift in DISPLACEMENT * np.eye(3 * k).reshape(3 * k, k, 3):
        columns.append((forces(x - shift) - forces(x + shift)) / (2 * DISPLACEMENT))
    second = np.stack(columns, axis=2)
    return -forces(x), (second + second.transpose(0, 2, 1)) / 2


def _held_pairs(atoms: np.ndarray, owner: np.ndarray, held: Collection[tuple[int, int]]) -> HeldPairs:
    """Find pairs of places whose distance a constraint or a body fixes, with the terms (t,) where that is so."""
    found = []
    for i, j in combinations(range(atoms.shape[1]), 2):
        pairs = np.sort(atoms[:, [i, j]], axis=1)
        fixed = np.array([pair in held for pair in map(tuple, pairs.tolist())], dtype=bool)
        fixed |= (owner[:, i] >= 0) & (owner[:, i] == owner[:, j])
        if fixed.any():
            found.append((i, j, fixed))
    return found


def _without_held(curvature: np.ndarray, x: np.ndarray, weights: np.ndarray, pairs: HeldPairs) -> np.ndarray:
    """Return mass-weighted second derivatives (t, 3k, 3k) by motions that keep the distances of pairs."""
    if not pairs:
        return curvature
    terms, k, _ = x.shape
    rows = np.zeros((terms, len(pairs), k, 3))
    for row, (i, j, fixed) in enumerate(pairs):
        arm = fixed[:, None] * (x[:, i] - x[:, j])
        rows[:, row, i], rows[:, row, j] = arm, -arm
    rows = rows.reshape(terms, len(pairs), 3 * k) * weights[:, None]
    free = np.eye(3 * k) - np.linalg.pinv(rows) @ rows
    return free @ curvature @ free
