"""Bodies fitted to the positions of atoms, and positions that are not those of the body refused."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from openmm_sier.dynamics.bodies import BodyState, RigidBodies, Species

#: Largest distance in nm between an atom and its place in the reference geometry that is accepted. Water models differ
#: by up to 0.0142 nm (OPC and TIP3P-FB), from crystallographic hydrogens by up to 0.0167 nm (O-H of 0.084 nm,
#: TIP3P-FB). Molecules that are cut by the periodic boundary are off by far more.
FIT_TOLERANCE = 0.02

#: And at most this fraction of the shortest distance in the body: every atom is then nearer to its own place than to
#: that of any other atom, so that none can be taken for another.
FIT_FRACTION = 0.25

#: Positions that fit the mirror image this many times better than the body are those of the mirror image. Where the two
#: fit about equally, the body is planar within the deviation, and its hand is not to be told.
MIRROR_MARGIN = 2.0

#: Sites this close in nm are at one place, and need not be told apart.
ONE_PLACE = 1e-9


class RigidityError(ValueError):
    """Atoms do not form the rigid body that they are meant to form."""


def fit_bodies(bodies: RigidBodies, positions, previous: BodyState | None):
    """`RigidBodies.fit_with_misfit`."""
    q, A = np.empty((3, bodies.n)), np.empty((3, 3, bodies.n))
    misfit = np.zeros(bodies.n)
    for species, part in zip(bodies.species, bodies.parts, strict=True):
        x = positions[species.atoms]
        centre = np.einsum("k,mkx->mx", species.masses / species.mass, x)
        q[:, part] = centre.T
        if not np.isfinite(centre).all():
            body = part.start + int(np.flatnonzero(~np.isfinite(centre).all(axis=1))[0])
            raise RigidityError(f"the positions of {bodies.describe(body)} are not finite")
        arms = x - centre[:, None, :]
        kept = None if previous is None else previous.A[:, :, part]
        A[:, :, part], misfit[part] = fit_attitudes(species, arms, kept)
        _refuse_mirrored(bodies, species, part, misfit[part], arms)
    _refuse_torn(bodies, misfit)
    return q, A, misfit


def _refuse_mirrored(bodies: RigidBodies, species: Species, part: slice, misfit, arms) -> None:
    # Nearer to the body than half way to the mirror image they cannot fit that better by the margin.
    suspects = np.flatnonzero(misfit > 0.5 * species.mirror_distance)
    if species.mirror_distance == 0 or not suspects.size:
        return
    mirrored = fit_attitudes(species.mirrored(), arms[suspects])[1]
    of_mirror = suspects[(mirrored * MIRROR_MARGIN < misfit[suspects]) & (mirrored <= species.tolerance)]
    if of_mirror.size:
        raise RigidityError(
            f"{bodies.describe(part.start + int(of_mirror[0]))} does not have the shape of its rigid body but that of "
            f"its mirror image ({of_mirror.size} bodies of this kind fail)"
        )


def _refuse_torn(bodies: RigidBodies, misfit) -> None:
    tolerances = np.repeat([s.tolerance for s in bodies.species], [len(s.atoms) for s in bodies.species])
    torn = misfit > tolerances
    if not torn.any():
        return
    worst = int(np.where(torn, misfit, 0.0).argmax())
    raise RigidityError(
        f"{bodies.describe(worst)} does not have the shape of its rigid body: an atom is {misfit[worst]:.4f} nm from "
        f"its place, at most {tolerances[worst]:.4g} nm can be mended ({np.count_nonzero(torn)} bodies fail). Is the "
        "molecule whole (not cut by the periodic boundary)? If constraints hold it, context.applyConstraints(1e-6) may "
        "mend it. If it was named as a rigid body, no constraint holds it, and its atoms must not be moved one by one: "
        "minimize the energy in a Context with this integrator, or start from the positions that it was made of"
    )


def recognition_limit(sites) -> float:
    """`Species.tolerance` of sites (3, k)."""
    shortest = np.inf
    for i in range(1, sites.shape[1]):
        # One row at a time: all pairs of a large body, a rigid protein say, would take much memory.
        apart = np.linalg.norm(sites[:, :i] - sites[:, i, None], axis=0)
        shortest = apart[apart > ONE_PLACE].min(initial=shortest)
    return float(min(FIT_TOLERANCE, FIT_FRACTION * shortest))


def mirror_distance(species: Species) -> float:
    """`Species.mirror_distance`."""
    if not species.sites.any(axis=1).all():
        return 0.0
    return float(fit_attitudes(species.mirrored(), species.sites.T[None])[1][0])


def fit_attitudes(species: Species, arms, kept=None):
    """Attitudes that turn the sites of a species onto atoms, and the largest distance left for each body.

    The best rotation in the sense of mass-weighted least squares, from a singular value decomposition (Kabsch,
    Acta Cryst. A 34, 827 (1978)).

    Args:
        species: what to turn.
        arms: atom positions from the centres of mass, (m, k, 3), nm.
        kept: attitudes (3, 3, m) that are returned as they are if they fit to rounding.

    Returns:
        (A, misfit), shapes (3, 3, m) and (m,).
    """
    m = arms.shape[0]
    if not species.sites.any():
        attitudes = np.repeat(np.eye(3)[:, :, None], m, axis=2) if kept is None else kept
        return attitudes, np.linalg.norm(arms, axis=2).max(axis=1)
    if kept is not None:
        misfit = _misfit(species, arms, kept)
        # Atom positions carry the rounding of coordinates of some nm.
        if misfit.max() < 1e-13 * (1 + np.abs(arms).max()):
            return kept, misfit
    correlation = np.einsum("k,ak,mkx->max", species.masses, species.sites, arms)
    u, _, vt = np.linalg.svd(correlation)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    attitudes = np.ascontiguousarray((u @ vt).transpose(1, 2, 0))
    return attitudes, _misfit(species, arms, attitudes)


def _misfit(species: Species, arms, A):
    places = np.einsum("ak,axm->mkx", species.sites, A)
    return np.linalg.norm(arms - places, axis=2).max(axis=1)
