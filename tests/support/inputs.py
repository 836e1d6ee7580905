"""One small system as people bring it: files of AMBER, GROMACS, CHARMM and OpenMM, written out from the same numbers.

26 molecules of TIP3P water and one of hydrogen peroxide, which has bonds, angles, a torsion and a pair three bonds
apart, on a lattice in a cubic box.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import openmm
from openmm import app, unit
from scipy.spatial.transform import Rotation

#: Cubic box, nm; molecules along an edge.
EDGE, ALONG = 0.96, 3

#: kcal/mol in kJ/mol, and AMBER's unit of charge.
KCAL, CHARGE = 4.184, 18.2223

#: Charge, mass, Lennard-Jones sigma in nm and epsilon in kJ/mol, and atomic number of each type.
TYPES = {
    "OW": (-0.834, 15.9994, 0.315075, 0.635968, 8),
    "HW": (0.417, 1.008, 0.04, 0.0, 1),
    "OP": (-0.4, 15.9994, 0.3, 0.7, 8),
    "HP": (0.4, 1.008, 0.04, 0.0, 1),
}

#: Lengths in nm and constants in kJ/mol/nm^2, angles in degrees and constants in kJ/mol, by types.
BONDS = {("OW", "HW"): (0.09572, 462750.4), ("HP", "OP"): (0.0965, 450000.0), ("OP", "OP"): (0.1453, 250000.0)}
ANGLES = {("HW", "OW", "HW"): (104.52, 836.8), ("HP", "OP", "OP"): (100.0, 500.0)}

#: Of HP-OP-OP-HP: periodicity, phase in degrees and constant in kJ/mol.
TORSION = (2, 180.0, 6.0)


class Molecule(NamedTuple):
    """A kind of molecule: names, types and sites in nm of its atoms, and which of them its terms join."""

    residue: str
    names: tuple[str, ...]
    types: tuple[str, ...]
    sites: np.ndarray
    bonds: tuple[tuple[int, int], ...]
    angles: tuple[tuple[int, int, int], ...]
    torsions: tuple[tuple[int, int, int, int], ...] = ()


def _water() -> Molecule:
    half, arm = math.radians(104.52) / 2, 0.09572
    hydrogens = [[arm * math.sin(half), arm * math.cos(half), 0], [-arm * math.sin(half), arm * math.cos(half), 0]]
    sites = np.array([[0, 0, 0], *hydrogens])
    return Molecule("WAT", ("O", "H1", "H2"), ("OW", "HW", "HW"), sites, ((0, 1), (0, 2)), ((1, 0, 2),))


def _peroxide() -> Molecule:
    oxygens = np.array([[-0.07265, 0, 0], [0.07265, 0, 0]])
    out, along = 0.0965 * math.sin(math.radians(100)), 0.0965 * math.cos(math.radians(100))
    # Nearly at right angles about the bond between the oxygens.
    hydrogens = oxygens + np.array([[along, out, 0], [-along, 0.17 * out, 0.985 * out]])
    sites = np.array([hydrogens[0], oxygens[0], oxygens[1], hydrogens[1]])
    bonds, angles = ((0, 1), (3, 2), (1, 2)), ((0, 1, 2), (3, 2, 1))
    return Molecule("HPO", ("HA", "OA", "OB", "HB"), ("HP", "OP", "OP", "HP"), sites, bonds, angles, ((0, 1, 2, 3),))


WATER, PEROXIDE = _water(), _peroxide()
MOLECULES = (PEROXIDE, *(ALONG**3 - 1) * (WATER,))


def positions(seed: int = 3) -> np.ndarray:
    """Of all atoms, (82, 3), nm, rounded to what every file holds, gro files least."""
    random = np.random.default_rng(seed)
    places = (np.stack(np.meshgrid(*3 * [np.arange(ALONG)]), axis=-1).reshape(-1, 3) + 0.5) * EDGE / ALONG
    turned = [Rotation.random(random_state=random).apply(kind.sites - kind.sites.mean(axis=0)) for kind in MOLECULES]
    return np.concatenate([sites + place for sites, place in zip(turned, places, strict=True)]).round(3)


class _Atom(NamedTuple):
    """An atom of the system: its type and name, and the residue with its number from 1."""

    type: str
    name: str
    residue: str
    number: int


def _atoms() -> list[_Atom]:
    return [
        _Atom(kind, name, molecule.residue, number)
        for number, molecule in enumerate(MOLECULES, 1)
        for kind, name in zip(molecule.types, molecule.names, strict=True)
    ]


def _terms(which: str) -> list[tuple[int, ...]]:
    """Bonds, angles or torsions of the system, by atoms from 0."""
    found, first = [], 0
    for molecule in MOLECULES:
        found += [tuple(first + i for i in term) for term in getattr(molecule, which)]
        first += len(molecule.names)
    return found


def _kind(table: dict, types: tuple[str, ...]) -> int:
    """The number of the kind of a term in its table, from 1."""
    return [*table].index(types if types in table else types[::-1]) + 1


# --- AMBER ---


def write_amber(directory: Path, name: str = "amber", box: bool = True) -> tuple[Path, Path]:
    """A restart file and a prmtop file, whose box is wider, as before an equilibration; without one if asked for."""
    coordinates, topology = directory / f"{name}.inpcrd", directory / f"{name}.prmtop"
    values = (10 * positions()).ravel().tolist() + (box * [10 * EDGE] * 3 + box * [90.0] * 3)
    rows = [values[i : i + 6] for i in range(0, len(values), 6)]
    text = "".join("".join(f"{value:12.7f}" for value in row) + "\n" for row in rows)
    coordinates.write_text(f"water and peroxide\n{len(_atoms()):6}\n{text}")
    topology.write_text(_prmtop(box))
    return coordinates, topology


def _prmtop(box: bool) -> str:
    atoms, kinds = _atoms(), [*TYPES]
    bonds, angles, torsions = (_terms(which) for which in ("bonds", "angles", "torsions"))
    # As tleap writes water: a bond in place of the angle.
    bonds += [(first, last) for first, _, last in angles if atoms[first].type == "HW"]
    angles = [angle for angle in angles if atoms[angle[0]].type != "HW"]
    lengths = BONDS | {("HW", "HW"): (2 * 0.09572 * math.sin(math.radians(104.52) / 2), 462750.4)}
    with_h = [bond for bond in bonds if any(atoms[i].type.startswith("H") for i in bond)]
    without = [bond for bond in bonds if bond not in with_h]
    excluded = _excluded(len(atoms))
    pairs = [(i, j) for j in range(4) for i in range(j + 1)]
    number = {pair: n for n, pair in enumerate(pairs, 1)}
    index = [number[min(i, j), max(i, j)] for i in range(4) for j in range(4)]
    starts = [1 + i for i, atom in enumerate(atoms) if i == 0 or atom.number != atoms[i - 1].number]
    coefficients = [_coefficients(kinds[i], kinds[j]) for i, j in pairs]
    pointers = [0] * 31
    for at, value in {
        0: len(atoms),
        1: 4,
        2: len(with_h),
        3: len(without),
        4: len(angles),
        6: len(torsions),
        10: sum(map(len, excluded)),
        11: len(MOLECULES),
        12: len(without),
        15: len(lengths),
        16: len(ANGLES),
        17: 1,
        18: 4,
        27: int(box),
        28: 4,
    }.items():
        pointers[at] = value

    def table(terms: list, kind_of: dict) -> list[int]:
        rows = ([*(3 * i for i in term), _kind(kind_of, tuple(atoms[i].type for i in term))] for term in terms)
        return [value for row in rows for value in row]

    sections: dict[str, tuple[str, list]] = {
        "TITLE": ("20a4", ["made"]),
        "POINTERS": ("10I8", pointers),
        "ATOM_NAME": ("20a4", [atom.name for atom in atoms]),
        "CHARGE": ("5E16.8", [CHARGE * TYPES[atom.type][0] for atom in atoms]),
        "ATOMIC_NUMBER": ("10I8", [TYPES[atom.type][4] for atom in atoms]),
        "MASS": ("5E16.8", [TYPES[atom.type][1] for atom in atoms]),
        "ATOM_TYPE_INDEX": ("10I8", [kinds.index(atom.type) + 1 for atom in atoms]),
        "NUMBER_EXCLUDED_ATOMS": ("10I8", [len(row) for row in excluded]),
        "NONBONDED_PARM_INDEX": ("10I8", index),
        "RESIDUE_LABEL": ("20a4", [molecule.residue for molecule in MOLECULES]),
        "RESIDUE_POINTER": ("10I8", starts),
        "BOND_FORCE_CONSTANT": ("5E16.8", [k / KCAL / 200 for _, k in lengths.values()]),
        "BOND_EQUIL_VALUE": ("5E16.8", [10 * length for length, _ in lengths.values()]),
        "ANGLE_FORCE_CONSTANT": ("5E16.8", [k / KCAL / 2 for _, k in ANGLES.values()]),
        "ANGLE_EQUIL_VALUE": ("5E16.8", [math.radians(angle) for angle, _ in ANGLES.values()]),
        "DIHEDRAL_FORCE_CONSTANT": ("5E16.8", [TORSION[2] / KCAL]),
        "DIHEDRAL_PERIODICITY": ("5E16.8", [TORSION[0]]),
        "DIHEDRAL_PHASE": ("5E16.8", [math.radians(TORSION[1])]),
        "SCEE_SCALE_FACTOR": ("5E16.8", [1.0]),
        "SCNB_SCALE_FACTOR": ("5E16.8", [1.0]),
        "LENNARD_JONES_ACOEF": ("5E16.8", [a for a, _ in coefficients]),
        "LENNARD_JONES_BCOEF": ("5E16.8", [b for _, b in coefficients]),
        "BONDS_INC_HYDROGEN": ("10I8", table(with_h, lengths)),
        "BONDS_WITHOUT_HYDROGEN": ("10I8", table(without, lengths)),
        "ANGLES_INC_HYDROGEN": ("10I8", table(angles, ANGLES)),
        "ANGLES_WITHOUT_HYDROGEN": ("10I8", []),
        "DIHEDRALS_INC_HYDROGEN": ("10I8", [value for term in torsions for value in (*(3 * i for i in term), 1)]),
        "DIHEDRALS_WITHOUT_HYDROGEN": ("10I8", []),
        "EXCLUDED_ATOMS_LIST": ("10I8", [value for row in excluded for value in row]),
        "HBOND_ACOEF": ("5E16.8", []),
        "HBOND_BCOEF": ("5E16.8", []),
        "AMBER_ATOM_TYPE": ("20a4", [atom.type for atom in atoms]),
        **({"BOX_DIMENSIONS": ("5E16.8", [90.0, *3 * [11 * EDGE]])} if box else {}),
    }
    blocks = (f"%FLAG {name}\n%FORMAT({how})\n{_formatted(values, how)}" for name, (how, values) in sections.items())
    return "%VERSION  VERSION_STAMP = V0001.000\n" + "".join(blocks)


def _formatted(values: list, how: str) -> str:
    count, form = {"20a4": (20, "{:<4}"), "10I8": (10, "{:8d}"), "5E16.8": (5, "{:16.8E}")}[how]
    rows = [values[i : i + count] for i in range(0, len(values), count)] or [[]]
    return "".join("".join(map(form.format, row)) + "\n" for row in rows)


def _excluded(n: int) -> list[list[int]]:
    """Later atoms of the same molecule, from 1; AMBER has 0 where there are none."""
    first, found = 0, []
    for molecule in MOLECULES:
        last = first + len(molecule.names)
        found += [[j + 1 for j in range(i + 1, last)] or [0] for i in range(first, last)]
        first = last
    return found


def _coefficients(one: str, two: str) -> tuple[float, float]:
    """A and B of two types by the rule of Lorentz and Berthelot, kcal/mol and Angstrom."""
    sigma = 10 * (TYPES[one][2] + TYPES[two][2]) / 2
    epsilon = math.sqrt(TYPES[one][3] * TYPES[two][3]) / KCAL
    return 4 * epsilon * sigma**12, 4 * epsilon * sigma**6


# --- GROMACS ---


def write_gromacs(directory: Path, name: str = "gromacs") -> tuple[Path, Path]:
    """A gro file, and a top file that includes one with the molecules beside it."""
    coordinates, topology = directory / f"{name}.gro", directory / f"{name}.top"
    rows = [
        f"{atom.number:5}{atom.residue:<5}{atom.name:>5}{i:5}" + "".join(f"{value:8.3f}" for value in place)
        for i, (atom, place) in enumerate(zip(_atoms(), positions().tolist(), strict=True), 1)
    ]
    body = "\n".join(rows)
    coordinates.write_text(f"water and peroxide\n{len(rows):5}\n{body}\n   {EDGE:.7f}   {EDGE:.7f}   {EDGE:.7f}\n")
    types = "\n".join(
        f"{kind} {number} {mass} {charge} A {sigma} {epsilon}"
        for kind, (charge, mass, sigma, epsilon, number) in TYPES.items()
    )
    (directory / "molecules.itp").write_text(_moleculetype(PEROXIDE) + _moleculetype(WATER))
    topology.write_text(
        f'; made\n[ defaults ]\n1 2 yes 1.0 1.0\n[ atomtypes ]\n{types}\n#include "molecules.itp"\n'
        f"[ system ]\nmade\n[ molecules ]\n{PEROXIDE.residue} 1\n{WATER.residue} {len(MOLECULES) - 1}\n"
    )
    return coordinates, topology


def _moleculetype(molecule: Molecule) -> str:
    lines = [f"[ moleculetype ]\n{molecule.residue} 3", "[ atoms ]"]
    for i, (kind, name) in enumerate(zip(molecule.types, molecule.names, strict=True), 1):
        lines.append(f"{i} {kind} 1 {molecule.residue} {name} {i} {TYPES[kind][0]} {TYPES[kind][1]}")
    for section, table, terms in (("bonds", BONDS, molecule.bonds), ("angles", ANGLES, molecule.angles)):
        lines.append(f"[ {section} ]")
        for term in terms:
            value, constant = [*table.values()][_kind(table, tuple(molecule.types[i] for i in term)) - 1]
            lines.append(f"{' '.join(str(i + 1) for i in term)} 1 {value} {constant}")
    lines.append("[ dihedrals ]")
    for term in molecule.torsions:
        lines.append(f"{' '.join(str(i + 1) for i in term)} 1 {TORSION[1]} {TORSION[2]} {TORSION[0]}")
    return "\n".join(lines) + "\n"


# --- CHARMM ---


def write_charmm(directory: Path, name: str = "charmm") -> tuple[Path, Path, Path, Path]:
    """A crd file, a psf file, and the files of parameters and of the masses of types."""
    places = [directory / f"{name}.{ending}" for ending in ("crd", "psf", "prm", "rtf")]
    rows = [
        f"{i:10}{atom.number:10}  {_charmm(atom.residue):<8}  {atom.name:<8}"
        + "".join(f"{value:20.10f}" for value in place)
        + f"  {'A':<8}  {atom.number:<8}{0.0:20.10f}"
        for i, (atom, place) in enumerate(zip(_atoms(), (10 * positions()).tolist(), strict=True), 1)
    ]
    places[0].write_text("* made\n*\n" + f"{len(rows):10}  EXT\n" + "\n".join(rows) + "\n")
    places[1].write_text(_psf())
    bonds = [f"{a} {b} {k / KCAL / 200!r} {10 * length!r}" for (a, b), (length, k) in BONDS.items()]
    angles = [f"{' '.join(types)} {k / KCAL / 2!r} {angle!r}" for types, (angle, k) in ANGLES.items()]
    torsion = f"HP OP OP HP {TORSION[2] / KCAL!r} {TORSION[0]} {TORSION[1]!r}"
    radii = [
        f"{kind} 0.0 {-epsilon / KCAL!r} {10 * sigma * 2 ** (1 / 6) / 2!r}"
        for kind, (_, _, sigma, epsilon, _) in TYPES.items()
    ]
    blocks = ["* made", "*", "BONDS", *bonds, "ANGLES", *angles, "DIHEDRALS", torsion]
    places[2].write_text("\n".join([*blocks, "NONBONDED nbxmod 5", *radii, "END"]) + "\n")
    masses = [f"MASS {i} {kind} {values[1]} {kind[0]}" for i, (kind, values) in enumerate(TYPES.items(), 1)]
    places[3].write_text("\n".join(["* made", "*", "36 1", *masses, "END"]) + "\n")
    return places[0], places[1], places[2], places[3]


def _charmm(residue: str) -> str:
    return "TIP3" if residue == "WAT" else residue


def _psf() -> str:
    atoms = [
        f"{i:8} A    {atom.number:<4} {_charmm(atom.residue):<4} {atom.name:<4} {atom.type:<4} "
        f"{TYPES[atom.type][0]:10.6f} {TYPES[atom.type][1]:13.4f} {0:11}"
        for i, atom in enumerate(_atoms(), 1)
    ]
    text = "PSF\n\n       1 !NTITLE\n REMARKS made\n\n" + f"{len(atoms):8} !NATOM\n" + "\n".join(atoms) + "\n\n"
    for which, flag, terms_in_row in (("bonds", "NBOND: bonds", 4), ("angles", "NTHETA: angles", 3)):
        text += _psf_section(_terms(which), flag, terms_in_row)
    text += _psf_section(_terms("torsions"), "NPHI: dihedrals", 2)
    for flag in ("NIMPHI: impropers", "NDON: donors", "NACC: acceptors"):
        text += _psf_section([], flag, 2)
    zeros = [" ".join("0" for _ in atoms[i : i + 8]) for i in range(0, len(atoms), 8)]
    return (
        text + "       0 !NNB\n\n" + "\n".join(zeros) + "\n\n       1       0 !NGRP NST2\n       0       0       0\n\n"
    )


def _psf_section(terms: list[tuple[int, ...]], flag: str, count: int) -> str:
    rows = ["".join(f"{i + 1:8}" for term in terms[k : k + count] for i in term) for k in range(0, len(terms), count)]
    return f"{len(terms):8} !{flag}\n" + "\n".join(rows or [""]) + "\n\n"


# --- OpenMM ---


def write_openmm(directory: Path, system: openmm.System, name: str = "openmm") -> tuple[Path, Path]:
    """A State and a System in XML, whose box is then wider, as before an equilibration; the System is changed."""
    coordinates, topology = directory / f"{name}-state.xml", directory / f"{name}-system.xml"
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    context.setPositions(positions())
    coordinates.write_text(openmm.XmlSerializer.serialize(context.getState(positions=True)))
    system.setDefaultPeriodicBoxVectors(*(1.1 * EDGE * np.eye(3)))
    topology.write_text(openmm.XmlSerializer.serialize(system))
    return coordinates, topology


def write_pdb(path: Path, topology: app.Topology, places: np.ndarray) -> Path:
    """A PDB file or, by its ending, a PDBx/mmCIF file."""
    writer = app.PDBxFile if path.suffix == ".cif" else app.PDBFile
    with path.open("w") as file:
        writer.writeFile(topology, places * unit.nanometer, file)
    return path
