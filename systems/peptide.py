#!/usr/bin/env python3
"""Make a solvated peptide: atoms from ideal geometry, water, minimization, equilibration at constant pressure.

    python peptide.py                                                  the file that is shipped
    python peptide.py --sequence ALA SER PHE VAL --torsions -65 -40 --out helix.pdb     another one, as a helix
    python peptide.py --long --time 3 --out long.pdb                   51 residues, 20000 atoms, a file of 1.6 MB
    python peptide.py --sequence VAL --dry --out valine.pdb            ACE-VAL-NME without water

The chain is capped by ACE and NME. Bond lengths and angles are those of Engh and Huber, Acta Cryst. A 47, 392 (1991),
rounded; hydrogens and water come from OpenMM's Modeller. The PDB file names its force field.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import SIERLangevinIntegrator, balance_pme

HERE = Path(__file__).parent
FORCE_FIELD = ("amber14-all.xml", "amber14/tip3p.xml")

SHIPPED = "peptide.pdb"
SEQUENCE = ("ALA", "SER", "PHE", "GLY", "VAL", "THR")
TORSIONS = (-75.0, 145.0)  #: phi and psi in degrees: polyproline II, extended in water
PADDING = 0.75  #: nm of water around the chain
#: A helix of 51 residues for `--long`, and the water around it, in a box that is long in one direction.
LONG_SEQUENCE = "TAEKLFKAVEGLQSKYEIALKNAVDELAKMGVSFEKQLQEAVNKLIEGAKS"
LONG_TORSIONS = (-63.0, -42.0)
LONG_PADDING = 1.45
TEMPERATURE = 297.0  #: K

#: Atoms of a side chain: each name with the three atoms before it, and bond (nm), angle and torsion (degrees).
#: CB stands beside the backbone's N and C as in L-amino acids.
CB = ("CB", ("C", "N", "CA"), 0.153, 110.5, -122.5)
GAMMA = ("CG", ("N", "CA", "CB"), 0.152, 113.9, -67.0)
DELTA = ("CD", ("CA", "CB", "CG"), 0.152, 112.6, 180.0)
PHENYL = [
    ("CG", ("N", "CA", "CB"), 0.150, 113.8, -65.0),
    ("CD1", ("CA", "CB", "CG"), 0.139, 120.7, 90.0),
    ("CD2", ("CA", "CB", "CG"), 0.139, 120.7, -90.0),
    ("CE1", ("CB", "CG", "CD1"), 0.139, 120.7, 180.0),
    ("CE2", ("CB", "CG", "CD2"), 0.139, 120.7, 180.0),
    ("CZ", ("CG", "CD1", "CE1"), 0.139, 120.0, 0.0),
]
SIDE_CHAINS = {
    "GLY": [],
    "ALA": [CB],
    "ASP": [
        CB,
        GAMMA,
        ("OD1", ("CA", "CB", "CG"), 0.125, 118.4, -15.0),
        ("OD2", ("CA", "CB", "CG"), 0.125, 118.4, 165.0),
    ],
    "ASN": [
        CB,
        GAMMA,
        ("OD1", ("CA", "CB", "CG"), 0.123, 120.8, -20.0),
        ("ND2", ("CA", "CB", "CG"), 0.133, 116.4, 160.0),
    ],
    "GLU": [
        CB,
        GAMMA,
        DELTA,
        ("OE1", ("CB", "CG", "CD"), 0.125, 118.4, -10.0),
        ("OE2", ("CB", "CG", "CD"), 0.125, 118.4, 170.0),
    ],
    "GLN": [
        CB,
        GAMMA,
        DELTA,
        ("OE1", ("CB", "CG", "CD"), 0.123, 120.8, -10.0),
        ("NE2", ("CB", "CG", "CD"), 0.133, 116.4, 170.0),
    ],
    "LYS": [
        CB,
        GAMMA,
        DELTA,
        ("CE", ("CB", "CG", "CD"), 0.152, 111.3, 180.0),
        ("NZ", ("CG", "CD", "CE"), 0.149, 111.9, 180.0),
    ],
    "MET": [
        CB,
        GAMMA,
        ("SD", ("CA", "CB", "CG"), 0.180, 112.7, 180.0),
        ("CE", ("CB", "CG", "SD"), 0.179, 100.9, 70.0),
    ],
    "ILE": [
        CB,
        ("CG1", ("N", "CA", "CB"), 0.153, 110.4, -65.0),
        ("CG2", ("N", "CA", "CB"), 0.152, 110.5, 172.0),
        ("CD1", ("CA", "CB", "CG1"), 0.151, 113.8, 170.0),
    ],
    "SER": [CB, ("OG", ("N", "CA", "CB"), 0.142, 110.8, 60.0)],
    "VAL": [CB, ("CG1", ("N", "CA", "CB"), 0.152, 110.5, 175.0), ("CG2", ("N", "CA", "CB"), 0.152, 110.5, -62.0)],
    "THR": [CB, ("OG1", ("N", "CA", "CB"), 0.143, 109.6, 60.0), ("CG2", ("N", "CA", "CB"), 0.152, 110.5, -60.0)],
    "LEU": [
        CB,
        ("CG", ("N", "CA", "CB"), 0.153, 116.3, -65.0),
        ("CD1", ("CA", "CB", "CG"), 0.152, 110.7, 175.0),
        ("CD2", ("CA", "CB", "CG"), 0.152, 110.7, -60.0),
    ],
    "PHE": [CB, *PHENYL],
    "TYR": [CB, *PHENYL, ("OH", ("CD1", "CE1", "CZ"), 0.138, 119.9, 180.0)],
}
RINGS = {"PHE": [("CE2", "CZ")], "TYR": [("CE2", "CZ")]}
LETTERS = dict(
    zip(
        "GADNEQKMISVTLFY",
        ["GLY", "ALA", "ASP", "ASN", "GLU", "GLN", "LYS", "MET", "ILE", "SER", "VAL", "THR", "LEU", "PHE", "TYR"],
        strict=True,
    )
)


def placed(a, b, c, length: float, angle: float, torsion: float) -> np.ndarray:
    """The atom at a distance from c, with the angle at c to b, and the torsion about b-c to a, in degrees."""
    angle, torsion = np.radians([angle, torsion])
    along = (c - b) / np.linalg.norm(c - b)
    normal = np.cross(b - a, along)
    normal /= np.linalg.norm(normal)
    out = np.cross(normal, along)
    return c + length * (-np.cos(angle) * along + np.sin(angle) * (np.cos(torsion) * out + np.sin(torsion) * normal))


def chain(sequence, phi: float, psi: float):
    """Topology and positions (N, 3) in nm of the heavy atoms of ACE-sequence-NME.

    Raises:
        ValueError: a residue is none of `SIDE_CHAINS`.
    """
    if unknown := [name for name in sequence if name not in SIDE_CHAINS]:
        raise ValueError(f"there is no geometry of residue {unknown[0]}, only of {', '.join(SIDE_CHAINS)}")
    topology, positions = app.Topology(), []
    strand = topology.addChain()

    def grow(name: str, atoms, bonds):
        residue = topology.addResidue(name, strand)
        found = {atom: topology.addAtom(atom, app.Element.getBySymbol(atom[0]), residue) for atom, _ in atoms}
        positions.extend(place for _, place in atoms)
        for first, second in bonds:
            topology.addBond(found[first], found[second])
        return found

    methyl, carbonyl = np.zeros(3), np.array([0.152, 0.0, 0.0])
    oxygen = placed(np.array([0.0, 1.0, 0.0]), methyl, carbonyl, 0.123, 120.5, 0.0)
    cap = [("CH3", methyl), ("C", carbonyl), ("O", oxygen)]
    last = grow("ACE", cap, [("CH3", "C"), ("C", "O")])
    # The first peptide bond lies opposite to the cap's oxygen.
    beyond, before, carbon, turn = oxygen, methyl, carbonyl, 180.0
    for name in sequence:
        nitrogen = placed(beyond, before, carbon, 0.133, 116.5, turn)
        alpha = placed(before, carbon, nitrogen, 0.146, 121.7, 180.0)
        own = placed(carbon, nitrogen, alpha, 0.1525, 111.0, phi)
        at = {"N": nitrogen, "CA": alpha, "C": own}
        at["O"] = placed(nitrogen, alpha, own, 0.123, 120.5, psi + 180.0)
        for atom, parents, *geometry in SIDE_CHAINS[name]:
            at[atom] = placed(*(at[parent] for parent in parents), *geometry)
        bonds = [("N", "CA"), ("CA", "C"), ("C", "O")]
        bonds += [(parents[-1], atom) for atom, parents, *_ in SIDE_CHAINS[name]] + RINGS.get(name, [])
        found = grow(name, list(at.items()), bonds)
        topology.addBond(last["C"], found["N"])
        last, beyond, before, carbon, turn = found, nitrogen, alpha, own, psi
    nitrogen = placed(beyond, before, carbon, 0.133, 116.5, turn)
    methyl = placed(before, carbon, nitrogen, 0.146, 121.7, 180.0)
    found = grow("NME", [("N", nitrogen), ("C", methyl)], [("N", "C")])
    topology.addBond(last["C"], found["N"])
    return topology, np.array(positions)


def lying(positions: np.ndarray) -> np.ndarray:
    """Positions (N, 3) turned so that they are longest along x."""
    axes = np.linalg.svd(positions - positions.mean(axis=0), full_matrices=False)[2]
    return positions @ (axes * np.linalg.det(axes)).T  # The determinant makes a reflection a rotation.


def solvated(sequence, phi: float, psi: float, padding: float, brick: bool = False) -> app.Modeller:
    """The chain with hydrogens in a box of water, and ions where it has a charge.

    The box is a cube; or a brick that is as long as the chain, which lies along x then. A brick is for short runs: the
    chain meets its images when it has turned.
    """
    topology, positions = chain(sequence, phi, psi)
    forcefield = app.ForceField(*FORCE_FIELD)
    if brick:
        positions = lying(positions)
    modeller = app.Modeller(topology, positions * unit.nanometer)
    modeller.addHydrogens(forcefield)
    if brick:
        edges = np.ptp(modeller.positions.value_in_unit(unit.nanometer), axis=0) + 2 * padding
        modeller.addSolvent(forcefield, boxSize=openmm.Vec3(*edges) * unit.nanometer, neutralize=True)
    else:
        modeller.addSolvent(forcefield, padding=padding * unit.nanometer, neutralize=True)
    return modeller


def dry(sequence, phi: float, psi: float) -> app.Modeller:
    """The chain with hydrogens, without water and box."""
    topology, positions = chain(sequence, phi, psi)
    modeller = app.Modeller(topology, positions * unit.nanometer)
    modeller.addHydrogens(app.ForceField(*FORCE_FIELD))
    modeller.topology.setPeriodicBoxVectors(None)
    return modeller


def equilibrated(modeller: app.Modeller, temperature: float, time: float, seed: int) -> openmm.State:
    """State after minimization and a time in ps at 1 bar, with hydrogens held by constraints."""
    system = app.ForceField(*FORCE_FIELD).createSystem(
        modeller.topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=0.9 * unit.nanometer,
        constraints=app.HBonds,
        switchDistance=0.75 * unit.nanometer,
        ewaldErrorTolerance=1e-4,
    )
    balance_pme(system)
    integrator = SIERLangevinIntegrator(temperature, 5.0, 0.004, pressure=1.0, barostatInterval=10)
    integrator.setRandomNumberSeed(seed)
    simulation = app.Simulation(modeller.topology, system, integrator)
    simulation.context.setPositions(modeller.positions)
    simulation.minimizeEnergy(maxIterations=500)
    simulation.context.setVelocitiesToTemperature(temperature, seed)
    simulation.step(round(time / 0.004))
    return simulation.context.getState(positions=True)


def write(path: Path, topology, positions) -> None:
    """Write a PDB file that names its force field, molecules whole."""
    with path.open("w") as file:
        for name in FORCE_FIELD:
            file.write(f"REMARK  99 FORCEFIELD {name}\n")
        app.PDBFile.writeFile(topology, positions, file, keepIds=True)


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", nargs="+", default=SEQUENCE, help=f"of {', '.join(SIDE_CHAINS)}")
    parser.add_argument("--torsions", nargs=2, type=float, default=TORSIONS, metavar=("PHI", "PSI"), help="degrees")
    parser.add_argument("--padding", type=float, default=PADDING, help="nm of water around the chain")
    parser.add_argument("--long", action="store_true", help=f"{LONG_SEQUENCE} as a helix, in a brick of water")
    parser.add_argument("--dry", action="store_true", help="the chain alone, as it is built")
    parser.add_argument("--temperature", type=float, default=TEMPERATURE, help="K")
    parser.add_argument("--time", type=float, default=40.0, help="of the equilibration, ps")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=HERE / SHIPPED)
    options = parser.parse_args(arguments)
    if options.dry:
        modeller = dry(options.sequence, *options.torsions)
        write(options.out, modeller.topology, modeller.positions)
        return 0
    shape = options.sequence, *options.torsions, options.padding
    if options.long:
        shape = [LETTERS[letter] for letter in LONG_SEQUENCE], *LONG_TORSIONS, LONG_PADDING, True
    modeller = solvated(*shape)
    print(f"{modeller.topology.getNumAtoms()} atoms, {modeller.topology.getNumResidues()} residues")
    state = equilibrated(modeller, options.temperature, options.time, options.seed)
    modeller.topology.setPeriodicBoxVectors(state.getPeriodicBoxVectors())
    write(options.out, modeller.topology, state.getPositions())
    print(f"wrote {options.out}, a box of {state.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3):.2f} nm^3")
    return 0


if __name__ == "__main__":
    sys.exit(main())
