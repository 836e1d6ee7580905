"""A capped peptide in a few waters, built by the program that makes the shipped one."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
from openmm import app, unit

PROGRAM = Path(__file__).parents[2] / "systems" / "peptide.py"


def program():
    """The module systems/peptide.py."""
    specification = importlib.util.spec_from_file_location("peptide", PROGRAM)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def capped_alanine(waters):
    """System without a cut-off, bonds of hydrogen constrained, and positions (N, 3) in nm, of ACE-ALA-NME in water."""
    maker = program()
    topology, positions = maker.chain(["ALA"], -75.0, 145.0)
    forcefield = app.ForceField("amber14/protein.ff14SB.xml", "amber14/tip3p.xml")
    modeller = app.Modeller(topology, positions * unit.nanometer)
    modeller.addHydrogens(forcefield, platform=None)
    modeller.addSolvent(forcefield, padding=0.5 * unit.nanometer)
    # The waters nearest to the chain.
    x = np.array(modeller.positions.value_in_unit(unit.nanometer))
    chain = [atom.index for atom in modeller.topology.atoms() if atom.residue.name != "HOH"]
    solvent = [residue for residue in modeller.topology.residues() if residue.name == "HOH"]
    away = {r: np.linalg.norm(x[next(r.atoms()).index] - x[chain], axis=1).min() for r in solvent}
    modeller.delete(sorted(solvent, key=away.get)[waters:])
    system = forcefield.createSystem(modeller.topology, constraints=app.HBonds, removeCMMotion=False)
    return system, np.array(modeller.positions.value_in_unit(unit.nanometer))
