"""Systems of mixtures of molecules, in vacuum or in a box, prepared or not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import openmm
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from openmm_sier import BodyType, Preparation, RigidBodies, prepare_system
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.system.find_bodies import UnknownShapeError
from tests.laws.mechanics import (
    centre_of,
    constrained_pairs,
    gradients,
    masses_of,
    multipliers,
    rigid_velocities,
    virtual_sites,
)
from tests.laws.molecules import Molecule
from tests.laws.parts import Parts
from tests.support.waters import phase_point, plain_context

#: nm: between molecules at least; radius of the cut-off.
GAP, CUTOFF = 0.25, 0.7

#: nm: particles that are nearer are in one place, to rounding.
ONE_PLACE = 1e-6

#: K, and dalton: of velocities and of the hydrogens of "heavy".
TEMPERATURE, HEAVY = 300.0, 4.0

#: A truncated octahedron and a rhombic dodecahedron, of edge 1.
TRICLINIC = (
    np.array([[1, 0, 0], [1 / 3, 0.94, 0], [-1 / 3, 0.47, 0.82]]),
    np.array([[1, 0, 0], [0, 1, 0], [0.5, 0.5, 0.71]]),
)

SURROUNDINGS = ("vacuum", "cut-off", "PME", "triclinic PME")
FORMS = ("plain", "switched", "custom", "none", "offsets", "inner", "dispersion")
PREPARATIONS = ("no", "yes", "heavy")


@dataclass(frozen=True)
class Built:
    """What a Mixture describes.

    Attributes:
        system: prepared or not, as the mixture says.
        plain: the same before it was prepared.
        positions: (N, 3), nm, which satisfy the constraints; virtual sites are in their places.
        velocities: (N, 3), nm/ps, of bodies that are rigid and of constraints, at 300 K.
        named: particles of each named body.
        bodies: None if the constraints alone say which there are.
        names: of the particles.
        preparation: of `prepare_system`; None if not prepared.
        images: numbers of box vectors by which particles are away from a whole molecule, (N, 3).
    """

    system: openmm.System
    plain: openmm.System
    positions: np.ndarray
    velocities: np.ndarray
    named: tuple[tuple[int, ...], ...]
    bodies: RigidBodies | None
    names: tuple[str, ...]
    preparation: Preparation | None
    images: np.ndarray


@dataclass(frozen=True)
class Mixture:
    """A System by its description.

    Attributes:
        molecules: of `tests.laws.molecules`.
        seed: of places and velocities.
        surroundings: "vacuum", or a box with "cut-off", "PME" or "triclinic PME".
        form: "plain", "switched", "custom" (Lennard-Jones by a CustomNonbondedForce), "none" (no nonbonded forces),
            "offsets" (charges have a part that a global parameter multiplies), "inner" (a collective variable) or
            "dispersion" (beside PME, sums of it for Lennard-Jones too).
        remover: number of steps between two acts of a CMMotionRemover; 0 without one.
        prepared: "no", "yes" or "heavy" (with a hydrogenMass).
        crossing: whether molecules in a box cross its boundary: bonds, angles and torsions take nearest images, at any
            of which is what only these hold together.
    """

    molecules: tuple[Molecule, ...]
    seed: int = 0
    surroundings: str = "vacuum"
    form: str = "plain"
    remover: int = 0
    prepared: str = "no"
    crossing: bool = False

    @property
    def crosses(self) -> bool:
        return self.crossing and self.surroundings != "vacuum"

    def build(self) -> Built:
        """Return the System, its positions and its velocities, the same ones each time, in a System of their own."""
        built = _built(self)
        return replace(built, system=openmm.XmlSerializer.clone(built.system))

    def _make(self) -> Built:
        rng = np.random.default_rng(self.seed)
        parts = [molecule.parts() for molecule in self.molecules]
        plain = _particles(parts)
        positions = _satisfied(plain, _placed(parts, rng))
        _add_bonded_forces(self, plain, parts, positions)
        _surround(self, plain, parts, positions)
        named = tuple(tuple(first + i for i in body) for first, each in _numbered(parts) for body in each.bodies)
        images = np.zeros(positions.shape)
        if self.crosses:
            images = _images(plain, named, np.random.default_rng([self.seed, 2]))
            positions = positions + images @ box_of(plain)
        system = openmm.XmlSerializer.clone(plain)
        preparation = None
        if self.prepared != "no":
            heavy = HEAVY if self.prepared == "heavy" else None
            preparation = prepare_system(system, named or None, hydrogenMass=heavy)
        bodies = _bodies(system, named, positions, typed=self.seed % 2 == 1)
        velocities = _velocities(system, positions, named, rng)
        if self.remover:
            masses = masses_of(system)
            velocities[masses > 0] -= centre_of(masses, velocities)
        names = tuple(
            f"{type(molecule).__name__} {number}, particle {i}"
            for number, molecule in enumerate(self.molecules)
            for i in range(len(parts[number].masses))
        )
        return Built(system, plain, positions, velocities, named, bodies, names, preparation, images)


@lru_cache(maxsize=8)
def _built(mixture: Mixture) -> Built:
    """Make what a mixture describes. Most cases make it several times, and none changes anything but `system`."""
    return mixture._make()


def _bodies(
    system: openmm.System, named: tuple[tuple[int, ...], ...], positions: np.ndarray, typed: bool
) -> RigidBodies | None:
    """Return bodies whose shapes only positions or types give, with all others; None if there are none."""
    if named and typed:
        return _of_types(system, named, positions)
    try:
        RigidBodies.from_system(system, rigid=named)
    except UnknownShapeError:
        return RigidBodies.from_system(system, rigid=named, positions=positions)
    return None


def _of_types(system: openmm.System, named: tuple[tuple[int, ...], ...], positions: np.ndarray) -> RigidBodies:
    """Return bodies, each with a type that has its shape in a frame of its own and its moments as a tensor."""
    masses = masses_of(system)
    types = {}
    for number, body in enumerate(named):
        atoms = [i for i in body if masses[i]]
        turn = Rotation.random(random_state=number).as_matrix()
        arms = (positions[atoms] - masses[atoms] @ positions[atoms] / masses[atoms].sum()) @ turn.T
        squares = np.einsum("k,kx,ky->xy", masses[atoms], arms, arms)
        tensor = np.trace(squares) * np.eye(3) - squares
        # Rounding would give a line a moment about itself.
        types[BodyType(f"body {number}", arms, masses[atoms], tensor if len(atoms) > 2 else None)] = [atoms]
    return RigidBodies.from_types(system, types, positions)


def _numbered(parts: list[Parts]) -> Iterator[tuple[int, Parts]]:
    """Yield the first particle of each molecule, and the molecule."""
    first = 0
    for each in parts:
        yield first, each
        first += len(each.masses)


def harden(context: openmm.Context) -> None:
    """Give the global parameter of bonds, where there is one, another value than the one with which Contexts begin."""
    if "hard" in dict(context.getParameters()):
        context.setParameter("hard", 1.1)


def is_frozen(mixture: Mixture) -> bool:
    """Return whether a mixture has atoms without mass that are no virtual sites, so that momentum is not conserved."""
    parts = [molecule.parts() for molecule in mixture.molecules]
    return any(not mass and i not in each.sites for each in parts for i, mass in enumerate(each.masses))


def box_of(system: openmm.System) -> np.ndarray:
    """Return the default box vectors of a System as rows, (3, 3), nm."""
    return np.array([edge._value for edge in system.getDefaultPeriodicBoxVectors()])


# --- particles and places ---------------------------------------------------------------------------------------------


def _particles(parts: list[Parts]) -> openmm.System:
    """Make a System of particles, constraints and virtual sites.

    Lengths are numbers of single precision, to which OpenMM's SETTLE rounds.
    """
    system = openmm.System()
    for first, each in _numbered(parts):
        for mass in each.masses:
            system.addParticle(mass)
        for i, j in each.constraints:
            length = float(np.float32(np.linalg.norm(each.places[i] - each.places[j])))
            system.addConstraint(first + i, first + j, length)
        for i, (parents, make) in each.sites.items():
            system.setVirtualSite(first + i, make(*(first + parent for parent in parents)))
    return system


def _placed(parts: list[Parts], rng: np.random.Generator) -> np.ndarray:
    """Put molecules beside each other, each turned at random; return positions (N, 3) in nm."""
    placed = np.empty((0, 3))
    for each in parts:
        shape = Rotation.random(rng=rng).apply(np.array(each.places) - np.mean(each.places, axis=0))
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        away = 0.0
        while len(placed) and np.linalg.norm(placed[:, None] - (shape + away * direction), axis=2).min() < GAP:
            away += 0.04
        placed = np.concatenate([placed, shape + away * direction])
    # PME of the Reference platform misplaces an atom whose coordinate is below zero by rounding.
    return placed + 0.01


def _satisfied(system: openmm.System, x: np.ndarray) -> np.ndarray:
    """Return positions at which constraints hold to rounding and virtual sites are in their places."""
    masses = masses_of(system)
    pairs, lengths = constrained_pairs(system)
    inverse = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)[None, :, None]
    # The starts are good to single precision, from which two steps of Newton's method reach rounding.
    for _ in range(3 if len(pairs) else 0):
        rows = gradients(pairs, x)
        excess = (((x[pairs[:, 0]] - x[pairs[:, 1]]) ** 2).sum(axis=1) - lengths**2) / 2
        weighted = rows * inverse
        x = x - np.tensordot(multipliers(rows, weighted, excess), weighted, 1)
    context = plain_context(system, x)
    context.computeVirtualSites()
    return phase_point(context)[0]


def _velocities(
    system: openmm.System, x: np.ndarray, named: tuple[tuple[int, ...], ...], rng: np.random.Generator
) -> np.ndarray:
    """Return thermal velocities (N, 3) in nm/ps that keep bodies rigid and constraints satisfied."""
    masses = masses_of(system)
    noise = rng.normal(size=x.shape)
    inverse = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    v = noise * np.sqrt(GAS_CONSTANT * TEMPERATURE * inverse)[:, None]
    pairs, _ = constrained_pairs(system)
    if len(pairs):
        rows = gradients(pairs, x)
        weighted = rows * inverse[None, :, None]
        v = v - np.tensordot(multipliers(rows, weighted, rows.reshape(len(rows), -1) @ v.ravel()), weighted, 1)
    for body in map(list, named):
        v[body] = rigid_velocities(masses[body], x[body], v[body])
    return v


def _images(system: openmm.System, named: tuple[tuple[int, ...], ...], rng: np.random.Generator) -> np.ndarray:
    """Return numbers of box vectors for each particle, (N, 3), the same for those that are held together."""
    n = system.getNumParticles()
    held = [system.getConstraintParameters(k)[:2] for k in range(system.getNumConstraints())]
    for i in virtual_sites(system):
        site = system.getVirtualSite(i)
        held += [(i, site.getParticle(k)) for k in range(site.getNumParticles())]
    held += [(body[0], i) for body in named for i in body]
    rows, columns = np.array(held, dtype=int).reshape(-1, 2).T
    parts, part = connected_components(coo_array((np.ones(len(held)), (rows, columns)), (n, n)), directed=False)
    # PME of the Reference platform misplaces atoms below zero by rounding.
    return rng.integers(0, 2, (parts, 3)).astype(float)[part]


# --- forces -----------------------------------------------------------------------------------------------------------


def _add_bonded_forces(mixture: Mixture, system: openmm.System, parts: list[Parts], x: np.ndarray) -> None:
    """Add bonds, angles and torsions, a little away from their minimum."""
    bonds, angles, torsions = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce(), openmm.PeriodicTorsionForce()
    for first, each in _numbered(parts):
        for i, j, constant in each.bonds:
            bonds.addBond(first + i, first + j, 1.01 * np.linalg.norm(x[first + i] - x[first + j]), constant)
        for i, j, k, constant in each.angles:
            present = _angle(*x[[first + i, first + j, first + k]])
            # About any other angle than a straight one the energy of atoms in line has a cusp.
            angles.addAngle(first + i, first + j, first + k, math.pi if present > 3 else 0.98 * present, constant)
        for torsion in each.torsions:
            torsions.addTorsion(*(first + i for i in torsion), 3, 0.5, 5.0)
    if mixture.form == "custom":
        bonds = _with_parameter(bonds)
    for force, terms in (
        (bonds, bonds.getNumBonds),
        (angles, angles.getNumAngles),
        (torsions, torsions.getNumTorsions),
    ):
        force.setUsesPeriodicBoundaryConditions(mixture.crosses)
        if terms():
            system.addForce(force)


def _with_parameter(bonds: openmm.HarmonicBondForce) -> openmm.CustomBondForce:
    """Return the same bonds, whose constants a global parameter multiplies."""
    custom = openmm.CustomBondForce("hard*k*(r-length)^2/2")
    custom.addGlobalParameter("hard", 1.0)
    custom.addPerBondParameter("length")
    custom.addPerBondParameter("k")
    for k in range(bonds.getNumBonds()):
        i, j, *parameters = bonds.getBondParameters(k)
        custom.addBond(i, j, parameters)
    return custom


def _angle(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a - b, c - b)), (a - b) @ (c - b)))


def _surround(mixture: Mixture, system: openmm.System, parts: list[Parts], x: np.ndarray) -> None:
    """Add nonbonded forces, the box and what removes the motion of the centre."""
    if mixture.form != "none":
        force = openmm.NonbondedForce()
        linked = []
        for first, each in _numbered(parts):
            for i, (mass, charge) in enumerate(zip(each.masses, each.charges, strict=True)):
                light = 0 < mass < 2
                force.addParticle(charge, 0.1 if light else 0.25, 0.0 if i in each.sites else (0.05 if light else 0.4))
            joined = [*each.constraints, *(bond[:2] for bond in each.bonds), *each.links]
            linked += [(first + i, first + j) for i, j in joined]
        force.createExceptionsFromBonds(linked, 0.83, 0.5)
        _set_method(mixture, force)
        if mixture.form == "dispersion" and pdist(x).min(initial=GAP) > ONE_PLACE:
            _sum_dispersion(force)
        if mixture.form == "offsets":
            _offset_charges(force)
        system.addForce(_as_variable(force) if mixture.form == "inner" else force)
        if mixture.form == "custom":
            # Slow forces of several groups are a sum less the fast ones.
            custom = _without_dispersion(force)
            custom.setForceGroup(2)
            system.addForce(custom)
    if mixture.surroundings != "vacuum":
        system.setDefaultPeriodicBoxVectors(*_box(mixture, x))
    if mixture.remover:
        system.addForce(openmm.CMMotionRemover(mixture.remover))


def _set_method(mixture: Mixture, force: openmm.NonbondedForce) -> None:
    methods = {"vacuum": force.NoCutoff, "cut-off": force.CutoffPeriodic}
    force.setNonbondedMethod(methods.get(mixture.surroundings, force.PME))
    force.setCutoffDistance(CUTOFF)
    force.setExceptionsUsePeriodicBoundaryConditions(mixture.crosses)
    # A conductor, with which forces end at the cut-off.
    force.setReactionFieldDielectric(1e9)
    if mixture.form == "switched":
        force.setUseSwitchingFunction(True)
        force.setSwitchingDistance(0.8 * CUTOFF)


def _sum_dispersion(force: openmm.NonbondedForce) -> None:
    """Let PME sum Lennard-Jones terms too. OpenMM's energy is not a number then if particles are in one place."""
    if force.getNonbondedMethod() == force.PME:
        force.setNonbondedMethod(force.LJPME)


def _offset_charges(force: openmm.NonbondedForce) -> None:
    """Let a global parameter, which is 1, multiply a quarter of each charge and of each exception."""
    force.addGlobalParameter("coupled", 1.0)
    for i in range(force.getNumParticles()):
        charge, *rest = force.getParticleParameters(i)
        force.setParticleParameters(i, 0.75 * charge, *rest)
        force.addParticleParameterOffset("coupled", i, 0.25 * charge, 0, 0)
    for k in range(force.getNumExceptions()):
        i, j, product, sigma, epsilon = force.getExceptionParameters(k)
        # With an offset an excluded pair, which may be in one place, would be none.
        if product._value:
            force.setExceptionParameters(k, i, j, 0.75 * product, sigma, epsilon)
            force.addExceptionParameterOffset("coupled", k, 0.25 * product, 0, 0)


def _as_variable(force: openmm.Force) -> openmm.CustomCVForce:
    """Return a Force whose energy is that of another one within it."""
    outer = openmm.CustomCVForce("inner")
    outer.addCollectiveVariable("inner", force)
    return outer


def _without_dispersion(force: openmm.NonbondedForce) -> openmm.CustomNonbondedForce:
    """Take the Lennard-Jones terms out of a NonbondedForce, and return a CustomNonbondedForce of them."""
    custom = openmm.CustomNonbondedForce("4*sqrt(e1*e2)*((s/r)^12-(s/r)^6); s=(s1+s2)/2")
    custom.addPerParticleParameter("s")
    custom.addPerParticleParameter("e")
    periodic = force.getNonbondedMethod() != force.NoCutoff
    custom.setNonbondedMethod(custom.CutoffPeriodic if periodic else custom.NoCutoff)
    custom.setCutoffDistance(CUTOFF)
    for i in range(force.getNumParticles()):
        charge, sigma, epsilon = force.getParticleParameters(i)
        custom.addParticle([sigma, epsilon])
        force.setParticleParameters(i, charge, sigma, 0.0)
    for k in range(force.getNumExceptions()):
        custom.addExclusion(*force.getExceptionParameters(k)[:2])
    return custom


def _box(mixture: Mixture, x: np.ndarray) -> np.ndarray:
    """Return vectors of a box in which images of the molecules do not touch."""
    extent = np.maximum(np.ptp(x, axis=0) + GAP, 2.05 * CUTOFF)
    room = np.random.default_rng([mixture.seed, 1]).uniform(1, 1.4, 3)
    if mixture.surroundings != "triclinic PME":
        return np.diag(extent * room)
    shape = TRICLINIC[mixture.seed % 2]
    return extent.max() / shape.diagonal().min() * room[0] * shape
