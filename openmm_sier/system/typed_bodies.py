"""The bodies of a System that have types, and checks that the System and the positions fit these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import openmm

from openmm_sier.dynamics.motion import Motion
from openmm_sier.dynamics.species import RigidityError, Species
from openmm_sier.system import tables
from openmm_sier.system.arguments import checked_clusters
from openmm_sier.system.body_types import BodyType
from openmm_sier.system.geometries import EMBEDDING_TOLERANCE

#: Sine of the largest inclination of the axis of a body that turns in the plane: positions in files are rounded.
MOST_INCLINED = 0.05


def typed_species(
    system: openmm.System, types: Mapping[BodyType, Sequence[Sequence[int]]], positions: np.ndarray
) -> list[Species]:
    """Return the bodies of types, for the particle indices of each body; see `RigidBodies.from_types` for errors.

    Args:
        system: the System.
        types: lists of particle indices for each type.
        positions: of all particles, (N, 3), nm.
    """
    if not hasattr(types, "items") or not all(isinstance(kind, BodyType) for kind in types):
        raise TypeError(f"types must be a mapping from BodyType to lists of particle indices, got {types!r}")
    names = [kind.name for kind in types]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"types must have different names, but several have the name {twice[0]!r}")
    species = []
    for kind, bodies in types.items():
        lists = checked_clusters(bodies)
        for number, particles in enumerate(lists):
            if len(particles) != len(kind.masses):
                raise ValueError(
                    f"{kind.words} has {len(kind.masses)} sites, but list {number} of its bodies has "
                    f"{len(particles)} particles: give one for each site, in the order of the sites"
                )
        species.append(kind.species(np.reshape(lists, (-1, len(kind.masses)))))
    _refuse_shared(species, len(positions))
    for shape in species:
        _refuse_other_masses(system, shape)
        _refuse_other_shapes(shape, positions)
        _refuse_other_lengths(system, shape)
    return [shape for shape in species if len(shape.atoms)]


def _refuse_shared(species: list[Species], n: int) -> None:
    """Refuse particles that the System does not have, and those in two bodies."""
    particles = np.concatenate([np.empty(0, np.int64), *(kind.atoms.ravel() for kind in species)])
    outside = particles[(particles < 0) | (particles >= n)]
    if outside.size:
        raise ValueError(f"bodies name particle {outside[0]}, but the System has only {n} particles")
    twice = np.flatnonzero(np.bincount(particles, minlength=n) > 1)
    if twice.size:
        raise ValueError(f"bodies name particle {twice[0]} twice")


def _refuse_other_masses(system: openmm.System, kind: Species) -> None:
    masses = tables.masses(system)
    wrong = np.argwhere(masses[kind.atoms] != kind.masses)
    if len(wrong):
        body, site = wrong[0].tolist()
        particle = int(kind.atoms[body, site])
        raise ValueError(
            f"particle {particle} has a mass of {masses[particle]:g} dalton in the System, but site {site} of the body "
            f"type {kind.name!r} has {kind.masses[site]:g}: call system.setParticleMass({particle}, "
            f"{kind.masses[site]:g}), or give the type the masses of the System and its moments"
        )
    sites = np.isin(kind.atoms, tables.virtual_sites(system))
    if sites.any():
        raise ValueError(
            f"particle {kind.atoms[sites][0]} is a virtual site, which OpenMM places: leave it out of the body type "
            f"{kind.name!r}, and it follows its body"
        )


def _refuse_other_shapes(kind: Species, positions: np.ndarray) -> None:
    """Refuse positions that do not fit the shape of a type."""
    x = positions[kind.atoms]
    arms = x - np.einsum("k,mkx->mx", kind.masses / kind.mass, x)[:, None]
    if not np.isfinite(arms).all():
        particle = kind.atoms[~np.isfinite(x).all(axis=2)][0]
        raise RigidityError(f"the position of particle {particle} is not finite")
    if not len(arms):
        return
    A, misfit = kind.fit(arms)
    body = int(misfit.argmax())
    if misfit[body] > kind.tolerance:
        off = np.linalg.norm(arms[body] - np.einsum("ak,ax->kx", kind.sites, A[:, :, body]), axis=1)
        site = int(off.argmax())
        raise RigidityError(
            f"particle {kind.atoms[body, site]} is {off[site]:.4g} nm from site {site} of the body type {kind.name!r}, "
            f"and only {kind.tolerance:.4g} nm or less is corrected ({np.count_nonzero(misfit > kind.tolerance)} of "
            f"{len(misfit)} bodies of the type do not fit): list the particles in the order of the sites, and give "
            "positions in nm; make_whole(system, positions, bodies=lists) joins bodies that the periodic boundary cuts"
        )
    if kind.motion == Motion.IN_PLANE and kind.turns.any():
        _refuse_inclined(kind, A[2])


def _refuse_inclined(kind: Species, axes: np.ndarray) -> None:
    """Refuse bodies that are to turn in the plane about axes, (3, m), of which one is not along z."""
    inclination = np.hypot(axes[0], axes[1])
    body = int(inclination.argmax())
    if inclination[body] > MOST_INCLINED:
        raise RigidityError(
            f"the body of particle {kind.atoms[body, 0]}, of the type {kind.name!r} with Motion.IN_PLANE, turns about "
            f"its last principal axis, and that is along {axes[:, body].round(3).tolist()}: place the body with this "
            "axis along z, or give the type a Motion about another axis"
        )


def _refuse_other_lengths(system: openmm.System, kind: Species) -> None:
    """Refuse constraints within bodies whose lengths are not those of the type."""
    pairs, lengths = tables.constraints(system)
    place = np.full(system.getNumParticles(), -1)
    body = np.full(system.getNumParticles(), -1)
    place[kind.atoms] = np.arange(kind.atoms.shape[1])
    body[kind.atoms] = np.arange(len(kind.atoms))[:, None]
    inside = np.flatnonzero((body[pairs[:, 0]] == body[pairs[:, 1]]) & (body[pairs[:, 0]] >= 0))
    ends = place[pairs[inside]]
    distances = np.linalg.norm(kind.sites[:, ends[:, 0]] - kind.sites[:, ends[:, 1]], axis=0)
    wrong = np.abs(distances - lengths[inside]) > EMBEDDING_TOLERANCE
    if wrong.any():
        k = int(wrong.argmax())
        one, other = pairs[inside[k]].tolist()
        raise RigidityError(
            f"the constraint between particles {one} and {other} has {lengths[inside[k]]:.4f} nm, but their sites of "
            f"the body type {kind.name!r} are {distances[k]:.4f} nm apart: remove the constraint, or correct its length"
        )
