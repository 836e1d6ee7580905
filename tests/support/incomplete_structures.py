"""Structures with missing residues and atoms, as in an archive: part of villin from PDBFixer's data."""

from importlib.resources import files

#: Residues of villin (1VII) that are kept, one that is missing within, and one that has no side chain.
FIRST, LAST, MISSING, BARE = 41, 50, 45, 47

#: Atoms of a residue without a side chain.
BACKBONE = ("N", "CA", "C", "O")


def villin() -> list[str]:
    """Return the lines of the whole file, with hydrogens."""
    return (files("pdbfixer") / "tests" / "data" / "test.pdb").read_text().splitlines()


def atoms(lines):
    """Return (number of the residue, its name, name of the atom) of each heavy atom of a PDB file."""
    results = [line for line in lines if line.startswith("ATOM")]
    named = [(int(line[22:26]), line[17:20], line[12:16].strip()) for line in results]
    return [each for each in named if not each[2].lstrip("123").startswith("H")]


def kept(lines):
    """Return the heavy atoms of the residues that are kept, those that are missing included."""
    return [each for each in atoms(lines) if FIRST <= each[0] <= LAST]


def write_incomplete(path, sequence=True, also=()):
    """Write the structure without the missing residues and atoms.

    Args:
        path: of the PDB file.
        sequence: whether it has the records of the whole sequence.
        also: lines of further atoms.
    """
    lines = [line for line in villin() if line.startswith("SEQRES")] if sequence else []
    for line in villin():
        if not line.startswith("ATOM") or line[12:16].strip().lstrip("123").startswith("H"):
            continue
        number = int(line[22:26])
        if not FIRST <= number <= LAST or number == MISSING:
            continue
        if number != BARE or line[12:16].strip() in BACKBONE:
            lines.append(line)
    path.write_text("\n".join([*lines, "TER", *also, "END", ""]))
    return path
