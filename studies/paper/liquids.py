"""Liquid water as OpenMM Systems: with the paper's smooth molecular cut-off, and with PME."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import openmm
from openmm import unit

from studies.paper import tip4p
from studies.paper.molecular_cutoff import SITES, MolecularCutoff


@dataclass(frozen=True)
class Cutoffs:
    """Cut-offs of the interactions of a liquid.

    Attributes:
        molecular_on, molecular_off: distances of the oxygens, nm, between which the interaction of two molecules is
            switched off.
        pme: direct-space cut-off of the PME system, nm.
        pme_switch: where its Lennard-Jones interaction starts to be switched off, nm.
        ewald_tolerance: OpenMM's ewaldErrorTolerance. The direct-space sum is cut, not switched, at `pme`; at OpenMM's
            default of 5e-4 the jump hides the error of a fourth-order integrator.
    """

    molecular_on: float = 0.9
    molecular_off: float = 1.1
    pme: float = 1.1
    pme_switch: float = 0.9
    ewald_tolerance: float = 1e-6


MOLECULAR, PME = "molecular cut-off", "PME"


def build(kind: str, n: int, edge: float, cutoffs: Cutoffs) -> openmm.System:
    """A System of n TIP4P molecules (sites O, H, H, M) in a cube.

    Args:
        kind: `MOLECULAR` or `PME`.
        n: number of molecules.
        edge: of the cube, nm.
        cutoffs: where the interactions end.

    Raises:
        ValueError: the kind is unknown or the box too small.
        ImportError: this OpenMM is too old for the molecular cut-off.
    """
    makers = {MOLECULAR: molecular_force, PME: pme_force}
    if kind not in makers:
        raise ValueError(f"the kind of liquid must be one of {', '.join(makers)}, got {kind!r}")
    system = _empty_system(n, edge)
    system.addForce(makers[kind](n, edge, cutoffs))
    return system


def _empty_system(n: int, edge: float) -> openmm.System:
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*(edge * np.eye(3)))
    h_h = 2 * tip4p.R_OH * math.sin(tip4p.ANGLE / 2)
    site = openmm.ThreeParticleAverageSite
    for o in range(0, SITES * n, SITES):
        for mass in (*tip4p.MASSES, 0.0):
            system.addParticle(mass)
        for a, b, distance in ((o, o + 1, tip4p.R_OH), (o, o + 2, tip4p.R_OH), (o + 1, o + 2, h_h)):
            system.addConstraint(a, b, distance)
        w = tip4p.M_WEIGHT
        system.setVirtualSite(o + 3, site(o, o + 1, o + 2, 1 - 2 * w, w, w))
    return system


def molecular_force(n: int, edge: float, cutoffs: Cutoffs) -> openmm.Force:
    """The interaction with a smooth molecular cut-off, see `MolecularCutoff`."""
    require()
    potential = MolecularCutoff(tip4p.SIGMA, tip4p.EPSILON, tip4p.CHARGE, cutoffs.molecular_on, cutoffs.molecular_off)
    potential.check_box(np.full(3, edge))
    force = openmm.PythonForce(potential)
    force.setUsesPeriodicBoundaryConditions(True)
    return force


def require() -> None:
    """Check that this OpenMM supports the molecular cut-off.

    Raises:
        ImportError: this OpenMM is too old.
    """
    if not hasattr(openmm, "PythonForce"):
        raise ImportError(
            f"the molecular cut-off needs openmm.PythonForce, which OpenMM {openmm.version.version} does not have; "
            "install a newer one with: pip install -U openmm"
        )


def pme_force(n: int, edge: float, cutoffs: Cutoffs) -> openmm.NonbondedForce:
    """Particle-mesh Ewald electrostatics and a switched Lennard-Jones interaction."""
    force = openmm.NonbondedForce()
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    force.setCutoffDistance(cutoffs.pme)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(cutoffs.pme_switch)
    force.setEwaldErrorTolerance(cutoffs.ewald_tolerance)
    force.setUseDispersionCorrection(False)  # a constant
    for o in range(0, SITES * n, SITES):
        force.addParticle(0.0, tip4p.SIGMA, tip4p.EPSILON)
        for charge in (tip4p.CHARGE, tip4p.CHARGE, -2 * tip4p.CHARGE):
            force.addParticle(charge, 1.0, 0.0)
        for a, b in itertools.combinations(range(o, o + SITES), 2):
            force.addException(a, b, 0.0, 1.0, 0.0)
    return force


def context(system: openmm.System, integrator: openmm.Integrator, kind: str) -> openmm.Context:
    """A Context for a liquid, in double precision with the molecular cut-off.

    The PME system runs as its users run it: on the CPU platform, whose nonbonded forces are in single precision.
    """
    if kind == MOLECULAR:
        return openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    platform = openmm.Platform.getPlatformByName("CPU")
    return openmm.Context(system, integrator, platform, {"DeterministicForces": "true"})


def energies(context_: openmm.Context) -> tuple[float, float]:
    """Kinetic and potential energy of a Context, kJ/mol."""
    state = context_.getState(energy=True)
    kinetic, potential = state.getKineticEnergy(), state.getPotentialEnergy()
    return kinetic.value_in_unit(unit.kilojoule_per_mole), potential.value_in_unit(unit.kilojoule_per_mole)
