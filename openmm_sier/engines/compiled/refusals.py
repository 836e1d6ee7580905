"""Refuse what the kernels engine cannot move."""

from __future__ import annotations

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.rotation import exact
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import bonded_terms, do_work
from openmm_sier.system.forces import kind_of

#: What ends the text of a refusal.
REMEDY = "take engine='native', or 'exact'"


def refusal(reason: str) -> openmm.OpenMMException:
    """Return the error that names a reason."""
    return openmm.OpenMMException(f"The kernels engine {reason}: {REMEDY}")


def refuse_method(method: IntegrationMethod) -> None:
    """Refuse a method that kernels cannot follow.

    Raises:
        openmm.OpenMMException: the message says why.
    """
    if method.rotation is not exact:
        raise refusal("has only the exact free-rotation map")
    if method.bath is not None and method.bath.shared_frictions is None:
        raise refusal("has no frictions of types")


def refuse_bodies(bodies: BodySet) -> None:
    """Refuse bodies that kernels cannot move.

    Raises:
        openmm.OpenMMException: the message names a body.
    """
    if bodies.bearings is not None:
        body = bodies.describe(bodies.bearings.columns[0])
        raise refusal(f"moves bodies along and about all axes, unlike the type of {body}")
    for species in bodies.species:
        if species.has_other_moments:
            atoms = bodies.describe_atoms(species.atoms[0])
            raise refusal(f"takes moments from masses, and {atoms} has others")


def moved_by_fast_forces(system: openmm.System, bodies: BodySet, groups: int) -> np.ndarray:
    """Return whether fast forces act on each body, (n,).

    Args:
        system: openmm.System.
        bodies: all that moves.
        groups: bit mask of the fast force groups.

    Raises:
        openmm.OpenMMException: a fast force is not bonded, or acts on a particle that is in no body, such as a virtual
            site.
    """
    acted_on = np.zeros(bodies.n, dtype=bool)
    owners = bodies.owners
    is_site = np.zeros(len(owners), dtype=bool)
    is_site[tables.virtual_sites(system)] = True
    for force in system.getForces():
        kind = kind_of(force)
        if not groups >> force.getForceGroup() & 1 or not kind.exerts_forces:
            continue
        name = f"{force.getName()} ({type(force).__name__})"
        if kind.terms is None:
            raise refusal(
                f"takes only bonded forces as fast ones, and {name} is in force group {force.getForceGroup()}"
            )
        terms = bonded_terms(force)
        working = terms[do_work(terms, owners)]
        if is_site[working].any():
            raise refusal(f"places no virtual sites within inner steps, and {name} acts on some")
        moved = owners[working]
        acted_on[moved[moved >= 0]] = True
    return acted_on
