"""Fast forces, which are bonded, from a Context that has no other forces, so that they cost no pass over all pairs."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.index_ranges import distinct
from openmm_sier.system.bonded_terms import with_working_terms, working_terms
from openmm_sier.system.forces import FORCES, kind_of


class FastForceError(ValueError):
    """Fast forces that a Context of bonded forces cannot compute."""


class WorkingForces(NamedTuple):
    """Copies of bonded Forces with only the terms that do work.

    Attributes:
        forces: the copies; those without terms are left out.
        particles: on which they act, each once, ascending.
    """

    forces: list[openmm.Force]
    particles: np.ndarray


def working_forces(forces: Iterable[openmm.Force], owner: np.ndarray, moving: np.ndarray) -> WorkingForces:
    """Return copies of bonded Forces, without terms that do no work.

    Args:
        forces: the Forces of a System that are fast.
        owner: for each particle the number of its body, (N,); terms within one body do no work.
        moving: for each particle whether it moves with a body, (N,).

    Raises:
        FastForceError: a Force is not a bonded force, or one of its terms acts on a particle that moves with
            no body.
    """
    copies, particles = [], [np.empty(0, dtype=np.int64)]
    for force in forces:
        if kind_of(force).exerts_forces:
            terms = _checked_terms(force, owner, moving)
            if len(terms):
                copies.append(with_working_terms(force, owner))
                particles.append(terms.ravel())
    return WorkingForces(copies, distinct(np.concatenate(particles)))


def _checked_terms(force: openmm.Force, owner: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Return the particles of each term of a bonded Force that does work, (t, k).

    Raises:
        FastForceError: it is not bonded, or has a term on a particle that moves with no body.
    """
    remedy = (
        f"Put the Force into another group than {force.getForceGroup()} with setForceGroup. If prepare_system put it "
        "there, prepare a new System for these bodies: prepare_system(system, bodies)"
    )
    written = kind_of(force).terms
    if written is None:
        possible = ", ".join(each.__name__ for each, kind in FORCES.items() if kind.terms is not None)
        raise FastForceError(
            f"{force.getName()} ({type(force).__name__}) is in the fast force group {force.getForceGroup()}, but only "
            f"{possible} can be fast. {remedy}"
        )
    terms = working_terms(force, owner)
    for atoms in terms[~moving[terms].all(axis=1)]:
        raise FastForceError(
            f"a {written.element.lower()} of {force.getName()} acts on the atoms {', '.join(map(str, atoms))}, but "
            f"atom {atoms[~moving[atoms]][0]} is a virtual site or frozen, and moves with no body. {remedy}"
        )
    return terms


class FastForceContext:
    """Fast forces and torques on some bodies: a function of their centres and attitudes.

    The Context keeps copies of the Forces, so that changes of parameters, box or Forces do not reach it by themselves.
    `follow` takes over parameters and box; after `updateParametersInContext` a new object is needed.

    Attributes:
        bodies: on which the forces act.
    """

    def __init__(
        self,
        working: WorkingForces,
        bodies: BodySet,
        platform: openmm.Platform,
        properties: dict[str, str],
    ):
        """
        Args:
            working: the Forces, which this takes for its own.
            bodies: those that the forces act on, with particles numbered as in the System.
            platform: openmm.Platform, usually that of the Context of all forces.
            properties: of the platform, {name: value}.
        """
        self.bodies = bodies
        # The other atoms of large bodies need not be placed.
        self._sites = bodies.sites.at(working.particles)
        system = openmm.System()
        # Solutes come before water most often, so that few particles are left.
        for _ in range(int(self._sites.atoms.max(initial=-1)) + 1):
            system.addParticle(1.0)
        for force in working.forces:
            system.addForce(force)
        self._integrator = openmm.VerletIntegrator(0.001)
        self._context = openmm.Context(system, self._integrator, platform, properties)
        # Other atoms stay anywhere, apart from each other.
        self._positions = np.random.default_rng(0).random((system.getNumParticles(), 3))
        self._values = np.empty_like(self._positions)

    def __del__(self) -> None:
        # Delete it before its System and its integrator, even if the garbage collector deletes all of them.
        if hasattr(self, "_context"):
            del self._context

    def __call__(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return forces and torques, each (3, m), kJ/mol/nm and kJ/mol, on bodies at (q, A).

        Raises:
            NotFiniteError: a position or a force is not finite.
        """
        self._context.setPositions(self.bodies.place(q, A, self._positions, self._sites))
        self._context.getState(forces=True)._getVectorAsNumpy(openmm.State.Forces, self._values)
        return self.bodies.forces_and_torques(self._values, A, self._sites)

    def follow(self, context: openmm.Context) -> bool:
        """Take over the parameters and the box of the Context of all forces; returns whether any was different.

        If so, forces computed before are out of date.
        """
        theirs = openmm.Context.getState(context, parameters=True)
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
