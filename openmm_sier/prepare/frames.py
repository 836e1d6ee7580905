"""Rigid bodies of any size for OpenMM's own integrators, by frames of constrained particles."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.dynamics import bodies as dynamics
from openmm_sier.dynamics.species import Species
from openmm_sier.prepare.added_particles import AddedParticles, add_to_forces
from openmm_sier.prepare.frame_shapes import FrameShape
from openmm_sier.prepare.frame_topology import with_frame_atoms
from openmm_sier.system import checks, tables
from openmm_sier.system.arguments import Positions, checked_positions, checked_system
from openmm_sier.system.cut_molecules import Wholeness
from openmm_sier.system.find_bodies import Rigid, RigidBodies, linked
from openmm_sier.system.second_context import reference_context
from openmm_sier.system.solver_test import SolverTest

#: Maximum number of atoms between which all constraints are independent.
MOST_HELD = 4


class Frame(NamedTuple):
    """Frame of one body.

    Attributes:
        body: index of the body.
        shape: shape of the frame.
        particles: particles of the frame, (f,).
        atoms: atoms of the body, with its virtual sites, (k,).
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

    def getAtomVelocities(self, state: openmm.State) -> np.ndarray:
        """Return the velocities of the original System's particles. OpenMM has none for virtual sites.

        Args:
            state: a State from a Context of the copy, with positions and velocities.

        Returns:
            (N, 3), nm/ps. Virtual sites without a body have the velocities of the State.

        Raises:
            RigidityError: the particles of a frame violate its constraints.
        """
        copy_velocities = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        turned = self._turned(self._moving, self._all_positions(state), copy_velocities)
        velocities = copy_velocities[: self.numAtoms].copy()
        for number, frame in enumerate(self.frames):
            velocities[frame.atoms] = turned.velocities(number, frame.places)
        return velocities

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
            all_positions[frame.atoms] = centre + frame.places @ attitude
            all_positions[frame.particles] = centre + frame.shape.corners.T @ attitude
        return all_positions

    def addFrameVelocities(self, positions: Positions, velocities: Positions) -> np.ndarray:
        """Return velocities of all particles of the copy, to set in its Context.

        Args:
            positions: positions of the original System's particles, (N, 3), nm or a Quantity.
            velocities: their velocities, (N, 3), nm/ps or a Quantity. Only rigid motion of bodies counts.

        Returns:
            (P, 3), nm/ps; 0 for virtual sites.

        Raises:
            ValueError: an array has the wrong shape.
            RigidityError: the positions do not form the bodies, see `RigidBodies`.
        """
        if unit.is_quantity(velocities):
            velocities = velocities.value_in_unit(unit.nanometer / unit.picosecond)
        v = np.array(velocities, dtype=float)
        if v.shape != (self.numAtoms, 3):
            raise ValueError(f"velocities must have the shape ({self.numAtoms}, 3), one row per atom, got {v.shape}")
        turned = self._turned(self.bodies, checked_positions(positions, self.numAtoms), v)
        all_velocities = np.zeros((self.system.getNumParticles(), 3))
        all_velocities[: self.numAtoms] = v
        for frame in self.frames:
            all_velocities[frame.atoms] = 0.0
            all_velocities[frame.particles] = turned.velocities(frame.body, frame.shape.corners.T)
        return all_velocities

    def _all_positions(self, positions: Any) -> np.ndarray:
        if isinstance(positions, openmm.State):
            positions = positions.getPositions(asNumpy=True)
        return checked_positions(positions, self.system.getNumParticles())

    @property
    def _moving(self) -> dynamics.BodySet:
        """The frames as bodies of the copy."""
        species = [
            Species.from_sites(frame.particles[None], frame.shape.masses, frame.shape.corners) for frame in self.frames
        ]
        return dynamics.BodySet(species, self.system.getNumParticles())

    @staticmethod
    def _turned(bodies: dynamics.BodySet, x: np.ndarray, v: np.ndarray) -> _Turned:
        _, A = bodies.fit(x)
        p, L = bodies.momenta(v, A)
        spin = np.einsum("axn,an,ayn,yn->xn", A, bodies.inverse_moments, A, L)
        return _Turned(p / bodies.masses, A, spin)


class _Turned(NamedTuple):
    """Velocities of centres, (3, n), attitudes, (3, 3, n), and angular velocities, (3, n), of bodies."""

    centre: np.ndarray
    A: np.ndarray
    spin: np.ndarray

    def velocities(self, body: int, places: np.ndarray) -> np.ndarray:
        """Return velocities (k, 3) at places (k, 3) in the principal frame of a body."""
        return self.centre[:, body] + np.cross(self.spin[:, body], places @ self.A[:, :, body])


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
        bodies: the bodies, as `RigidBodies` or in any form of the argument `rigid` of `RigidBodies.from_system`, such
            as lists of particle indices. None for those defined by the System's constraints.
        topology: the topology; in that of the copy the frames form a separate chain.

    Returns:
        The copy with its topology and positions, and conversions to and from the original atoms.

    Raises:
        TypeError: `system` is not a System.
        ValueError: no body needs a frame, or a Force is neither bonded nor a NonbondedForce, CustomNonbondedForce,
            CustomCentroidBondForce, CustomExternalForce or CustomCVForce. The message names the Force.
        RigidityError: bodies or positions are refused, see `RigidBodies.from_system`; the periodic boundary cuts a
            body; or a barostat scales the position of each atom separately.
    """
    system = checked_system(system)
    x = checked_positions(positions, system.getNumParticles())
    checks.refuse_impossible_numbers(system)
    checks.refuse_scaled_atoms(system)
    if isinstance(bodies, RigidBodies):
        rigid_bodies = linked(system, bodies)
        wholeness = Wholeness(system, topology)
        for species in rigid_bodies.species:
            wholeness.refuse_cut(x, species.atoms, rigid_bodies.describe_atoms)
    else:
        rigid_bodies = RigidBodies.from_system(system, topology, bodies, x)
    frames = tuple(_frames(system, rigid_bodies, x))
    if not frames:
        raise ValueError(
            "no body needs a frame: at least one of `bodies` must have two or more atoms and not be rigid by its "
            f"constraints already, got {rigid_bodies!r}"
        )
    framed = _copied(system)
    _hold(framed, frames)
    atoms = np.concatenate([frame.atoms for frame in frames])
    added = sum(len(frame.particles) for frame in frames)
    add_to_forces(framed, AddedParticles(tables.masses(system), atoms, added))
    of_frames = [frame.particles.tolist() for frame in frames]
    named = None if topology is None else with_frame_atoms(topology, of_frames)
    framed_system = FramedSystem(framed, named, np.empty((0, 3)), rigid_bodies, frames)
    object.__setattr__(framed_system, "positions", framed_system.addFramePositions(x))
    return framed_system


def _copied(system: openmm.System) -> openmm.System:
    try:
        return copy.deepcopy(system)
    except Exception as error:
        raise ValueError(f"with_frames cannot copy the System by XML: {error}") from error


def _frames(system: openmm.System, bodies: dynamics.BodySet, x: np.ndarray) -> Iterator[Frame]:
    """Yield frames of the bodies that need one; their particles follow those of the System."""
    q, A = bodies.fit(x)
    followers = _virtual_sites(system, bodies)
    sited = _with_sites_placed(system, bodies.place(q, A, x.copy())) if followers else x
    number = bodies.n_particles
    for species, columns in zip(bodies.species, bodies.parts, strict=True):
        if not species.sites.any():
            continue
        free = ~tables.constraints(system).hold(species.atoms)
        solved = _is_solved(species)
        for row, body in enumerate(range(columns.start, columns.stop)):
            if solved and not free[row]:
                continue
            sites = followers.get(body, [])
            of_sites = (sited[sites] - q[:, body]) @ A[:, :, body].T
            places = np.concatenate([species.sites.T, of_sites.reshape(-1, 3)])
            shape = FrameShape.of(species, places)
            particles = np.arange(number, number + len(shape.masses))
            number += len(particles)
            yield Frame(body, shape, particles, np.array([*species.atoms[row].tolist(), *sites]), places)


def _is_solved(species: Species) -> bool:
    """Return whether OpenMM can solve constraints between all atoms of a body of this kind."""
    if len(species.masses) > MOST_HELD or checks.is_line(species.masses, species.sites.T):
        return False
    model = openmm.System()
    for mass in species.masses.tolist():
        model.addParticle(mass)
    for i, j in combinations(range(len(species.masses)), 2):
        model.addConstraint(i, j, float(np.linalg.norm(species.sites[:, i] - species.sites[:, j])))
    return not SolverTest(model).unsolved(lambda: species.sites.T)


def _virtual_sites(system: openmm.System, bodies: dynamics.BodySet) -> dict[int, list[int]]:
    """Return the virtual sites of each body, all of whose parent particles belong to the body."""
    owners = bodies.owners.copy()
    sites = [i for i in range(system.getNumParticles()) if system.isVirtualSite(i)]
    followers: dict[int, list[int]] = {}
    # Sites may depend on other sites, in any order.
    for _ in range(len(sites)):
        site_owners = [(i, _owner(system.getVirtualSite(i), owners)) for i in sites if owners[i] < 0]
        if not any(body >= 0 for _, body in site_owners):
            break
        for i, body in site_owners:
            owners[i] = body
            if body >= 0:
                followers.setdefault(body, []).append(i)
    return followers


def _owner(site: openmm.VirtualSite, owners: np.ndarray) -> int:
    """Return the body to which all parent particles of a virtual site belong, or -1."""
    # Symmetry sites turn with the axes of the box, not with the body.
    if isinstance(site, openmm.SymmetrySite):
        return -1
    parents = {int(owners[site.getParticle(i)]) for i in range(site.getNumParticles())}
    return parents.pop() if len(parents) == 1 else -1


def _with_sites_placed(system: openmm.System, x: np.ndarray) -> np.ndarray:
    """Return positions (N, 3) with virtual sites placed by their parent particles."""
    without_forces = _copied(system)
    for number in reversed(range(without_forces.getNumForces())):
        without_forces.removeForce(number)
    context = reference_context(without_forces)
    context.setPositions(x)
    context.computeVirtualSites()
    return context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


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
