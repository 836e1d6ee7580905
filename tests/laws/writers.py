"""Writes Systems of waters, ions and short chains as files of AMBER and GROMACS, with the digits that these have."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import openmm

#: kJ in a kcal; AMBER's factor of charges.
KCAL, AMBER_CHARGE = 4.184, 18.2223

#: Of bonds in water that is rigid, kJ/mol/nm^2.
WATER_BOND = 462750.4


@dataclass(frozen=True)
class Residue:
    """Particles of a molecule.

    Attributes:
        name: of the residue.
        atoms: their numbers in the System.
        names: of the atoms.
    """

    name: str
    atoms: tuple[int, ...]
    names: tuple[str, ...]


class Terms:
    """Terms of a System as plain numbers."""

    def __init__(self, system: openmm.System):
        n = system.getNumParticles()
        self.masses = [system.getParticleMass(i)._value for i in range(n)]
        forces = {type(force): force for force in system.getForces()}
        nonbonded = forces[openmm.NonbondedForce]
        rows = [nonbonded.getParticleParameters(i) for i in range(n)]
        self.charges = [row[0]._value for row in rows]
        self.sizes = [(row[1]._value, row[2]._value) for row in rows]
        pairs = (nonbonded.getExceptionParameters(k)[:2] for k in range(nonbonded.getNumExceptions()))
        self.excluded = sorted(tuple(sorted(pair)) for pair in pairs)
        self.bonds = [
            (i, j, length._value, WATER_BOND)
            for i, j, length in (system.getConstraintParameters(k) for k in range(system.getNumConstraints()))
        ]
        if bonds := forces.get(openmm.HarmonicBondForce):
            for k in range(bonds.getNumBonds()):
                i, j, length, constant = bonds.getBondParameters(k)
                self.bonds.append((i, j, length._value, constant._value))
        self.angles = []
        if angles := forces.get(openmm.HarmonicAngleForce):
            for number in range(angles.getNumAngles()):
                *atoms, angle, constant = angles.getAngleParameters(number)
                self.angles.append((*atoms, angle._value, constant._value))


def prmtop(terms: Terms, residues: Sequence[Residue]) -> str:
    """Return a parameter file of AMBER."""
    n = len(terms.masses)
    sizes = sorted(set(terms.sizes))
    types = [1 + sizes.index(size) for size in terms.sizes]
    is_light = [0 < mass < 2 for mass in terms.masses]
    bonds = [(3 * i, 3 * j, k + 1, is_light[i] or is_light[j]) for k, (i, j, *_) in enumerate(terms.bonds)]
    angles = [(3 * a, 3 * b, 3 * c, k + 1, is_light[a] or is_light[c]) for k, (a, b, c, *_) in enumerate(terms.angles)]
    following = [[j + 1 for i, j in terms.excluded if i == atom] or [0] for atom in range(n)]
    pairs = [(i, j) for j in range(len(sizes)) for i in range(j + 1)]
    number = {pair: k + 1 for k, pair in enumerate(pairs)}
    mixed = [((sizes[i][0] + sizes[j][0]) / 2, np.sqrt(sizes[i][1] * sizes[j][1]) / KCAL) for i, j in pairs]
    pointers = np.zeros(31, int)
    pointers[[0, 1, 2, 3, 4, 5]] = n, len(sizes), _light(bonds), _heavy(bonds), _light(angles), _heavy(angles)
    pointers[[10, 11, 12, 13]] = sum(map(len, following)), len(residues), _heavy(bonds), _heavy(angles)
    pointers[[15, 16, 18, 28]] = len(bonds), len(angles), len(sizes), max(len(residue.atoms) for residue in residues)
    sections: list[tuple[str, str, Iterable]] = [
        ("TITLE", "20a4", ["made"]),
        ("POINTERS", "10I8", pointers.tolist()),
        ("ATOM_NAME", "20a4", [name for residue in residues for name in residue.names]),
        ("CHARGE", "5E16.8", [charge * AMBER_CHARGE for charge in terms.charges]),
        ("MASS", "5E16.8", terms.masses),
        ("ATOM_TYPE_INDEX", "10I8", types),
        ("NUMBER_EXCLUDED_ATOMS", "10I8", [len(row) for row in following]),
        (
            "NONBONDED_PARM_INDEX",
            "10I8",
            [number[min(i, j), max(i, j)] for i in range(len(sizes)) for j in range(len(sizes))],
        ),
        ("RESIDUE_LABEL", "20a4", [residue.name for residue in residues]),
        ("RESIDUE_POINTER", "10I8", [residue.atoms[0] + 1 for residue in residues]),
        ("BOND_FORCE_CONSTANT", "5E16.8", [constant / 200 / KCAL for *_, constant in terms.bonds]),
        ("BOND_EQUIL_VALUE", "5E16.8", [10 * bond[2] for bond in terms.bonds]),
        ("ANGLE_FORCE_CONSTANT", "5E16.8", [constant / 2 / KCAL for *_, constant in terms.angles]),
        ("ANGLE_EQUIL_VALUE", "5E16.8", [angle[3] for angle in terms.angles]),
        ("DIHEDRAL_FORCE_CONSTANT", "5E16.8", []),
        ("DIHEDRAL_PERIODICITY", "5E16.8", []),
        ("DIHEDRAL_PHASE", "5E16.8", []),
        ("LENNARD_JONES_ACOEF", "5E16.8", [4 * epsilon * (10 * sigma) ** 12 for sigma, epsilon in mixed]),
        ("LENNARD_JONES_BCOEF", "5E16.8", [4 * epsilon * (10 * sigma) ** 6 for sigma, epsilon in mixed]),
        ("BONDS_INC_HYDROGEN", "10I8", [i for *row, light in bonds if light for i in row]),
        ("BONDS_WITHOUT_HYDROGEN", "10I8", [i for *row, light in bonds if not light for i in row]),
        ("ANGLES_INC_HYDROGEN", "10I8", [i for *row, light in angles if light for i in row]),
        ("ANGLES_WITHOUT_HYDROGEN", "10I8", [i for *row, light in angles if not light for i in row]),
        ("DIHEDRALS_INC_HYDROGEN", "10I8", []),
        ("DIHEDRALS_WITHOUT_HYDROGEN", "10I8", []),
        ("EXCLUDED_ATOMS_LIST", "10I8", [i for row in following for i in row]),
        ("HBOND_ACOEF", "5E16.8", []),
        ("HBOND_BCOEF", "5E16.8", []),
        ("HBCUT", "5E16.8", []),
        ("AMBER_ATOM_TYPE", "20a4", [f"T{kind}" for kind in types]),
    ]
    return "%VERSION  VERSION_STAMP = V0001.000\n" + "".join(_section(*section) for section in sections)


def _light(rows: list[tuple]) -> int:
    return sum(row[-1] for row in rows)


def _heavy(rows: list[tuple]) -> int:
    return len(rows) - _light(rows)


def _section(flag: str, form: str, values: Iterable) -> str:
    per_line, write = {
        "20a4": (20, lambda text: f"{text:<4}"),
        "10I8": (10, lambda whole: f"{whole:8d}"),
        "5E16.8": (5, lambda real: f"{real:16.8E}"),
    }[form]
    fields = [write(value) for value in values]
    lines = ["".join(fields[k : k + per_line]) for k in range(0, len(fields), per_line)] or [""]
    return f"%FLAG {flag}\n%FORMAT({form})\n" + "".join(f"{line}\n" for line in lines)


def inpcrd(x: np.ndarray) -> str:
    """Return a coordinate file of AMBER, with positions (N, 3) in nm to 1e-8 nm."""
    fields = [f"{value:12.7f}" for value in (10 * x).ravel()]
    lines = ["".join(fields[k : k + 6]) for k in range(0, len(fields), 6)]
    return f"made\n{len(x):6d}\n" + "\n".join(lines) + "\n"


def top(terms: Terms, residues: Sequence[Residue], weights: tuple[float, float]) -> str:
    """Return a topology file of GROMACS, in which each molecule is a type of its own.

    Args:
        terms: of the System.
        residues: its molecules; the fourth particle of a water is a virtual site.
        weights: of the two hydrogens for this site.
    """
    lines = ["[ defaults ]", "1 2 no 1.0 1.0", "[ atomtypes ]"]
    for number, ((sigma, epsilon), mass) in enumerate(zip(terms.sizes, terms.masses, strict=True)):
        lines.append(f"T{number} {8 if mass > 2 else 1} {mass!r} 0.0 A {sigma!r} {epsilon!r}")
    for residue in residues:
        place = {atom: k + 1 for k, atom in enumerate(residue.atoms)}
        lines += ["[ moleculetype ]", f"M{residue.atoms[0]} 3", "[ atoms ]"]
        for atom, name in zip(residue.atoms, residue.names, strict=True):
            charge, mass = terms.charges[atom], terms.masses[atom]
            lines.append(f"{place[atom]} T{atom} 1 {residue.name} {name} {place[atom]} {charge!r} {mass!r}")
        own = [bond for bond in terms.bonds if bond[0] in place]
        if residue.name == "WAT":
            (first,), (between,) = (
                [b[2] for b in own if place[b[1]] == 2][:1],
                [b[2] for b in own if place[b[0]] == 2][:1],
            )
            lines += ["[ settles ]", f"1 1 {first!r} {between!r}"]
            if len(place) == 4:
                lines += ["[ virtual_sites3 ]", f"4 1 2 3 1 {weights[0]!r} {weights[1]!r}"]
            lines += ["[ exclusions ]"]
            lines += [" ".join(map(str, range(k, len(place) + 1))) for k in range(1, len(place))]
        elif len(place) > 1:
            lines += [
                "[ bonds ]",
                *(f"{place[i]} {place[j]} 1 {length!r} {constant!r}" for i, j, length, constant in own),
            ]
            lines += ["[ angles ]"]
            for a, b, c, angle, constant in terms.angles:
                if a in place:
                    lines.append(f"{place[a]} {place[b]} {place[c]} 1 {np.degrees(angle)!r} {constant!r}")
    lines += ["[ system ]", "made", "[ molecules ]", *(f"M{residue.atoms[0]} 1" for residue in residues)]
    return "\n".join(lines).replace("np.float64(", "").replace(")", "") + "\n"


def gro(residues: Sequence[Residue], x: np.ndarray) -> str:
    """Return a coordinate file of GROMACS, with positions (N, 3) in nm to 1e-9 nm."""
    lines = ["made", f"{len(x):5d}"]
    for number, residue in enumerate(residues, 1):
        for atom, name in zip(residue.atoms, residue.names, strict=True):
            place = "".join(f"{value:14.9f}" for value in x[atom])
            lines.append(f"{number:5d}{residue.name:<5}{name:>5}{atom + 1:5d}{place}")
    return "\n".join([*lines, "0.0 0.0 0.0"]) + "\n"


def write(directory: Path, **contents: str) -> None:
    """Write files by their kinds."""
    for kind, text in contents.items():
        (directory / f"made.{kind}").write_text(text)
