"""Constraints and bonds that join the particles of a System, and link its bodies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet, RigidityError
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.index_ranges import distinct
from openmm_sier.dynamics.species import Species
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import bonded_terms, harmonic_bonds
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces

#: Maximum length of covalent bonds, nm: those of iodine and heavy metals.
LONGEST_COVALENT = 0.3

Linked = TypeVar("Linked", bound=BodySet)


class Links:
    """Constraints and bonds of a System, including those of Forces inside Forces; OpenMM finds molecules by them too.

    Attributes:
        n_particles: number of particles of the System.
        constraints: its acting constraints.
        bonds: pairs of particles joined by harmonic bonds, (b, 2).
        lengths: lengths of these bonds, (b,), nm.
        strengths: their force constants, (b,), kJ/mol/nm^2.
        periodic: whether they use the nearest images of their particles, (b,).
        terms: pairs joined by angles or torsions, (t, 2); those of an improper torsion need not be bonded.
        custom: pairs joined by a CustomBondForce, (d, 2). It may be a restraint: molecules that it joins count as one,
            as in OpenMM, but rigid ones stay rigid.
    """

    def __init__(self, system: openmm.System):
        self._system = system
        self.n_particles = system.getNumParticles()
        self.constraints = tables.constraints(system)
        forces = [entry.force for entry in all_forces(system)]
        bonds = [force for force in forces if isinstance(force, openmm.HarmonicBondForce)]
        read = [harmonic_bonds(force) for force in bonds]
        self.bonds = np.concatenate([np.empty((0, 2), dtype=np.int64), *(pairs for pairs, *_ in read)])
        self.lengths = np.concatenate([np.empty(0), *(lengths for _, lengths, _ in read)])
        self.strengths = np.concatenate([np.empty(0), *(strengths for *_, strengths in read)])
        self.periodic = np.repeat(
            [force.usesPeriodicBoundaryConditions() for force in bonds], [len(pairs) for pairs, *_ in read]
        ).astype(bool)
        self.terms = _pairs(force for force in forces if kind_of(force).joins)
        self.custom = _pairs(force for force in forces if isinstance(force, openmm.CustomBondForce))

    def covalent(self) -> np.ndarray:
        """Return constraints and bonds, (b, 2), without restraints within molecules.

        A harmonic bond longer than `LONGEST_COVALENT`, as in an elastic network, or a term of a CustomBondForce is a
        restraint if shorter bonds join its atoms already. OpenMM's readers of GROMACS and CHARMM files put the pairs
        three bonds apart into a CustomBondForce.
        """
        # Bonds of zero length only mark molecules for OpenMM.
        short = (self.lengths > 0) & (self.lengths <= LONGEST_COVALENT)
        sure = np.concatenate([self.constraints.pairs, self.bonds[short]])
        others = np.concatenate([self.bonds[self.lengths > LONGEST_COVALENT], self.custom])
        ends = joined(self.n_particles, sure)[others]
        return np.concatenate([sure, others[ends[:, 0] != ends[:, 1]]])

    def leave(self, clusters: np.ndarray, count: int) -> np.ndarray:
        """Return whether a bond joins each cluster to a particle outside, (count,); its own sites are inside.

        Args:
            clusters: number of the cluster of each particle, (N,); -1 without one.
            count: number of clusters.
        """
        owner = tables.with_sites(self._system, clusters)
        ends = owner[np.concatenate([self.bonds, self.terms])]
        leaving = np.zeros(count + 1, dtype=bool)
        leaving[ends[ends[:, 0] != ends[:, 1]]] = True
        return leaving[:-1]

    def link(self, bodies: Linked) -> Linked:
        """Return the bodies linked by constraints, and grouped into molecules.

        Raises:
            RigidityError: a constraint joins a body to a particle without a body, or a body of several atoms to another
                body.
        """
        pairs, lengths = self.constraints
        ends = bodies.owners[pairs]
        between = np.flatnonzero(ends[:, 0] != ends[:, 1])
        extended = (bodies.moments > 0).max(axis=0, initial=False)
        wrong = between[(ends[between] < 0).any(axis=1) | np.append(extended, False)[ends[between]].any(axis=1)]
        if wrong.size:
            raise joins_a_body(*pairs[wrong[0]].tolist())
        edges = bodies.owners[np.concatenate([pairs, self.bonds, self.terms, self.custom])]
        molecules = joined(bodies.n, edges[(edges >= 0).all(axis=1)])
        links = ends[between], lengths[between]
        numbering = bodies.moved, bodies.numbers
        return type(bodies)(bodies.species, bodies.n_particles, bodies.labels, links, molecules, *numbering)


def joins_a_body(a: int, b: int) -> RigidityError:
    """Return the error for a constraint that joins a rigid body to a particle outside."""
    return RigidityError(
        f"a constraint between atoms {a} and {b} joins a rigid body to another particle. Put all atoms joined by "
        "constraints into one body; or leave all of them out of `bodies`, so that only constraints hold them; or "
        "create the System without that constraint (constraints=None or HBonds instead of AllBonds or HAngles)"
    )


def _pairs(forces: Iterable[openmm.Force]) -> np.ndarray:
    """Return distinct pairs of neighbours in the terms of bonded Forces, (m, 2), in order."""
    terms = map(bonded_terms, forces)
    neighbours = [term[:, i : i + 2] for term in terms for i in range(term.shape[1] - 1)]
    pairs = np.concatenate([np.empty((0, 2), dtype=np.int64), *neighbours])
    base = int(pairs.max(initial=0)) + 1
    return np.column_stack(np.divmod(distinct(pairs @ [base, 1]), base))


def held_bodies(system: openmm.System, species: Sequence[Species]) -> list[np.ndarray]:
    """Return whether each body moves as its atoms do under the constraints of a System, (m,), for each species.

    Constraints join all of its atoms, and its moments are those of their masses.
    """
    held = tables.constraints(system).hold(kind.atoms for kind in species)
    return [are_held & (not kind.has_other_moments) for kind, are_held in zip(species, held, strict=True)]


@tables.once
def links_of(system: openmm.System) -> Links:
    """Return the `Links` of a System."""
    return Links(system)


def linked(system: openmm.System, bodies: Linked) -> Linked:
    """Return bodies linked by the constraints of a System, and grouped into its molecules.

    Raises:
        ValueError: the bodies belong to a System with another number of particles or other masses.
        RigidityError: a constraint joins a body of several atoms to something else.
    """
    masses = tables.masses(system)
    if bodies.n_particles != len(masses):
        raise ValueError(
            f"the bodies belong to a System of {bodies.n_particles} particles, but this one has {len(masses)}: create "
            "the bodies from this System"
        )
    for species in bodies.species:
        wrong = np.argwhere(masses[species.atoms] != species.masses)
        if len(wrong):
            body, site = wrong[0]
            atom = species.atoms[body, site]
            raise ValueError(
                f"atom {atom} of {bodies.describe_atoms(species.atoms[body])} has a mass of {species.masses[site]} "
                f"dalton in the bodies, but {masses[atom]} dalton in the System: create the bodies from this System "
                "again"
            )
    return links_of(system).link(bodies)
