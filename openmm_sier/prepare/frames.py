"""Rigid bodies of any size for OpenMM's own integrators, by frames that constraints hold."""

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
from openmm_sier.system.solver_trial import SolverTrial

#: Constraints between all of more atoms are redundant.
MOST_HELD = 4


class Frame(NamedTuple):
    """Describe the frame of one body.

    Attributes:
        body: its number.
        shape: of the frame.
        particles: of the frame, (f,).
        atoms: of the body, with its virtual sites, (k,).
        places: of these in the body's principal frame, (k, 3), nm.
    """

    body: int
    shape: FrameShape
    particles: np.ndarray
    atoms: np.ndarray
    places: np.ndarray


@dataclass(frozen=True, eq=False)
class FramedSystem:
    """Hold what `with_frames` made: a System with frames, and methods that give atoms back.

    Atoms have the numbers that they had, and the particles of frames come after them.

    Attributes:
        system: openmm.System, the copy with frames.
        topology: openmm.app.Topology of it, with a last chain of a residue FRM for each frame; None if none was given.
        positions: of all particles, (P, 3), nm.
        bodies: the bodies of the original System.
        frames: one for each body that got a frame.
    """

    system: openmm.System
    topology: app.Topology | None
    positions: np.ndarray
    bodies: RigidBodies
    frames: tuple[Frame, ...]

    @property
    def numAtoms(self) -> int:
        """Return the number of particles of the original System, N."""
        return self.bodies.n_particles

    def getAtomPositions(self, positions: Positions | openmm.State) -> np.ndarray:
        """Return the positions of the original System's particles.

        Args:
            positions: a State of a Context of the copy, or all positions, (P, 3), nm or a Quantity.

        Returns:
            (N, 3), nm.

        Raises:
            ValueError: the positions have another shape.
        """
        return self._all_positions(positions)[: self.numAtoms]

    def getAtomVelocities(self, state: openmm.State) -> np.ndarray:
        """Return the velocities of the original System's particles. OpenMM keeps none for virtual sites.

        Args:
            state: of a Context of the copy, with positions and velocities.

        Returns:
            (N, 3), nm/ps. Virtual sites that belong to no body have what the State has.

        Raises:
            RigidityError: the particles of a frame are not where its constraints hold them.
        """
        found = state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)
        turned = self._turned(self._moving, self._all_positions(state), found)
        velocities = found[: self.numAtoms].copy()
        for number, frame in enumerate(self.frames):
            velocities[frame.atoms] = turned.velocities(number, frame.places)
        return velocities

    def addFramePositions(self, positions: Positions) -> np.ndarray:
        """Return positions of all particles of the copy, to set in its Context.

        Args:
            positions: of the original System's particles, (N, 3), nm or a Quantity.

        Returns:
            (P, 3), nm. Atoms of bodies are where the bodies have them.

        Raises:
            ValueError: the positions have another shape.
            RigidityError: they are not those of the bodies, see `RigidBodies`.
        """
        x = checked_positions(positions, self.numAtoms)
        q, A, misfit = self.bodies.fit_with_misfit(x)
        checks.warn_about_misfit(self.bodies, misfit)
        found = np.zeros((self.system.getNumParticles(), 3))
        found[: self.numAtoms] = self.bodies.place(q, A, x)
        for frame in self.frames:
            centre, attitude = q[:, frame.body], A[:, :, frame.body]
            found[frame.atoms] = centre + frame.places @ attitude
            found[frame.particles] = centre + frame.shape.corners.T @ attitude
        return found

    def addFrameVelocities(self, positions: Positions, velocities: Positions) -> np.ndarray:
        """Return velocities of all particles of the copy, to set in its Context.

        Args:
            positions: of the original System's particles, (N, 3), nm or a Quantity.
            velocities: of these, (N, 3), nm/ps or a Quantity. Of bodies the rigid part of the motion counts.

        Returns:
            (P, 3), nm/ps; 0 for virtual sites.

        Raises:
            ValueError: they have another shape.
            RigidityError: the positions are not those of the bodies, see `RigidBodies`.
        """
        if unit.is_quantity(velocities):
            velocities = velocities.value_in_unit(unit.nanometer / unit.picosecond)
        v = np.array(velocities, dtype=float)
        if v.shape != (self.numAtoms, 3):
            raise ValueError(f"velocities must have the shape ({self.numAtoms}, 3) of the atoms, got {v.shape}")
        turned = self._turned(self.bodies, checked_positions(positions, self.numAtoms), v)
        found = np.zeros((self.system.getNumParticles(), 3))
        found[: self.numAtoms] = v
        for frame in self.frames:
            found[frame.atoms] = 0.0
            found[frame.particles] = turned.velocities(frame.body, frame.shape.corners.T)
        return found

    def _all_positions(self, positions: Any) -> np.ndarray:
        if isinstance(positions, openmm.State):
            positions = positions.getPositions(asNumpy=True)
        return checked_positions(positions, self.system.getNumParticles())

    @property
    def _moving(self) -> dynamics.BodySet:
        """Return the frames as bodies of the copy."""
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
    """Copy a System with a frame for each rigid body, so that OpenMM's own integrators keep bodies of any size rigid.

    >>> framed = with_frames(system, positions, [[0, 1, 2, 3, 4, 5]], topology)
    >>> integrator = openmm.LangevinMiddleIntegrator(300*kelvin, 1/picosecond, 4*femtoseconds)
    >>> simulation = Simulation(framed.topology, framed.system, integrator)
    >>> simulation.context.setPositions(framed.positions)
    >>> simulation.step(2)
    >>> atoms = framed.getAtomPositions(simulation.context.getState(positions=True))

    OpenMM holds bodies by constraints, and its solvers can handle those of a few atoms. In the copy a frame of four
    particles moves in place of the body, three if it is flat and two if it is a line. It has exactly the body's mass,
    centre and moments of inertia, and six constraints hold it, or three, or one. The atoms of the body become virtual
    sites of the frame, without mass, and their forces act on it. So any integrator, barostat and platform of OpenMM
    moves them as a rigid body with six degrees of freedom, and the integrators of this package do too.

    Bodies that constraints define already and that OpenMM can solve, such as water, stay as they are. The others lose
    the constraints inside them. Particles of frames interact with nothing: each Force gets parameters for them with
    which energies and forces stay what they were. Only long-range corrections depend on the number of particles N, as
    N/(N + 1).

    Call it before `prepare_system`, to which you give the copy like any other System.

    Args:
        system: the System, which stays as it is.
        positions: positions of its particles, (N, 3), nm or a Quantity, with bodies whole.
        bodies: the bodies, as `RigidBodies` or as `rigid` of `RigidBodies.from_system`, such as lists of particle
            indices. None takes those of the System's constraints.
        topology: the topology, of which the copy has the frames in a chain of their own.

    Returns:
        The copy with its topology and positions, and with methods that give atoms back.

    Raises:
        TypeError: `system` is no System, such as a Simulation.
        ValueError: no body needs a frame, or a Force is none of the bonded ones, NonbondedForce, CustomNonbondedForce,
            CustomCentroidBondForce, CustomExternalForce and CustomCVForce. The message has its name.
        RigidityError: bodies or positions are refused, see `RigidBodies.from_system`; the periodic boundary cuts a
            body; or a barostat scales the position of each atom separately.
    """
    system = checked_system(system)
    x = checked_positions(positions, system.getNumParticles())
    checks.refuse_impossible_numbers(system)
    checks.refuse_scaled_atoms(system)
    if isinstance(bodies, RigidBodies):
        known = linked(system, bodies)
        wholeness = Wholeness(system, topology)
        for species in known.species:
            wholeness.refuse_cut(x, species.atoms, known.describe_atoms)
    else:
        known = RigidBodies.from_system(system, topology, bodies, x)
    frames = tuple(_frames(system, known, x))
    if not frames:
        raise ValueError(
            "no body needs a frame: at least one of `bodies` must have two or more atoms that constraints do not keep "
            f"rigid already, got {known!r}"
        )
    framed = _copied(system)
    _hold(framed, frames)
    held = np.concatenate([frame.atoms for frame in frames])
    added = sum(len(frame.particles) for frame in frames)
    add_to_forces(framed, AddedParticles(tables.masses(system), held, added))
    of_frames = [frame.particles.tolist() for frame in frames]
    named = None if topology is None else with_frame_atoms(topology, of_frames)
    found = FramedSystem(framed, named, np.empty((0, 3)), known, frames)
    object.__setattr__(found, "positions", found.addFramePositions(x))
    return found


def _copied(system: openmm.System) -> openmm.System:
    try:
        return copy.deepcopy(system)
    except Exception as error:
        raise ValueError(f"with_frames cannot copy the System by XML: {error}") from error


def _frames(system: openmm.System, bodies: dynamics.BodySet, x: np.ndarray) -> Iterator[Frame]:
    """Give the frames of all bodies that need one, whose particles come after those of the System."""
    q, A = bodies.fit(x)
    followers = _virtual_sites(system, bodies)
    sited = _with_sites_placed(system, bodies.place(q, A, x.copy())) if followers else x
    number = bodies.n_particles
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        if not species.sites.any():
            continue
        free = ~tables.constraints(system).hold(species.atoms)
        solved = _is_solved(species)
        for row, body in enumerate(range(part.start, part.stop)):
            if solved and not free[row]:
                continue
            sites = followers.get(body, [])
            beside = (sited[sites] - q[:, body]) @ A[:, :, body].T
            places = np.concatenate([species.sites.T, beside.reshape(-1, 3)])
            shape = FrameShape.of(species, places)
            particles = np.arange(number, number + len(shape.masses))
            number += len(particles)
            yield Frame(body, shape, particles, np.array([*species.atoms[row].tolist(), *sites]), places)


def _is_solved(species: Species) -> bool:
    """Return whether OpenMM can solve constraints between all atoms of such a body."""
    if len(species.masses) > MOST_HELD or checks.is_line(species.masses, species.sites.T):
        return False
    alone = openmm.System()
    for mass in species.masses.tolist():
        alone.addParticle(mass)
    for i, j in combinations(range(len(species.masses)), 2):
        alone.addConstraint(i, j, float(np.linalg.norm(species.sites[:, i] - species.sites[:, j])))
    return not SolverTrial(alone).unsolved(lambda: species.sites.T)


def _virtual_sites(system: openmm.System, bodies: dynamics.BodySet) -> dict[int, list[int]]:
    """Give the virtual sites that move with a body, as all particles do that they depend on, by its number."""
    owners = bodies.owners.copy()
    sites = [i for i in range(system.getNumParticles()) if system.isVirtualSite(i)]
    followers: dict[int, list[int]] = {}
    # Sites may depend on others, in any order.
    for _ in range(len(sites)):
        found = [(i, _owner(system.getVirtualSite(i), owners)) for i in sites if owners[i] < 0]
        if not any(body >= 0 for _, body in found):
            break
        for i, body in found:
            owners[i] = body
            if body >= 0:
                followers.setdefault(body, []).append(i)
    return followers


def _owner(site: openmm.VirtualSite, owners: np.ndarray) -> int:
    """Return the body to which all particles of a virtual site belong, or -1."""
    # Those by symmetry turn with the axes of the box, not with the body.
    if isinstance(site, openmm.SymmetrySite):
        return -1
    found = {int(owners[site.getParticle(i)]) for i in range(site.getNumParticles())}
    return found.pop() if len(found) == 1 else -1


def _with_sites_placed(system: openmm.System, x: np.ndarray) -> np.ndarray:
    """Return positions (N, 3) with virtual sites where their particles have them."""
    alone = _copied(system)
    for number in reversed(range(alone.getNumForces())):
        alone.removeForce(number)
    context = reference_context(alone)
    context.setPositions(x)
    context.computeVirtualSites()
    return context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)


def _hold(system: openmm.System, frames: tuple[Frame, ...]) -> None:
    """Add the particles of frames with their constraints, and make atoms of bodies virtual sites of them."""
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
