"""A capped peptide in a few waters, built by the program that makes the shipped one."""

import functools
from pathlib import Path

import numpy as np
from openmm import app, unit

from tests.support.commands import load_program
from tests.support.starts import displaced, stored
from tests.support.waters import array, platform

PROGRAM = Path(__file__).parents[2] / "systems" / "peptide.py"


@functools.cache
def capped_alanine_box(waters):
    """Topology and positions (N, 3) in nm of ACE-ALA-NME and the waters nearest to it, at most 30, without a box."""
    modeller = _with_nearest(_made(), 30)
    # All waters are alike, so that this is the topology whichever are near.
    start = stored("capped-alanine-30", lambda: {"positions": array(modeller.positions)})
    modeller = _with_nearest(app.Modeller(modeller.topology, start["positions"] * unit.nanometer), waters)
    modeller.topology.setPeriodicBoxVectors(None)
    positions = array(modeller.positions)
    return modeller.topology, displaced(positions, _system(modeller.topology))


@functools.cache
def _made():
    """A Modeller of the peptide in a box of water; OpenMM adds the hydrogens at random and minimizes."""
    maker = load_program(PROGRAM)
    topology, positions = maker.chain(["ALA"], -75.0, 145.0)
    modeller = app.Modeller(topology, positions * unit.nanometer)
    modeller.addHydrogens(forcefield(), platform=platform())
    modeller.addSolvent(forcefield(), padding=0.5 * unit.nanometer)
    return modeller


def _with_nearest(modeller, waters):
    """A Modeller of the molecules that are no water, and the waters nearest to them."""
    x = array(modeller.positions)
    chain = [atom.index for atom in modeller.topology.atoms() if atom.residue.name != "HOH"]
    solvent = [residue for residue in modeller.topology.residues() if residue.name == "HOH"]
    away = {r: np.linalg.norm(x[next(r.atoms()).index] - x[chain], axis=1).min() for r in solvent}
    nearest = app.Modeller(modeller.topology, modeller.positions)
    nearest.delete(sorted(solvent, key=away.get)[waters:])
    return nearest


def _system(topology):
    return forcefield().createSystem(topology, constraints=app.HBonds, removeCMMotion=False)


def capped_alanine(waters):
    """System without a cut-off, bonds of hydrogen constrained, and positions (N, 3) in nm, of the same."""
    topology, positions = capped_alanine_box(waters)
    return _system(topology), positions


@functools.cache
def forcefield():
    return app.ForceField("amber14/protein.ff14SB.xml", "amber14/tip3p.xml")
