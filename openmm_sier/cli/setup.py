"""The command `openmm-sier setup`: complete a structure of an archive for `openmm-sier run`."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from openmm_sier.cli.arguments import argument
from openmm_sier.cli.console import note, table
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.files import records
from openmm_sier.cli.files.places import check_place, refuse_to_replace
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.inputs.completion import FILES, as_pdb, complete, solvate


def execute(
    structure: Path,
    out: Path | None,
    forcefield: Sequence[Path] | None,
    shape: str,
    padding: float,
    salt: float,
    ph: float,
    leave_out: Sequence[str] | None,
    ends: bool,
    seed: int,
    overwrite: bool,
) -> None:
    """Run `openmm-sier setup`.

    Args:
        structure: a PDB or PDBx/mmCIF file.
        out: the PDB file to write; None for one named after the structure, in the current directory.
        forcefield: its files; None for `FILES`.
        shape, padding, salt, seed: see `openmm_sier.inputs.completion.solvate`.
        ph, leave_out, ends: see `openmm_sier.inputs.completion.complete`.
        overwrite: whether an existing file is replaced.

    Raises:
        Misused: the file to write is not a PDB file by its name.
        RunError: it exists.
        ForceFieldError, OSError, ModuleNotFoundError: as their messages say.
    """
    path = out or Path(f"{structure.stem}-water.pdb")
    if path.suffix != ".pdb":
        raise Misused(f"--out {path}: expected the name of a PDB file, which ends in .pdb")
    check_place(path, [structure, *(forcefield or ())])
    if not overwrite:
        refuse_to_replace(path)
    files = tuple(map(str, forcefield or FILES))
    note(f"{structure}: for the force field {' '.join(files)}")
    completed = complete(structure, files, leave_out or (), ends, ph, seed)
    solvated = solvate(completed, shape, padding, salt, seed, structure.parent)
    records.replace(path, memoryview(as_pdb(solvated).encode()))
    title = f"{path}, {solvated.topology.getNumResidues()} residues, {solvated.topology.getNumAtoms()} atoms"
    table(title, ("", ""), solvated.changes, left=2)
    note(f"wrote {path}; continue with: {shlex.join([PROGRAM, 'run', argument(path), '--ensemble', 'npt'])}")
