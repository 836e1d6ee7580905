"""Bonded forces on some atoms, from a Context that has no other forces, so that they cost no pass over all pairs."""

from collections.abc import Iterable

import numpy as np
import openmm
from numpy.typing import ArrayLike

from openmm_sier.dynamics.backend.sites import as_slice
from openmm_sier.system import own_methods
from openmm_sier.system.bonded_terms import TERMS, WITHOUT_FORCES, bonded_kind, bonded_terms


class SoluteError(ValueError):
    """Fast forces that a Context of bonded forces cannot compute."""


def solute_system(system: openmm.System, atoms: ArrayLike, groups: Iterable[int], rigid: np.ndarray) -> openmm.System:
    """Return a System with nothing but the bonded forces of some force groups, and no particles after the last in them.

    Args:
        system: openmm.System to copy from; it is not changed.
        atoms: particle indices, (m,), on which the forces act.
        groups: force groups, each from 0 to 31.
        rigid: for each particle of `system` the number of its rigid body, -1 for one that is in none. Terms within
            one rigid body do no work.

    Raises:
        SoluteError: a Force of the groups is not a bonded force, or one of its terms acts on an atom that is not in
            `atoms`.
    """
    n = system.getNumParticles()
    moving = np.zeros(n, dtype=bool)
    moving[np.asarray(atoms, dtype=np.int64)] = True
    reduced, wanted = openmm.System(), frozenset(groups)
    last = int(np.max(atoms, initial=-1))
    for force in system.getForces():
        if force.getForceGroup() in wanted and not isinstance(force, WITHOUT_FORCES):
            last = max(last, int(_checked_terms(force, moving, rigid).max(initial=0)))
            reduced.addForce(openmm.XmlSerializer.clone(force))
    # Solutes come before water most often, so that few particles are left.
    for _ in range(last + 1):
        reduced.addParticle(1.0)
    reduced.setDefaultPeriodicBoxVectors(*system.getDefaultPeriodicBoxVectors())
    return reduced


def _checked_terms(force: openmm.Force, moving: np.ndarray, rigid: np.ndarray) -> np.ndarray:
    """Return particles of each term of a bonded Force, (t, k), which act on atoms that move by themselves.

    Raises:
        SoluteError: it is not bonded, or has a term on another atom.
    """
    remedy = (
        f"Put the Force into another group than {force.getForceGroup()} with setForceGroup. If prepare_system put it "
        "there, prepare a new System for these bodies: prepare_system(system, bodies)"
    )
    kind = bonded_kind(force)
    if kind is None:
        possible = ", ".join(kind.__name__ for kind in TERMS)
        raise SoluteError(
            f"{force.getName()} ({type(force).__name__}) is in the fast force group {force.getForceGroup()}, but only "
            f"{possible} can be fast. {remedy}"
        )
    terms = bonded_terms(force)
    bodies = rigid[terms]
    within_one = (bodies[:, 0] >= 0) & (bodies == bodies[:, :1]).all(axis=1)
    for atoms in terms[~moving[terms].all(axis=1) & ~within_one]:
        raise SoluteError(
            f"a {TERMS[kind][0].lower()} of {force.getName()} acts on the atoms {', '.join(map(str, atoms))}, but atom "
            f"{atoms[~moving[atoms]][0]} does not move by itself, and fast forces act only on atoms that do. {remedy}"
        )
    return terms


class SoluteForces:
    """Fast forces on some atoms: a function of their positions, and of attitudes that play no part.

    The Context keeps copies of the Forces, so that changes of parameters, box or Forces do not reach it by themselves.
    `follow` takes over parameters and box; after `updateParametersInContext` a new object is needed.

    Attributes:
        atoms: particle indices of the System, (m,).
    """

    def __init__(self, reduced: openmm.System, atoms: ArrayLike, platform: openmm.Platform, properties: dict[str, str]):
        """
        Args:
            reduced: what `solute_system` gave.
            atoms: particle indices, (m,).
            platform: openmm.Platform, usually that of the Context of all forces.
            properties: of the platform, {name: value}.
        """
        self.atoms = np.asarray(atoms, dtype=np.int64)
        self._integrator = openmm.VerletIntegrator(0.001)
        self._context = openmm.Context(reduced, self._integrator, platform, properties)
        # Other atoms stay anywhere, apart from each other.
        self._positions = np.random.default_rng(0).random((reduced.getNumParticles(), 3))
        self._values = np.empty_like(self._positions)
        # The atoms of one molecule follow each other.
        self._members = as_slice(self.atoms)

    def __del__(self) -> None:
        # Delete it before its System and its integrator, even if the garbage collector deletes all of them.
        if hasattr(self, "_context"):
            del self._context

    def __call__(self, q: np.ndarray, A: np.ndarray | None = None) -> tuple[np.ndarray]:
        """Return forces, (3, m), kJ/mol/nm, at positions (3, m), nm, alone in a tuple."""
        self._positions[self._members] = q.T
        own_methods.set_positions(self._context, self._positions)
        own_methods.get_state(self._context, forces=True)._getVectorAsNumpy(openmm.State.Forces, self._values)
        return (np.ascontiguousarray(self._values[self._members].T),)

    def follow(self, context: openmm.Context) -> bool:
        """Take over the parameters and the box of the Context of all forces; returns whether any was different.

        If so, forces computed before are out of date.
        """
        theirs = own_methods.get_state(context, parameters=True)
        parameters, own = theirs.getParameters(), own_methods.get_state(self._context, parameters=True)
        changed = False
        for name, value in own.getParameters().items():
            if parameters[name] != value:
                self._context.setParameter(name, parameters[name])
                changed = True
        if theirs.getPeriodicBoxVectors() != own.getPeriodicBoxVectors():
            own_methods.set_box(self._context, *theirs.getPeriodicBoxVectors())
            changed = True
        return changed
