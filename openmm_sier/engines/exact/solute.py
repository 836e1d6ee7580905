"""Bonded forces on some atoms, from a Context of those atoms alone, so that fast forces cost no pass over all atoms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from xml.etree import ElementTree

import numpy as np
import openmm
from numpy.typing import ArrayLike

from openmm_sier.engines.snapshot import read_vectors
from openmm_sier.system.bonded_terms import TERMS, WITHOUT_FORCES, bonded_kind


class SoluteError(ValueError):
    """Fast forces that a Context of some atoms cannot compute."""


def solute_system(
    system: openmm.System, atoms: ArrayLike, groups: Iterable[int], rigid: ArrayLike | None = None
) -> openmm.System:
    """A System of some atoms with the bonded forces of some force groups.

    Args:
        system: openmm.System to copy from; it is not changed.
        atoms: particle indices, (m,), which become the particles 0 .. m-1.
        groups: force groups, each from 0 to 31.
        rigid: for each particle of `system` the number of its rigid body, -1 for one that is in none. Terms within
            one rigid body do no work and are left out. None: no particle is in a rigid body.

    Raises:
        SoluteError: an atom is out of range, named twice or a virtual site; a Force of the groups is not a bonded
            force, or one of its terms acts on an atom that is not in `atoms`.
    """
    atoms = np.asarray(atoms, dtype=np.int64)
    n = system.getNumParticles()
    number = _numbers(system, atoms)
    reduced = openmm.System()
    for atom in atoms.tolist():
        reduced.addParticle(system.getParticleMass(atom))
    reduced.setDefaultPeriodicBoxVectors(*system.getDefaultPeriodicBoxVectors())
    wanted = frozenset(groups)
    rigid = np.full(n, -1) if rigid is None else np.asarray(rigid)
    for force in system.getForces():
        if force.getForceGroup() in wanted and not isinstance(force, WITHOUT_FORCES):
            reduced.addForce(_renumbered(force, number, rigid))
    return reduced


def _numbers(system: openmm.System, atoms: np.ndarray) -> np.ndarray:
    """For each particle its place among the atoms, or -1."""
    n = system.getNumParticles()
    number = np.full(n, -1)
    for place, atom in enumerate(atoms.tolist()):
        if not 0 <= atom < n:
            raise SoluteError(f"fast forces are to act on atom {atom}, the System has {n} particles")
        if number[atom] >= 0:
            raise SoluteError(f"fast forces are to act on atom {atom}, which is named twice")
        if system.isVirtualSite(atom):
            raise SoluteError(
                f"fast forces are to act on atom {atom}, which is a virtual site: name the atoms it depends on"
            )
        number[atom] = place
    return number


def _renumbered(force: openmm.Force, number: np.ndarray, rigid: np.ndarray) -> openmm.Force:
    """A copy of a bonded Force with its atoms renumbered."""
    kind = bonded_kind(force)
    if kind is None:
        possible = ", ".join(kind.__name__ for kind in TERMS)
        raise SoluteError(
            f"{force.getName()} ({type(force).__name__}) is in the fast force group {force.getForceGroup()}; only "
            f"{possible} can be. Put it into another group with setForceGroup"
        )
    tag, attributes = TERMS[kind]
    root = ElementTree.fromstring(openmm.XmlSerializer.serialize(force))
    for parent in root.iter(f"{tag}s"):
        for term in list(parent):
            old = np.array([int(term.attrib[name]) for name in attributes])
            new = number[old]
            if (new < 0).any():
                _demand_rigid(force, tag, old, new, rigid)
                parent.remove(term)
                continue
            for name, value in zip(attributes, new.tolist(), strict=True):
                term.set(name, str(value))
    return openmm.XmlSerializer.deserialize(ElementTree.tostring(root, encoding="unicode"))


def _demand_rigid(force: openmm.Force, tag: str, old: np.ndarray, new: np.ndarray, rigid: np.ndarray) -> None:
    body = rigid[old[0]]
    if body >= 0 and (rigid[old] == body).all():
        return
    outside = old[new < 0][0]
    raise SoluteError(
        f"a {tag.lower()} of {force.getName()} acts on the atoms {', '.join(map(str, old.tolist()))}; atom {outside} "
        f"is not among those that move flexibly. Put that force into another group than {force.getForceGroup()} with "
        "setForceGroup"
    )


class SoluteForces:
    """Fast forces on some atoms: a function of their positions.

    The Context keeps copies of the Forces, so that changes of parameters, box or Forces do not reach it by themselves.
    `follow` takes over parameters and box; after `updateParametersInContext` a new object is needed.

    Attributes:
        atoms: particle indices of the System, (m,).
        is_empty: whether there is no force at all.
    """

    def __init__(
        self,
        system: openmm.System,
        atoms: ArrayLike,
        groups: Iterable[int],
        rigid: ArrayLike | None = None,
        platform: openmm.Platform | None = None,
        properties: Mapping[str, str] | None = None,
    ):
        """
        Args:
            system, atoms, groups, rigid: see `solute_system`.
            platform: openmm.Platform, usually that of the Context of all atoms; None: OpenMM chooses.
            properties: of the platform, {name: value}.

        Raises:
            SoluteError: see `solute_system`.
        """
        self.atoms = np.asarray(atoms, dtype=np.int64)
        reduced = solute_system(system, self.atoms, groups, rigid)
        self.is_empty = reduced.getNumForces() == 0
        arguments = () if platform is None else (platform, properties or {})
        self._integrator = openmm.VerletIntegrator(0.001)
        self._context = openmm.Context(reduced, self._integrator, *arguments)
        self._values = np.empty((len(self.atoms), 3))

    def __del__(self) -> None:
        # Delete it before its System and its integrator, even if the garbage collector deletes all of them.
        if hasattr(self, "_context"):
            del self._context

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Forces, (3, m), kJ/mol/nm, at positions (3, m), nm."""
        self._context.setPositions(np.ascontiguousarray(q.T))
        found = self._context.getState(forces=True)
        return np.ascontiguousarray(read_vectors(found, openmm.State.Forces, self._values).T)

    def energy(self, q: np.ndarray) -> float:
        """Potential energy, kJ/mol, at positions (3, m), nm."""
        self._context.setPositions(np.ascontiguousarray(q.T))
        return self._context.getState(energy=True).getPotentialEnergy()._value

    def follow(self, context: openmm.Context) -> bool:
        """Take over the parameters and the box of the Context of all atoms; returns whether any was different.

        If so, forces computed before are out of date.
        """
        theirs = context.getState(parameters=True)
        parameters, own = theirs.getParameters(), self._context.getState(parameters=True)
        changed = False
        for name, value in own.getParameters().items():
            if parameters[name] != value:
                self._context.setParameter(name, parameters[name])
                changed = True
        if theirs.getPeriodicBoxVectors() != own.getPeriodicBoxVectors():
            self._context.setPeriodicBoxVectors(*theirs.getPeriodicBoxVectors())
            changed = True
        return changed
