"""Rigid bodies of any size for OpenMM's own integrators, by frames of constrained particles."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app

from openmm_sier.dynamics import bodies as dynamics
from openmm_sier.dynamics.species import Species
from openmm_sier.prepare.added_particles import AddedParticles, add_to_forces, refuse_other_forces
from openmm_sier.prepare.frame_shapes import FrameShape
from openmm_sier.system import checks, tables
from openmm_sier.system.arguments import Positions, checked_positions, checked_system
from openmm_sier.system.cut_molecules import Wholeness
from openmm_sier.system.find_bodies import Rigid, RigidBodies
from openmm_sier.system.links import held_bodies, linked
from openmm_sier.system.second_context import cloned
from openmm_sier.system.solver_test import SolverTest

#: Name of the residue of a frame, and prefix of the names of its particles.
RESIDUE, PARTICLE = "FRM", "F"

#: Maximum number of atoms between which all constraints are independent.
MOST_HELD = 4


class Frame(NamedTuple):
    """Frame of one body.

    Attributes:
        body: index of the body.
        shape: shape of the frame.
        particles: particles of the frame, (f,).
        atoms: atoms of the body, (k,).
        places: positions of the atoms in the body's principal frame, (k, 3), nm.
    """

    body: int
    shape: FrameShape
    particles: np.ndarray
    atoms: np.ndarray
    places: np.ndarray


@dataclass(frozen=True, eq=False)
class FramedSystem:
    """System with frames, and conversions to and from the original atoms; the result of `with_frames`.

    Atoms keep their indices, and the particles of frames follow them.

    Attributes:
        system: openmm.System, the copy with frames.
        topology: its openmm.app.Topology, with a last chain of one residue FRM per frame; None if none was given.
        positions: positions of all particles, (P, 3), nm.
        bodies: the bodies of the original System.
        frames: frames of the bodies that have one.
    """

    system: openmm.System
    topology: app.Topology | None
    positions: np.ndarray
    bodies: RigidBodies
    frames: tuple[Frame, ...]

    @property
    def numAtoms(self) -> int:
        """Number of particles of the original System, N."""
        return self.bodies.n_particles

    def getAtomPositions(self, positions: Positions | openmm.State) -> np.ndarray:
        """Return the positions of the original System's particles.

        Args:
            positions: a State from a Context of the copy, or all positions, (P, 3), nm or a Quantity.

        Returns:
            (N, 3), nm.

        Raises:
            ValueError: the positions have the wrong shape.
        """
        return self._all_positions(positions)[: self.numAtoms]

    def addFramePositions(self, positions: Positions) -> np.ndarray:
        """Return positions of all particles of the copy, to set in its Context.

        Args:
            positions: positions of the original System's particles, (N, 3), nm or a Quantity.

        Returns:
            (P, 3), nm. Atoms of bodies are at the sites of the bodies.

        Raises:
            ValueError: the positions have the wrong shape.
            RigidityError: the positions do not form the bodies, see `RigidBodies`.
        """
        x = checked_positions(positions, self.numAtoms)
        q, A, misfit = self.bodies.fit_with_misfit(x)
        checks.warn_about_misfit(self.bodies, misfit)
        all_positions = np.zeros((self.system.getNumParticles(), 3))
        all_positions[: self.numAtoms] = self.bodies.place(q, A, x)
        for frame in self.frames:
            centre, attitude = q[:, frame.body], A[:, :, frame.body]
            all_positions[frame.particles] = centre + frame.shape.corners.T @ attitude
        return all_positions

    def _all_positions(self, positions: Any) -> np.ndarray:
        if isinstance(positions, openmm.State):
            positions = positions.getPositions(asNumpy=True)
        return checked_positions(positions, self.system.getNumParticles())


def with_frames(
    system: openmm.System,
    positions: Positions,
    bodies: RigidBodies | Rigid = None,
    topology: app.Topology | None = None,
) -> FramedSystem:
    """Return a copy of a System in which constrained frames keep bodies of any size rigid with OpenMM's integrators.

    >>> framed = with_frames(system, positions, [[0, 1, 2, 3, 4, 5]], topology)
    >>> integrator = openmm.LangevinMiddleIntegrator(300*kelvin, 1/picosecond, 4*femtoseconds)
    >>> simulation = Simulation(framed.topology, framed.system, integrator)
    >>> simulation.context.setPositions(framed.positions)
    >>> simulation.step(2)
    >>> atoms = framed.getAtomPositions(simulation.context.getState(positions=True))

    OpenMM's constraint solvers can handle bodies of a few atoms. In the copy a frame of four particles represents the
    body, three if it is flat and two if it is a line. The frame has exactly the body's mass, centre and moments of
    inertia, and is held by six, three or one constraints. The atoms of the body become massless virtual sites of the
    frame, and their forces act on it. So any integrator, barostat and platform of OpenMM, and of this package, moves
    them as a rigid body with six degrees of freedom.

    Bodies already defined by constraints that OpenMM can solve, such as water, do not change. Others lose their inner
    constraints. Particles of frames do not interact: each Force gets parameters for them that leave energies and forces
    unchanged. Only long-range corrections depend on the number of particles N, as N/(N + 1).

    Call this function before `prepare_system`, and pass the copy to that like any other System.

    Args:
        system: the System, which is not changed.
        positions: positions of its particles, (N, 3), nm or a Quantity, with bodies whole.
        bodies: the bodies, as `RigidBodies` or lists of particle indices. None for those defined by the System's
            constraints.
        topology: the topology; in that of the copy the frames form a separate chain.

    Returns:
        The copy with its topology and positions, and conversions to and from the original atoms.

    Raises:
        TypeError: `system` is not a System.
        ValueError: no body needs a frame; a body does not move along and about all axes; or a Force is neither bonded
            nor a NonbondedForce, CustomNonbondedForce, CustomCentroidBondForce, CustomExternalForce or CustomCVForce.
            The message names the Force.
        RigidityError: bodies or positions are refused, see `RigidBodies.from_system`; the periodic boundary cuts a
            body; or a barostat scales the position of each atom separately.
    """
    system = checked_system(system)
    x = checked_positions(positions, system.getNumParticles())
    checks.refuse_impossible_masses(system)
    checks.refuse_sites_without_place(system)
    checks.refuse_scaled_atoms(system)
    if isinstance(bodies, RigidBodies):
        rigid_bodies = linked(system, bodies)
        if rigid_bodies.bearings is not None:
            raise ValueError(
                "bodies with frames move along and about all axes, unlike the type of "
                f"{rigid_bodies.describe(rigid_bodies.bearings.columns[0])}: give the type Motion.FREE, or take the "
                "exact engine without frames"
            )
        wholeness = Wholeness(system, topology)
        wholeness.refuse_cut(x, [species.atoms for species in rigid_bodies.species], rigid_bodies.describe_atoms)
    else:
        rigid_bodies = RigidBodies.from_system(system, topology, bodies, x)
    frames = tuple(_frames(system, rigid_bodies))
    if not frames:
        raise ValueError(
            "no body needs a frame: at least one of `bodies` must have two or more atoms and not be rigid by its "
            f"constraints already, got {rigid_bodies!r}"
        )
    refuse_other_forces(system)
    framed = cloned(system)
    _hold(framed, frames)
    atoms = np.concatenate([frame.atoms for frame in frames])
    added = sum(len(frame.particles) for frame in frames)
    add_to_forces(framed, AddedParticles(tables.masses(system), atoms, added))
    of_frames = [frame.particles.tolist() for frame in frames]
    named = None if topology is None else _with_frame_atoms(topology, of_frames)
    framed_system = FramedSystem(framed, named, np.empty((0, 3)), rigid_bodies, frames)
    return replace(framed_system, positions=framed_system.addFramePositions(x))


def _frames(system: openmm.System, bodies: dynamics.BodySet) -> Iterator[Frame]:
    """Yield frames of the bodies that need one; their particles follow those of the System."""
    number = bodies.n_particles
    held = held_bodies(system, bodies.species)
    for species, numbers, is_held in zip(bodies.species, bodies.numbers, held, strict=True):
        if not species.sites.any():
            continue
        solved = _is_solved(species)
        shape = FrameShape.of(species)
        for row, body in enumerate(numbers.tolist()):
            if solved and is_held[row]:
                continue
            particles = np.arange(number, number + len(shape.masses))
            number += len(particles)
            yield Frame(body, shape, particles, species.atoms[row], species.sites.T)


def _is_solved(species: Species) -> bool:
    """Return whether OpenMM can solve constraints between all atoms of a body of this kind."""
    if len(species.masses) > MOST_HELD or species.has_other_moments:
        return False
    model = openmm.System()
    for mass in species.masses.tolist():
        model.addParticle(mass)
    for i, j in combinations(range(len(species.masses)), 2):
        model.addConstraint(i, j, float(np.linalg.norm(species.sites[:, i] - species.sites[:, j])))
    return not SolverTest(model).unsolved(lambda: species.sites.T)


def _hold(system: openmm.System, frames: tuple[Frame, ...]) -> None:
    """Add frame particles and their constraints, and make the atoms of bodies virtual sites of the frames."""
    owner = np.full(system.getNumParticles(), -1)
    for frame in frames:
        owner[frame.atoms] = frame.body
    for i in reversed(range(system.getNumConstraints())):
        a, b, _ = system.getConstraintParameters(i)
        if owner[a] >= 0 or owner[b] >= 0:
            system.removeConstraint(i)
    for frame in frames:
        particles, corners = frame.particles.tolist(), frame.shape.corners.T
        for mass in frame.shape.masses.tolist():
            system.addParticle(mass)
        for i, j in combinations(range(len(particles)), 2):
            system.addConstraint(particles[i], particles[j], float(np.linalg.norm(corners[i] - corners[j])))
        for atom, place in zip(frame.atoms.tolist(), frame.places, strict=True):
            system.setParticleMass(atom, 0.0)
            system.setVirtualSite(atom, frame.shape.virtual_site(particles, place))


def _with_frame_atoms(topology: app.Topology, frames: list[list[int]]) -> app.Topology:
    """Return a copy of a Topology with one more chain, in which each frame is a residue.

    Like virtual sites, the particles of frames have no element.

    Args:
        topology: openmm.app.Topology.
        frames: particles of each frame, which follow those of the topology.
    """
    extended = copy.deepcopy(topology)
    chain = extended.addChain()
    for number, particles in enumerate(frames, 1):
        residue = extended.addResidue(RESIDUE, chain, str(number))
        for i, _ in enumerate(particles, 1):
            extended.addAtom(f"{PARTICLE}{i}", None, residue)
    return extended
