"""Checks which forces can be the fast forces of a native program."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import openmm

from openmm_sier.system.bonded_terms import WITHOUT_FORCES, bonded_kind, bonded_terms


def refuse(system: openmm.System, groups: Collection[int], integration_groups: int) -> None:
    """Refuse fast forces that a native program cannot have in its drifts.

    Within a native step atoms move and virtual sites do not. So a fast force must not act on virtual sites; in a System
    without them any force can be fast.

    Args:
        system: openmm.System.
        groups: the fast force groups.
        integration_groups: bit mask of the groups that move the atoms, as from `getIntegrationForceGroups`.

    Raises:
        openmm.OpenMMException: a fast group is not among `integration_groups`, or a Force in it may act on a virtual
            site.
    """
    for group in sorted(groups):
        if not integration_groups >> group & 1:
            raise openmm.OpenMMException(f"The fast force group {group} is not among the integration force groups")
    sites = {i for i in range(system.getNumParticles()) if system.isVirtualSite(i)}
    for force in system.getForces():
        if sites and force.getForceGroup() in groups and not isinstance(force, WITHOUT_FORCES):
            _refuse_sites(force, sites)


def _refuse_sites(force: openmm.Force, sites: set[int]) -> None:
    name = f"{force.getName()} ({type(force).__name__}) is in the fast force group {force.getForceGroup()}"
    remedy = "Put it into another group with setForceGroup, or take engine='exact'"
    if bonded_kind(force) is None:
        raise openmm.OpenMMException(
            f"{name} and may act on virtual sites, which stay behind within a step of the native engine. {remedy}"
        )
    for atom in np.unique(bonded_terms(force)).tolist():
        if atom in sites:
            raise openmm.OpenMMException(
                f"{name} and acts on atom {atom}, a virtual site, which stays behind within a step of the native "
                f"engine. {remedy}"
            )
