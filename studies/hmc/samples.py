"""Samples of a solute in water: dihedrals, charges for dipoles, and forces per independent sample."""

from __future__ import annotations

import numpy as np
import openmm
import pandas as pd
from openmm import app

from openmm_sier.analysis.statistics import Estimate
from openmm_sier.dynamics.correlation import inefficiency_and_error
from studies.units import md

#: Atoms of phi and psi, each with its residue beside that of the alpha carbon.
PHI = ((-1, "C"), (0, "N"), (0, "CA"), (0, "C"))
PSI = ((0, "N"), (0, "CA"), (0, "C"), (1, "N"))


def backbone(topology: app.Topology) -> tuple[list[int], ...]:
    """Indices of the atoms of phi and psi of the first residue that has both; empty if none has."""
    residues = [{atom.name: atom.index for atom in residue.atoms()} for residue in topology.residues()]
    wanted = PHI + PSI
    inner = range(1, len(residues) - 1)
    centre = next((i for i in inner if all(name in residues[i + beside] for beside, name in wanted)), None)
    if centre is None:
        return ()
    return tuple([residues[centre + beside][name] for beside, name in atoms] for atoms in (PHI, PSI))


def dihedral(positions: np.ndarray, atoms: list[int]) -> float:
    """The angle of four of the positions (N, 3), of one molecule that is whole, in radians from -pi to pi."""
    a, b, c, d = positions[atoms]
    axis = (c - b) / np.linalg.norm(c - b)
    first, last = np.cross(b - a, axis), np.cross(axis, d - c)
    return float(np.arctan2(np.cross(first, last) @ axis, first @ last))


def charges(system: openmm.System) -> np.ndarray:
    """Charges of the particles, (N,), in e."""
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    return np.array([md(nonbonded.getParticleParameters(i)[0]) for i in range(system.getNumParticles())])


def cost(samples: pd.DataFrame, forces: float) -> Estimate:
    """Forces for an independent sample; the mean over columns, which are components of one vector.

    Args:
        samples: a column for each component.
        forces: from one sample to the next.
    """
    found = np.array([inefficiency_and_error(samples[name].to_numpy()) for name in samples])
    return Estimate(forces * float(found[:, 0].mean()), forces * float(np.linalg.norm(found[:, 1])) / len(found))
