"""The command `openmm-sier setup`: from a structure of an archive to coordinates that `openmm-sier run` reads."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from openmm_sier.cli.console import note, table
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.files import records
from openmm_sier.cli.files.outputs import same_file
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
        RunError: it is in the way.
        ForceFieldError, OSError, ModuleNotFoundError: as their messages say.
    """
    path = out or Path(f"{structure.stem}-water.pdb")
    _check_out(path, structure, overwrite)
    files = tuple(map(str, forcefield or FILES))
    note(f"{structure}: for the force field {' '.join(files)}")
    whole = complete(structure, files, leave_out or (), ends, ph, seed)
    made = solvate(whole, shape, padding, salt, seed, structure.parent)
    records.replace(path, memoryview(as_pdb(made).encode()))
    title = f"{path}, {made.topology.getNumResidues()} residues, {made.topology.getNumAtoms()} atoms"
    table(title, ("", ""), made.changes, left=2)
    note(f"wrote {path}; continue with: {shlex.join([PROGRAM, 'run', str(path), '--ensemble', 'npt'])}")


def _check_out(path: Path, structure: Path, overwrite: bool) -> None:
    """Refuse a file that is no PDB file by its name, would destroy another, or cannot be written."""
    if path.suffix != ".pdb":
        raise Misused(f"--out {path}: expected the name of a PDB file, which ends in .pdb")
    if same_file(path, structure):
        raise RunError(f"{path} is the structure that is read, and would be overwritten: give another name with --out")
    if path.exists() and not (overwrite and path.is_file()):
        raise RunError(f"{path} exists: give another name with --out, or replace it with --overwrite")
    if not path.parent.is_dir():
        raise RunError(f"there is no directory {path.parent} for {path.name}")
