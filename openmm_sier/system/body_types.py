"""Types of rigid bodies: a shape that is given once, and the particles of many bodies that have it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import app, unit

from openmm_sier.dynamics.motion import Motion
from openmm_sier.dynamics.species import (
    LINEAR_MOMENT,
    ONE_PLACE,
    OTHER_MOMENT,
    Species,
    principal_frame,
    tensor_of,
)
from openmm_sier.system.arguments import checked_system
from openmm_sier.system.bound_systems import refuse_bound

_MOMENT = unit.dalton * unit.nanometer**2


@dataclass(frozen=True, eq=False)
class BodyType:
    """A type of rigid bodies, whose shape is given once, in a frame of its own.

    >>> rod = BodyType("rod", [[-0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]], [12, 16, 12])
    >>> rod.dof
    5

    Masses of the sites give the moments of inertia, unless `moments` are given, as for a solid sphere with massless
    patches:

    >>> janus = BodyType("janus", [[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]], [100, 0, 0], moments=[10, 10, 10])

    Attributes:
        name: of the type, which residues have too.
        positions: positions of the sites in the frame of the type, (k, 3), a quantity or numbers in nm.
        masses: masses of the sites, (k,), a quantity or numbers in dalton. Sites may be massless where others are not.
            They give the centre of mass.
        moments: moments of inertia about the centre of mass: three about the axes of the frame, which then are
            principal axes, or a tensor in the frame, (3, 3), a quantity or numbers in dalton nm^2. None takes those of
            the masses.
        motion: along which axes bodies move, and about which they turn, such as `Motion.IN_PLANE`.

    Raises:
        ValueError: arrays have other shapes or contain numbers that are not finite; two sites are at one place; a mass
            is negative, or there is none; no body has these moments; sites are off an axis without a moment; or they
            do not show all rotations that have one; or bodies would turn about two axes with unequal moments.
        TypeError: a value has another unit, `name` is no text, or `motion` is no Motion.
    """

    name: str
    positions: Any
    masses: Any
    moments: Any = None
    motion: Motion = Motion.FREE

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise TypeError(f"name of a body type must be a text that is not empty, got {self.name!r}")
        if not isinstance(self.motion, Motion):
            raise TypeError(f"motion of {self.words} must be a Motion, such as Motion.IN_PLANE, got {self.motion!r}")
        positions = self._array("positions", self.positions, unit.nanometer, "nm")
        masses = self._array("masses", self.masses, unit.dalton, "dalton")
        if positions.ndim != 2 or positions.shape[1:] != (3,) or masses.shape != positions.shape[:1] or not masses.size:
            raise ValueError(
                f"{self.words} needs positions (k, 3) and masses (k,) of at least one site, got {positions.shape} and "
                f"{masses.shape}"
            )
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "masses", masses)
        if self.moments is not None:
            object.__setattr__(self, "moments", self._checked_moments())
        self._refuse_coincident()
        # Refuses what no body has.
        _ = self._model

    @property
    def mass(self) -> float:
        """Return the mass of a body, dalton."""
        return self._model.mass

    @cached_property
    def centre(self) -> np.ndarray:
        """Return the centre of mass in the frame of the type, (3,), nm."""
        return self.masses @ self.positions / self.masses.sum()

    @property
    def principal_moments(self) -> np.ndarray:
        """Return the principal moments of inertia, (3,), ascending, dalton nm^2."""
        return self._model.moments

    @property
    def axes(self) -> np.ndarray:
        """Return the principal axes in the frame of the type, as rows, (3, 3), by ascending moments."""
        return self._model.axes

    @property
    def dof(self) -> int:
        """Return the degrees of freedom of a body."""
        return self._model.dof

    def species(self, atoms: ArrayLike) -> Species:
        """Return bodies of this type, for the particle indices of the sites of each, (m, k)."""
        return self._model.of_atoms(atoms)

    def placed(self, centres: ArrayLike, orientations: ArrayLike | None = None) -> np.ndarray:
        """Return positions of the sites of bodies of this type, (m, k, 3), nm.

        Args:
            centres: centres of mass, (m, 3), a quantity or numbers in nm.
            orientations: quaternions (w, x, y, z), (m, 4), of the rotations from the frame of the type to the lab
                frame, of any length above zero. None leaves the bodies as the type has them.

        Raises:
            ValueError: an array has another shape or a number that is not finite, or a quaternion is zero.
        """
        q = self._array("centres", centres, unit.nanometer, "nm")
        if q.ndim != 2 or q.shape[1] != 3:
            raise ValueError(f"centres must have the shape (m, 3), one row for each body, got {q.shape}")
        arms = np.broadcast_to(self.positions - self.centre, (len(q), *self.positions.shape))
        if orientations is not None:
            turns = np.array(orientations, dtype=float)
            lengths = np.linalg.norm(turns, axis=-1)
            if turns.shape != (len(q), 4) or not np.isfinite(turns).all() or not lengths.all():
                raise ValueError(
                    f"orientations must be quaternions (w, x, y, z) that are not zero, ({len(q)}, 4), got {turns.shape}"
                )
            from scipy.spatial.transform import Rotation

            matrices = Rotation.from_quat(turns[:, [1, 2, 3, 0]]).as_matrix()
            arms = np.einsum("mxy,mky->mkx", matrices, arms)
        return q[:, None] + arms

    # --- checks ---

    @property
    def words(self) -> str:
        """Return the type in words, for messages."""
        return f"the body type {self.name!r}"

    def _array(self, argument: str, values: Any, of: unit.Unit, symbol: str) -> np.ndarray:
        """Return numbers of an argument, which may be a quantity, as an array that nobody can write.

        Raises:
            TypeError: they have another unit, or are not numbers.
            ValueError: one is not finite.
        """
        if unit.is_quantity(values):
            if not values.unit.is_compatible(of):
                raise TypeError(f"{argument} of {self.words} must be in units like {symbol}, got {values}")
            values = values.value_in_unit(of)
        try:
            numbers = np.array(values, dtype=float)
        except (TypeError, ValueError):
            raise TypeError(f"{argument} of {self.words} must be numbers in {symbol}, got {values!r}") from None
        if not np.isfinite(numbers).all():
            raise ValueError(f"{argument} of {self.words} must be finite, got {values!r}")
        numbers.flags.writeable = False
        return numbers

    def _checked_moments(self) -> np.ndarray:
        """Return the moments, (3,), or a symmetric tensor, (3, 3).

        Raises:
            ValueError: they are neither.
        """
        moments = self._array("moments", self.moments, _MOMENT, "dalton nm^2")
        is_one = moments.shape in ((3,), (3, 3))
        if not is_one or np.abs(moments - moments.T).max() > OTHER_MOMENT * np.abs(moments).max():
            raise ValueError(f"{self.words} needs three moments, or a symmetric tensor (3, 3), got {moments.tolist()}")
        return moments

    def _refuse_coincident(self) -> None:
        from scipy.spatial import KDTree

        near = sorted(KDTree(self.positions).query_pairs(ONE_PLACE))
        if near:
            one, other = near[0]
            raise ValueError(
                f"sites {one} and {other} of {self.words} are at one place, {self.positions[one].tolist()} nm, and "
                "could not be told apart: move one of them, or leave it out"
            )

    @cached_property
    def _model(self) -> Species:
        """Return a species without bodies.

        Raises:
            ValueError: no body has these masses and moments.
        """
        atoms = np.empty((0, len(self.masses)), dtype=np.int64)
        if not (self.masses >= 0).all() or not self.masses.any():
            raise ValueError(
                f"{self.words} needs a site with a mass, and none with a negative one, got masses "
                f"{self.masses.tolist()} dalton: give the mass of the body to a site at its centre of mass"
            )
        arms = self.positions - self.centre
        if self.moments is None:
            tensor = tensor_of(self.masses, arms)
        else:
            tensor = np.diag(self.moments) if self.moments.ndim == 1 else self.moments
        sites, axes = principal_frame(arms, tensor)
        try:
            if self.moments is None:
                shape = Species.from_sites(atoms, self.masses, sites)
            else:
                shape = Species(atoms, self.masses, sites, _principal_moments(tensor))
            return replace(shape, name=self.name, axes=axes, motion=self.motion)
        except ValueError as error:
            raise ValueError(f"{self.words}: {error}") from None


def _principal_moments(tensor: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of a tensor of inertia, (3,), ascending; exact ones of a diagonal one, and exact zeros."""
    is_diagonal = not (tensor - np.diag(np.diag(tensor))).any()
    moments = np.sort(np.diag(tensor)) if is_diagonal else np.linalg.eigvalsh(tensor)
    moments[np.abs(moments) <= LINEAR_MOMENT * np.abs(moments).max()] = 0.0
    return moments


def add_bodies(
    system: openmm.System,
    topology: app.Topology,
    kind: BodyType,
    centres: ArrayLike,
    orientations: ArrayLike | None = None,
) -> tuple[list[list[int]], np.ndarray]:
    """Add the particles of bodies of a type to a System and a Topology, which describe the same particles.

    Each body is a residue with the name of the type, in a chain of this call. Add the parameters of the particles to
    your Forces after this, or add Forces.

    >>> system, topology = openmm.System(), openmm.app.Topology()
    >>> dimer = BodyType("dimer", [[0, 0, 0], [0.3, 0, 0]], [40, 40])
    >>> turned = [[1, 0, 0, 0], [0.5**0.5, 0, 0, 0.5**0.5]]
    >>> dimers, positions = add_bodies(system, topology, dimer, [[0, 0, 0], [1, 0, 0]], turned)
    >>> dimers
    [[0, 1], [2, 3]]
    >>> positions.round(3).tolist()
    [[-0.15, 0.0, 0.0], [0.15, 0.0, 0.0], [1.0, -0.15, 0.0], [1.0, 0.15, 0.0]]

    Args:
        system: the System, to which particles with the masses of the sites are added.
        topology: the Topology, to which atoms without elements are added.
        kind: the type.
        centres: centres of mass, (m, 3), a quantity or numbers in nm.
        orientations: see `BodyType.placed`.

    Returns:
        Particle indices of each body, in the order of the sites, and the positions of all of them, (m k, 3), nm.

    Raises:
        ValueError: see `BodyType.placed`; the Topology has another number of atoms than the System has particles; or
            the System already has a Context. Nothing has been changed then.
        TypeError: an argument has the wrong type.
    """
    system = checked_system(system)
    refuse_bound(system)
    if not isinstance(topology, app.Topology):
        raise TypeError(f"topology must be an openmm.app.Topology, got a {type(topology).__name__}")
    if not isinstance(kind, BodyType):
        raise TypeError(f"kind must be a BodyType, got {kind!r}")
    n = system.getNumParticles()
    if topology.getNumAtoms() != n:
        raise ValueError(
            f"the Topology has {topology.getNumAtoms()} atoms, but the System has {n} particles: begin with both "
            "empty, or with those of one structure"
        )
    positions = kind.placed(centres, orientations)
    chain = topology.addChain()
    bodies = []
    for number in range(len(positions)):
        residue = topology.addResidue(kind.name, chain, str(number + 1))
        particles = []
        for site, mass in enumerate(kind.masses.tolist(), 1):
            particles.append(system.addParticle(mass))
            topology.addAtom(f"S{site}", None, residue)
        bodies.append(particles)
    return bodies, positions.reshape(-1, 3)
