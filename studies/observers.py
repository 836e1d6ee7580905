"""Observers of solutes in water: temperatures by kind of motion, bonded energies, dihedrals, density, dipole."""

from __future__ import annotations

import numpy as np
import openmm
import pandas as pd
from openmm import app, unit

from openmm_sier import SIERIntegrator
from openmm_sier.analysis.statistics import Estimate
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.correlation import inefficiency_and_error
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.system import tables
from studies.units import md

#: Kinds of bonded energy, by the class of Force that has it.
BONDED = {"bonds": "HarmonicBondForce", "angles": "HarmonicAngleForce", "torsions": "PeriodicTorsionForce"}

#: Components of the box's dipole moment.
DIPOLE = ("dipole_x", "dipole_y", "dipole_z")

#: The dihedrals of the backbone.
ANGLES = ("phi", "psi")

#: Atoms of phi and psi, each with its residue beside that of the alpha carbon.
PHI = ((-1, "C"), (0, "N"), (0, "CA"), (0, "C"))
PSI = ((0, "N"), (0, "CA"), (0, "C"), (1, "N"))

#: Relative tolerance of velocities along constraints.
VELOCITY_TOLERANCE = 1e-6


class OfSolution:
    """Observes water and what is dissolved in it, at the end of a step.

    Molecules of three massive atoms with three constraints are water. With SIER2 in a bath temperatures are those just
    after the bath. OpenMM's integrators leave components of velocities along constraints, which are taken away.
    """

    def __init__(self, system: openmm.System, topology: app.Topology | None = None, platform: str | None = "Reference"):
        """
        Args:
            system: of the Context.
            topology: by which dihedrals of a backbone are found; None: without them.
            platform: of a Context of the bonded Forces alone.
        """
        self._masses = tables.masses(system)
        self._total = self._masses.sum() / (unit.AVOGADRO_CONSTANT_NA._value * 1e-21)
        self._waters = _waters(system)
        water = np.zeros(len(self._masses), dtype=bool)
        water[self._waters] = True
        solute = ~water & (self._masses > 0)
        held = np.count_nonzero(solute[tables.constraints(system).pairs[:, 0]])
        self._solute = solute, 3 * np.count_nonzero(solute) - held
        self._bonded = _bonded(system, platform) if solute.any() else None
        self._dihedrals = backbone(topology) if topology is not None else ()
        self._charges = charges(system)

    def __call__(self, context: openmm.Context) -> dict[str, float]:
        """Return temperatures in K, energies in kJ/mol, density in g/cm³, the dipole in e nm, and angles in radians."""
        integrator = context.getIntegrator()
        if not isinstance(integrator, SIERIntegrator):
            context.applyVelocityConstraints(VELOCITY_TOLERANCE)
        state = context.getState(positions=True, velocities=True, energy=True)
        positions = md(state.getPositions(asNumpy=True))
        found = self._temperatures(integrator, md(state.getVelocities(asNumpy=True)))
        found["temperature"] = found["water"]
        found["potential"] = md(state.getPotentialEnergy())
        found["density"] = self._total / md(state.getPeriodicBoxVolume())
        if self._bonded is not None:
            self._bonded.setPositions(positions)
            for group, kind in enumerate(BONDED):
                found[kind] = md(self._bonded.getState(energy=True, groups=1 << group).getPotentialEnergy())
        found |= dict(zip(DIPOLE, self._charges @ positions, strict=True))
        if self._dihedrals:
            angles = [dihedral(positions, atoms) for atoms in self._dihedrals]
            found |= dict(zip(ANGLES, angles, strict=True)) | {"helical": float(max(angles) < 0)}
        return found

    def _temperatures(self, integrator: openmm.Integrator, velocities: np.ndarray) -> dict[str, float]:
        if isinstance(integrator, SIERIntegrator):
            known = integrator.computeTemperatures().in_kelvin()
            return known._asdict() | {"water": (known.translation + known.rotation) / 2, "solute": known.flexible}
        twice = self._masses * (velocities**2).sum(axis=1)
        masses = self._masses[self._waters]
        momenta = (masses[:, :, None] * velocities[self._waters]).sum(axis=1)
        moving = ((momenta**2).sum(axis=1) / masses.sum(axis=1)).sum()
        freedoms = 3 * len(self._waters) * GAS_CONSTANT
        whole = twice[self._waters].sum()
        found = {
            "water": whole / (2 * freedoms),
            "translation": moving / freedoms,
            "rotation": (whole - moving) / freedoms,
        }
        solute, its_freedoms = self._solute
        return found | ({"solute": twice[solute].sum() / (its_freedoms * GAS_CONSTANT)} if its_freedoms else {})


def _waters(system: openmm.System) -> np.ndarray:
    """Return the atoms of molecules of three atoms that three constraints hold, (m, 3)."""
    pairs = tables.constraints(system).pairs
    molecules = joined(system.getNumParticles(), pairs)
    numbers, sizes = np.unique(molecules, return_counts=True)
    counts = np.bincount(molecules[pairs[:, 0]], minlength=numbers.max() + 1)
    chosen = numbers[(sizes == 3) & (counts[numbers] == 3)]
    atoms = np.flatnonzero(np.isin(molecules, chosen))
    return atoms[np.argsort(molecules[atoms], kind="stable")].reshape(-1, 3)


def _bonded(system: openmm.System, platform: str | None) -> openmm.Context:
    """Return a Context of the bonded Forces alone, each in the group of its place in `BONDED`."""
    bare = openmm.System()
    for _ in range(system.getNumParticles()):
        bare.addParticle(1)
    kinds = list(BONDED.values())
    for force in system.getForces():
        if (kind := type(force).__name__) in kinds:
            copy = openmm.XmlSerializer.clone(force)
            copy.setForceGroup(kinds.index(kind))
            bare.addForce(copy)
    return make_context(bare, openmm.VerletIntegrator(0.001), platform)


def backbone(topology: app.Topology) -> tuple[list[int], ...]:
    """Return the indices of the atoms of phi and psi of the first residue that has both; empty if none has."""
    residues = [{atom.name: atom.index for atom in residue.atoms()} for residue in topology.residues()]
    wanted = PHI + PSI
    inner = range(1, len(residues) - 1)
    centre = next((i for i in inner if all(name in residues[i + beside] for beside, name in wanted)), None)
    if centre is None:
        return ()
    return tuple([residues[centre + beside][name] for beside, name in atoms] for atoms in (PHI, PSI))


def dihedral(positions: np.ndarray, atoms: list[int]) -> float:
    """Return the angle of four of the positions (N, 3), of one molecule that is whole, in radians from -pi to pi."""
    a, b, c, d = positions[atoms]
    axis = (c - b) / np.linalg.norm(c - b)
    first, last = np.cross(b - a, axis), np.cross(axis, d - c)
    return float(np.arctan2(np.cross(first, last) @ axis, first @ last))


def charges(system: openmm.System) -> np.ndarray:
    """Return the charges of the particles, (N,), in e."""
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    return np.array([md(nonbonded.getParticleParameters(i)[0]) for i in range(system.getNumParticles())])


def cost(samples: pd.DataFrame, forces: float) -> Estimate:
    """Return the forces for an independent sample; the mean over columns, which are components of one vector.

    Args:
        samples: a column for each component.
        forces: from one sample to the next.
    """
    found = np.array([inefficiency_and_error(samples[name].to_numpy()) for name in samples])
    return Estimate(forces * float(found[:, 0].mean()), forces * float(np.linalg.norm(found[:, 1])) / len(found))
