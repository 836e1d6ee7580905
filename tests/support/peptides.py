"""A capped peptide in a few waters, built by the program that makes the shipped one."""

import functools
from pathlib import Path

import numpy as np
from openmm import app, unit

from tests.support.commands import load_program
from tests.support.waters import platform

PROGRAM = Path(__file__).parents[2] / "systems" / "peptide.py"


@functools.cache
def capped_alanine_box(waters):
    """Topology and positions (N, 3) in nm of ACE-ALA-NME and the waters nearest to it, without a periodic box."""
    maker = load_program(PROGRAM)
    topology, positions = maker.chain(["ALA"], -75.0, 145.0)
    field = forcefield()
    modeller = app.Modeller(topology, positions * unit.nanometer)
    modeller.addHydrogens(field, platform=platform())
    modeller.addSolvent(field, padding=0.5 * unit.nanometer)
    x = np.array(modeller.positions.value_in_unit(unit.nanometer))
    chain = [atom.index for atom in modeller.topology.atoms() if atom.residue.name != "HOH"]
    solvent = [residue for residue in modeller.topology.residues() if residue.name == "HOH"]
    away = {r: np.linalg.norm(x[next(r.atoms()).index] - x[chain], axis=1).min() for r in solvent}
    modeller.delete(sorted(solvent, key=away.get)[waters:])
    modeller.topology.setPeriodicBoxVectors(None)
    return modeller.topology, np.array(modeller.positions.value_in_unit(unit.nanometer))


def capped_alanine(waters):
    """System without a cut-off, bonds of hydrogen constrained, and positions (N, 3) in nm, of the same."""
    topology, positions = capped_alanine_box(waters)
    return forcefield().createSystem(topology, constraints=app.HBonds, removeCMMotion=False), positions


@functools.cache
def forcefield():
    return app.ForceField("amber14/protein.ff14SB.xml", "amber14/tip3p.xml")
