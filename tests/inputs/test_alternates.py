"""Alternate places of atoms are told of, and refused where the first is a rarer one."""

import numpy as np
import pytest
from openmm import app, unit

from openmm_sier.inputs.forcefields import ForceFieldError
from openmm_sier.inputs.pdb_files import read_pdb
from tests.support import inputs
from tests.support.commands import write_lattice


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """Of a box of 8 molecules."""
    return write_lattice(tmp_path_factory.mktemp("box") / "box.pdb", 8).read_text().splitlines(keepends=True)


def in_two_places(lines, residue, occupancies, names="O H1 H2"):
    """Lines in which atoms of a residue are also 0.04 nm away."""
    for line in lines:
        is_there = line.startswith("HETATM") and int(line[22:26]) == residue and line[12:16].strip() in names.split()
        for letter, occupancy in zip("AB", occupancies, strict=True) if is_there else ():
            x = float(line[30:38]) + 0.4 * (letter == "B")
            yield f"{line[:16]}{letter}{line[17:30]}{x:8.3f}{line[38:54]}{occupancy:6.2f}{line[60:]}"
        if not is_there:
            yield line


@pytest.mark.parametrize("names", ["O H1 H2", "H1"])
def test_the_first_of_alternate_places_is_not_the_rarer_one(tmp_path, lines, names):
    path = tmp_path / "box.pdb"
    path.write_text("".join(in_two_places(lines, 3, (0.3, 0.7), names)))
    message = "HOH 3 has alternate locations with the occupancies A 0.3, B 0.7. OpenMM .* by the letter in column 17"
    with pytest.raises(ForceFieldError, match=message):
        read_pdb(path)
    # As the message says.
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if line[16:17] != "A"))
    assert read_pdb(path).topology.getNumAtoms() == 24


@pytest.mark.parametrize("occupancies", [(0.7, 0.3), (0.5, 0.5)])
def test_it_is_said_that_the_first_is_taken(tmp_path, lines, occupancies):
    path = tmp_path / "box.pdb"
    path.write_text("".join(in_two_places(in_two_places(lines, 3, occupancies), 5, occupancies)))
    with pytest.warns(
        UserWarning, match="HOH 3 has alternate locations .* the first is taken \\(2 residues in all\\)"
    ) as told:
        found = read_pdb(path)
    assert "A {:g}, B {:g}".format(*occupancies) in str(told[0].message)
    path.write_text("".join(lines))
    np.testing.assert_array_equal(found.getPositions(asNumpy=True), read_pdb(path).getPositions(asNumpy=True))


def test_letters_without_another_place_and_later_models_are_no_alternates(tmp_path, lines):
    path, atoms = tmp_path / "box.pdb", [line for line in lines if line.startswith("HETATM")]
    lettered = [f"{line[:16]}A{line[17:]}" for line in atoms]
    moved = [f"{line[:16]}B{line[17:]}" for line in atoms]
    models = ["MODEL        1\n", *lettered, "ENDMDL\n", "MODEL        2\n", *moved, "ENDMDL\n"]
    path.write_text("".join([*lines[:2], *models, "END\n"]))
    assert read_pdb(path).topology.getNumAtoms() == 24


@pytest.mark.parametrize(("occupancies", "is_refused"), [((0.3, 0.7), True), ((0.7, 0.3), False)])
def test_alternate_places_in_mmcif_files(tmp_path, lines, occupancies, is_refused):
    path = tmp_path / "box.pdb"
    path.write_text("".join(lines))
    pdb = app.PDBFile(str(path))
    path = inputs.write_pdb(tmp_path / "box.cif", pdb.topology, np.array(pdb.positions.value_in_unit(unit.nanometer)))
    text = path.read_text().splitlines()
    columns = [line.split(".")[1].strip() for line in text if line.startswith("_atom_site.")]
    letter, share = columns.index("label_alt_id"), columns.index("occupancy")
    made = []
    for line in text:
        fields = line.split()
        if line.startswith(("ATOM", "HETATM")) and fields[columns.index("auth_seq_id")] == "3":
            for place, occupancy in zip("AB", occupancies, strict=True):
                fields[letter], fields[share] = place, str(occupancy)
                made.append(" ".join(fields))
        else:
            made.append(line)
    path.write_text("\n".join(made) + "\n")
    if is_refused:
        with pytest.raises(ForceFieldError, match=r"HOH 3 has .* A 0.3, B 0.7. .* by the letter in label_alt_id"):
            read_pdb(path)
    else:
        with pytest.warns(UserWarning, match="HOH 3 has alternate locations"):
            assert read_pdb(path).topology.getNumAtoms() == 24
