"""Bodies fitted to atom positions, and how far atoms may be from their places in the body."""

from __future__ import annotations

import numpy as np

#: Largest accepted distance in nm between an atom and its place in the reference geometry. Water models differ by up to
#: 0.0142 nm (OPC and TIP3P-FB), and from crystallographic hydrogens by up to 0.0167 nm (O-H of 0.084 nm, TIP3P-FB).
#: Molecules that are cut by the periodic boundary are off by far more.
FIT_TOLERANCE = 0.02

#: The distance must also be at most this fraction of the shortest distance in the body. Every atom is then nearer to
#: its own place than to that of any other atom, so that none can be mistaken for another.
FIT_FRACTION = 0.25

#: Positions that fit the mirror image this many times better than the body are those of the mirror image. If the two
#: fit about equally, the body is planar within the deviation, and its handedness cannot be told.
MIRROR_MARGIN = 2.0

#: Sites at most this far apart, in nm, are at one place and need not be told apart.
ONE_PLACE = 1e-9

#: Turns sites into their mirror image, whose principal axes are the same.
MIRROR = np.array([[1.0], [1.0], [-1.0]])


class RigidityError(ValueError):
    """Atoms do not form the rigid body that they are meant to form."""


def tolerance_of(sites: np.ndarray) -> float:
    """Largest distance in nm of an atom from its place at which the body of sites (3, k) is still recognized."""
    shortest = np.inf
    for i in range(1, sites.shape[1]):
        # One row at a time: all pairs of a large body, a rigid protein say, would take much memory.
        apart = np.linalg.norm(sites[:, :i] - sites[:, i, None], axis=0)
        shortest = apart[apart > ONE_PLACE].min(initial=shortest)
    return float(min(FIT_TOLERANCE, FIT_FRACTION * shortest))


def distance_from_mirror_image(sites: np.ndarray, masses: np.ndarray) -> float:
    """Largest distance in nm between an atom and its place in the mirror image; 0 for a planar body."""
    if not sites.any(axis=1).all():
        return 0.0
    return float(fit_attitudes(MIRROR * sites, masses, sites.T[None])[1][0])


def fit_mirror_image(sites: np.ndarray, masses: np.ndarray, arms: np.ndarray, misfit: np.ndarray) -> np.ndarray:
    """Which bodies are mirror images, (m,): those whose atoms fit one, and `MIRROR_MARGIN` times better than the body.

    Args:
        sites: of the body, (3, k), nm.
        masses: (k,).
        arms: atom positions from the centres of mass, (m, k, 3), nm.
        misfit: of the body itself, (m,), nm.
    """
    mirrored = fit_attitudes(MIRROR * sites, masses, arms)[1]
    return (mirrored * MIRROR_MARGIN < misfit) & (mirrored <= tolerance_of(sites))


def fit_attitudes(
    sites: np.ndarray, masses: np.ndarray, arms: np.ndarray, kept: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Attitudes that turn the sites of a body onto atoms, and the largest distance left for each body.

    The best rotation in the sense of mass-weighted least squares, from a singular value decomposition (Kabsch,
    Acta Cryst. A 34, 827 (1978)).

    Args:
        sites: what to turn, (3, k), nm.
        masses: (k,).
        arms: atom positions from the centres of mass, (m, k, 3), nm.
        kept: attitudes (3, 3, m) that are returned as they are if they fit to rounding.

    Returns:
        (A, misfit), shapes (3, 3, m) and (m,).
    """
    m = arms.shape[0]
    if not sites.any():
        attitudes = np.repeat(np.eye(3)[:, :, None], m, axis=2) if kept is None else kept
        return attitudes, np.linalg.norm(arms, axis=2).max(axis=1)
    if kept is not None:
        misfit = _misfit(sites, arms, kept)
        # Atom positions carry the rounding of coordinates of some nm.
        if misfit.max() < 1e-13 * (1 + np.abs(arms).max()):
            return kept, misfit
    correlation = np.einsum("k,ak,mkx->max", masses, sites, arms)
    u, _, vt = np.linalg.svd(correlation)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    attitudes = np.ascontiguousarray((u @ vt).transpose(1, 2, 0))
    return attitudes, _misfit(sites, arms, attitudes)


def _misfit(sites: np.ndarray, arms: np.ndarray, A: np.ndarray) -> np.ndarray:
    places = np.einsum("ak,axm->mkx", sites, A)
    return np.linalg.norm(arms - places, axis=2).max(axis=1)
