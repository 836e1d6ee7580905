"""What joins the atoms of a System into molecules: constraints and bonds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import RigidBodies, RigidityError
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import bonded_terms

#: Forces whose terms join their atoms into a molecule, besides bonds.
_JOINING = (openmm.HarmonicAngleForce, openmm.PeriodicTorsionForce, openmm.RBTorsionForce)

Bodies = TypeVar("Bodies", bound=RigidBodies)


class Links:
    """Constraints and bonds of a System.

    Attributes:
        n_particles: of the System.
        constraints: that act in it.
        bonds: pairs of particles that a harmonic bond joins, (b, 2).
        terms: pairs that an angle or a torsion joins, (t, 2); those of an improper torsion need not be bonded.
        custom: pairs that a CustomBondForce joins, (d, 2). It may be a restraint: molecules that it joins count as one,
            as in OpenMM, but rigid ones stay rigid.
    """

    def __init__(self, system: openmm.System):
        self.n_particles = system.getNumParticles()
        self.constraints = tables.constraints(system)
        self.bonds = _pairs(system, openmm.HarmonicBondForce)
        self.terms = _pairs(system, _JOINING)
        self.custom = _pairs(system, openmm.CustomBondForce)

    def leave(self, clusters: Sequence[Sequence[int]]) -> np.ndarray:
        """For each cluster of particles whether a bond joins it to a particle outside."""
        owner = np.full(self.n_particles, -1)
        for number, cluster in enumerate(clusters):
            owner[list(cluster)] = number
        ends = owner[np.concatenate([self.bonds, self.terms])]
        leaving = np.zeros(len(clusters) + 1, dtype=bool)
        leaving[ends[ends[:, 0] != ends[:, 1]]] = True
        return leaving[:-1]

    def tie(self, bodies: Bodies) -> Bodies:
        """The bodies with the constraints between them, and with their molecules.

        Raises:
            RigidityError: a constraint joins a body to a particle of no body, or a body of several atoms to another
                body.
        """
        pairs, lengths = self.constraints
        ends = bodies.owners[pairs]
        between = np.flatnonzero(ends[:, 0] != ends[:, 1])
        extended = (bodies.moments > 0).max(axis=0, initial=False)
        for pair, body in zip(pairs[between].tolist(), ends[between].tolist(), strict=True):
            if min(body) < 0 or extended[body].any():
                raise joins_a_body(*pair)
        edges = bodies.owners[np.concatenate([pairs, self.bonds, self.terms, self.custom])]
        molecules = joined(bodies.n, edges[(edges >= 0).all(axis=1)])
        return bodies.tied((ends[between], lengths[between]), molecules)


def joins_a_body(a: int, b: int) -> RigidityError:
    """The error for a constraint between two particles, one of which is in a rigid body without the other."""
    return RigidityError(
        f"a constraint between atoms {a} and {b} joins a rigid body to another particle. Put all atoms that are joined "
        "by constraints into one body; or leave them all out of `bodies`, so that constraints alone hold them; or "
        "build the System without that constraint (constraints=None or HBonds instead of AllBonds or HAngles)"
    )


def _pairs(system: openmm.System, kinds: type | tuple[type, ...]) -> np.ndarray:
    """Distinct pairs of neighbours in the terms of all Forces of some kinds, (m, 2)."""
    terms = [bonded_terms(force) for force in system.getForces() if isinstance(force, kinds)]
    pairs = [term[:, i : i + 2] for term in terms for i in range(term.shape[1] - 1)]
    return np.unique(np.concatenate([np.empty((0, 2), dtype=np.int64), *pairs]), axis=0)
