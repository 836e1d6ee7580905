"""Mechanics of atoms, constraints and rigid bodies, which shares nothing with the package."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import openmm

#: Motions of a body that are smaller than this part of the largest are those of a line about itself, from which its
#: atoms may be off by 1e-5 nm. Constraints that others imply change by less than this.
LINE, REDUNDANT = 1e-3, 1e-7


def masses_of(system: openmm.System) -> np.ndarray:
    """Return masses (N,) in dalton."""
    return np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])


def virtual_sites(system: openmm.System) -> list[int]:
    """Return the virtual sites of a System."""
    return [i for i in range(system.getNumParticles()) if system.isVirtualSite(i)]


# --- constraints ------------------------------------------------------------------------------------------------------


def constrained_pairs(system: openmm.System) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (K, 2) of particles with a mass, and their constrained lengths in nm."""
    rows = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    rows = [row for row in rows if system.getParticleMass(row[0])._value and system.getParticleMass(row[1])._value]
    pairs = np.array([row[:2] for row in rows], dtype=int).reshape(-1, 2)
    return pairs, np.array([row[2]._value for row in rows])


def gradients(pairs: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return half of the derivatives (K, N, 3) of the squared lengths of constraints."""
    result = np.zeros((len(pairs), *x.shape))
    apart = x[pairs[:, 0]] - x[pairs[:, 1]]
    result[np.arange(len(pairs)), pairs[:, 0]] = apart
    result[np.arange(len(pairs)), pairs[:, 1]] = -apart
    return result


def multipliers(rows: np.ndarray, weighted: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve the equations of constraints, which may be redundant.

    Args:
        rows: (K, N, 3), see `gradients`.
        weighted: the same divided by the masses.
        right: (K,).
    """
    matrix = weighted.reshape(len(rows), -1) @ rows.reshape(len(rows), -1).T
    sizes, axes = np.linalg.eigh(matrix)
    inverse = np.where(sizes > 1e-10 * sizes[-1], 1 / sizes, 0.0)
    return axes @ (inverse * (right @ axes))


# --- bodies -----------------------------------------------------------------------------------------------------------


def cross(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return cross products (..., 3); NumPy's function takes several times as long for a few vectors."""
    a, b, c = one[..., 0], one[..., 1], one[..., 2]
    x, y, z = two[..., 0], two[..., 1], two[..., 2]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=-1)


def centre_of(masses: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return means (..., 3), weighted by masses (k,), of vectors (..., k, 3)."""
    return masses @ vectors / masses.sum()


def with_centres(masses: np.ndarray, x: np.ndarray, molecules: list[list[int]], stretch: np.ndarray) -> np.ndarray:
    """Return positions (N, 3), nm, of molecules whose centres of mass a matrix (3, 3) has moved, and nothing else."""
    moved = x.copy()
    for atoms in molecules:
        centre = centre_of(masses[atoms], x[atoms])
        moved[atoms] += centre @ stretch - centre
    return moved


def inertia(masses: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return the tensor of inertia (3, 3) of masses (k,) at places (k, 3) from their centre, dalton nm^2."""
    return np.diag(np.full(3, masses @ (arms**2).sum(axis=1))) - (masses[:, None] * arms).T @ arms


def angular_momentum(masses: np.ndarray, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return angular momenta (..., 3) about the centres of mass, of positions and velocities (..., k, 3)."""
    return masses @ cross(x - centre_of(masses, x)[..., None, :], v)


def inverse_inertia(masses: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Return the inverse (3, 3) of `inertia`, and 0 about an axis on which all atoms are."""
    return np.linalg.pinv(inertia(masses, arms), rcond=1e-10, hermitian=True)


def rigid_velocities(masses: np.ndarray, x: np.ndarray, v: np.ndarray, places: np.ndarray | None = None) -> np.ndarray:
    """Return the velocities of a rigid body with the momentum and angular momentum of its atoms.

    Args:
        masses: (k,).
        x: positions (k, 3).
        v: velocities (k, 3).
        places: at which velocities are wanted, (n, 3); None: those of the atoms.
    """
    centre = centre_of(masses, x)
    spin = inverse_inertia(masses, x - centre) @ angular_momentum(masses, x, v)
    return centre_of(masses, v) + cross(spin, (x if places is None else places) - centre)


def principal_axes(masses: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return places (k, 3) along the principal axes of a body, and its moments in ascending order."""
    arms = x - centre_of(masses, x)
    moments, axes = np.linalg.eigh(inertia(masses, arms))
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return arms @ axes, np.where(moments > 1e-12 * moments.max(), moments, 0.0)


# --- motions that constraints and bodies allow ------------------------------------------------------------------------


def allowed_motions(
    masses: np.ndarray, x: np.ndarray, bodies: Sequence[Sequence[int]], pairs: np.ndarray
) -> np.ndarray:
    """Return an orthonormal basis of the allowed velocities times the roots of the masses, (3N, freedoms).

    Args:
        masses: (N,); particles without mass do not move.
        x: positions (N, 3).
        bodies: atoms with mass of each rigid body.
        pairs: (K, 2), which constraints hold.
    """
    root = np.sqrt(masses)
    owned = {i for atoms in bodies for i in atoms}
    columns = [np.eye(3 * len(root))[3 * i + k] for i in np.flatnonzero(root) if i not in owned for k in range(3)]
    for atoms in map(list, bodies):
        arms = x[atoms] - centre_of(masses[atoms], x[atoms])
        motions = np.zeros((6, len(root), 3))
        for k in range(3):
            motions[k, atoms, k] = root[atoms]
            motions[3 + k, atoms] = root[atoms, None] * cross(np.eye(3)[k], arms)
        basis, sizes, _ = np.linalg.svd(motions.reshape(6, -1).T, full_matrices=False)
        columns += list(basis.T[sizes > LINE * sizes.max()])
    basis = np.array(columns).reshape(-1, x.size).T
    if not len(pairs) or not basis.size:
        return basis
    inverse = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0)
    lengths = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    rows = gradients(pairs, x) / lengths[:, None, None] * inverse[:, None]
    _, sizes, kernel = np.linalg.svd(rows.reshape(len(pairs), -1) @ basis)
    # The rows of constraints within a rigid body are rounding.
    return basis @ kernel[np.sum(sizes > REDUNDANT * inverse[root > 0].min()) :].T
