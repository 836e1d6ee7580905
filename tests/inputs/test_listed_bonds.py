"""Bonds that are left from another file are named where they alone keep a residue from its template."""

import numpy as np
import pytest
from openmm import app, unit

from openmm_sier.inputs.forcefields import ForceFieldError, read_box
from tests.support.commands import write_lattice
from tests.support.inputs import FILES, positions, write_pdb


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """Of a box of 8 molecules, of which the last is the record END."""
    return write_lattice(tmp_path_factory.mktemp("box") / "box.pdb", 8).read_text().splitlines(keepends=True)


@pytest.mark.parametrize(
    ("record", "bond"),
    [
        ("CONECT    2    3", "H1 of HOH 1 to H2 of HOH 1"),
        ("CONECT    2    5", "H1 of HOH 1 to H1 of HOH 2"),
        ("CONECT    7    4   10", "O of HOH 3 to O of HOH 2, and has"),
    ],
)
@pytest.mark.parametrize("forcefield", ["tip3p.xml", "tip4pew.xml"])
def test_a_stale_bond_is_named(tmp_path, lines, record, bond, forcefield):
    """Also where the force field has virtual sites that the file lacks."""
    path = tmp_path / "box.pdb"
    path.write_text("".join([*lines[:-1], f"{record}\n", lines[-1]]))
    with pytest.raises(ForceFieldError) as refusal:
        read_box(path, [forcefield])
    said = str(refusal.value)
    first, second = bond.removesuffix(", and has").split(" to ")
    assert (
        f"A record of the file bonds {first} to {second}" in said
        or f"A record of the file bonds {second} to {first}" in said
    )
    assert "remove it (CONECT in a PDB file" in said


def test_a_stale_bond_in_an_mmcif_file_is_named(tmp_path, lines):
    path = tmp_path / "box.pdb"
    path.write_text("".join(lines))
    pdb = app.PDBFile(str(path))
    path = write_pdb(tmp_path / "box.cif", pdb.topology, np.array(pdb.positions.value_in_unit(unit.nanometer)))
    columns = [f"_struct_conn.ptnr{i}_label_{what}" for i in (1, 2) for what in ("seq_id", "asym_id", "atom_id")]
    with path.open("a") as file:
        file.write("\n".join(["#", "loop_", "_struct_conn.conn_type_id", *columns, "covale 1 A H1 2 A H1", "#\n"]))
    with pytest.raises(ForceFieldError, match="A record of the file bonds H1 of HOH 1 to H1 of HOH 2"):
        read_box(path, ["tip3p.xml"])


def test_bonds_of_a_residue_that_has_no_template_are_not_to_blame(tmp_path):
    """Hydrogen peroxide, whose bonds no program knows by its name."""
    topology = app.AmberPrmtopFile(str(FILES / "amber.prmtop")).topology
    path = write_pdb(tmp_path / "box.pdb", topology, positions())
    with pytest.raises(ForceFieldError, match="No template found") as refusal:
        read_box(path, ["tip3p.xml"])
    assert "A record of the file bonds" not in str(refusal.value)
