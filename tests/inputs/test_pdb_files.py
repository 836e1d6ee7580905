"""PDB files: refusals, and cut-offs of interactions."""

import numpy as np
import pytest
from openmm import app, unit

from openmm_sier.inputs.forcefields import EWALD_TOLERANCE, ForceFieldError, Interactions, describe, read_box
from openmm_sier.inputs.inputs import read_input
from openmm_sier.inputs.pdb_files import box_vectors, extent, read_pdb
from tests.support.commands import SYSTEMS, write_lattice
from tests.support.inputs import write_pdb
from tests.support.waters import force_of


@pytest.fixture(scope="module")
def lines(tmp_path_factory):
    """Of a box of 27 molecules, the first record that of the force field, the second that of the box."""
    return write_lattice(tmp_path_factory.mktemp("box") / "box.pdb").read_text().splitlines(keepends=True)


def with_edges(lines, a, b, c):
    return [lines[0], f"CRYST1{a:>9}{b:>9}{c:>9}  90.00  90.00  90.00 P 1           1\n", *lines[2:]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        # Its geometry is that of several models.
        (lambda lines: lines[1:], r"no force field is named: give its `files` \(--forcefield\), such as tip3p.xml"),
        (lambda lines: [*lines[:5], lines[4], *lines[5:]], r"has an atom twice: .*HETATM +3 +H2 +HOH A +1"),
        # A molecule once more, under a number of its own.
        (
            lambda lines: [*lines[:-2], *(line.replace("HOH A   1", "HOH A  99") for line in lines[2:5]), *lines[-2:]],
            r"atom .* \(.* of HOH 1\) and atom .* \(.* of HOH 99\) are in the same place",
        ),
        (lambda lines: with_edges(lines, "9.323", "9.323", "wide"), "cannot read .* as a PDB file: could not convert"),
        (
            lambda lines: with_edges(lines, "1.000", "1.000", "1.000"),
            "a volume of 0.001 nm3, too small for atoms of 486",
        ),
        (lambda lines: with_edges(lines, "10000.00", "10000.00", "10000.00"), "needs a mesh of"),
        (lambda lines: with_edges(lines, "1000000.0", "1000.000", "1000.000"), r"edge of 1e\+05 nm, expected 10000 or"),
        (lambda lines: [*lines[:2], f"{lines[2][:30]}     nan{lines[2][38:]}", *lines[3:]], "that are not numbers"),
        # A bond between the hydrogens of a molecule, left from another file.
        (
            lambda lines: [*lines[:-1], "CONECT    2    3\n", lines[-1]],
            "No template found for residue 0 .* bond too many",
        ),
    ],
)
def test_boxes_that_are_refused(tmp_path, lines, change, message):
    path = tmp_path / "box.pdb"
    path.write_text("".join(change(lines)))
    with pytest.raises(ForceFieldError, match=message) as refusal:
        read_box(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("angles", "expected"),
    [
        ((90, 90, 90), "1.4000 x 1.4000 x 1.4000 nm"),
        # A truncated octahedron.
        ((109.47, 109.47, 109.47), "1.4000 x 1.4000 x 1.4000 nm with angles of 109.47, 109.47 and 109.47 degrees"),
        # A rhombic dodecahedron, whose vectors OpenMM reduces to others of the same lattice.
        ((60, 60, 90), "1.4000 x 1.4000 x 1.4000 nm with angles of 120.00, 120.00 and 90.00 degrees"),
        ((90, 90, 120), "1.4000 x 1.4000 x 1.4000 nm with angles of 90.00, 90.00 and 120.00 degrees"),
    ],
)
def test_a_box_that_is_not_rectangular_is_reported_with_its_angles(tmp_path, lines, angles, expected):
    path, shown = tmp_path / "box.pdb", "".join(f"{angle:7.2f}" for angle in angles)
    path.write_text("".join([lines[0], f"CRYST1{14:9.3f}{14:9.3f}{14:9.3f}{shown} P 1           1\n", *lines[2:]]))
    box = read_box(path)
    assert extent(box_vectors(box.topology)) == expected
    assert f"residues in {expected} at" in describe(box)


def test_the_density_of_half_a_liquid_is_reported(tmp_path, lines):
    path = tmp_path / "box.pdb"
    path.write_text("".join(lines[:44]))
    assert "at 0.517 g/ml, PME" in describe(read_input(path))


@pytest.mark.parametrize(
    ("interactions", "cutoff", "switch", "tolerance"),
    [
        (Interactions(), 0.9, 0.75, EWALD_TOLERANCE),
        (Interactions(0.8, 0.6, 2e-4), 0.8, 0.6, 2e-4),
        (Interactions(switch=0.0), 0.9, None, EWALD_TOLERANCE),
        # The default of the switch follows the cut-off.
        (Interactions(0.6), 0.6, 0.5, EWALD_TOLERANCE),
    ],
)
def test_interactions_are_cut_off_as_asked(interactions, cutoff, switch, tolerance):
    system = read_box(SYSTEMS / "tip3p-512.pdb", interactions=interactions).system
    force = force_of(system)
    assert force.getCutoffDistance()._value == cutoff
    assert force.getEwaldErrorTolerance() == tolerance
    assert (force.getSwitchingDistance()._value if force.getUseSwitchingFunction() else None) == pytest.approx(switch)


@pytest.mark.parametrize(
    ("name", "interactions", "message"),
    [
        ("tip3p-512.pdb", Interactions(1.5), "a cut-off of 1.5 nm needs a box wider than 3 nm, got 2.48"),
        ("tip3p-512.pdb", Interactions(switch=0.9), "the switch must begin below the cut-off of 0.9 nm, got 0.9"),
        ("tip4p-1.pdb", Interactions(0.9), "a cut-off or switch needs a periodic box"),
    ],
)
def test_interactions_that_do_not_fit_a_box(name, interactions, message):
    with pytest.raises(ForceFieldError, match=message):
        read_box(SYSTEMS / name, interactions=interactions)


def in_two_places(line):
    """Two records of an atom, the second of a place 0.04 nm away."""
    moved = f"{float(line[30:38]) + 0.4:8.3f}"
    return [f"{line[:16]}A{line[17:]}", f"{line[:16]}B{line[17:30]}{moved}{line[38:]}"]


def as_mmcif(path):
    """A PDBx/mmCIF file of the first places in a PDB file, the first atom in two places."""
    pdb = app.PDBFile(str(path))
    path = write_pdb(path.with_suffix(".cif"), pdb.topology, np.array(pdb.positions.value_in_unit(unit.nanometer)))
    lines = path.read_text().splitlines(keepends=True)
    columns = [line.split(".")[1].strip() for line in lines if line.startswith("_atom_site.")]
    first = next(number for number, line in enumerate(lines) if line.startswith(("ATOM", "HETATM")))
    fields = lines[first].split()
    rows = []
    for letter in "AB":
        fields[columns.index("label_alt_id")] = letter
        rows.append(" ".join(fields) + "\n")
    path.write_text("".join([*lines[:first], *rows, *lines[first + 1 :]]))
    return path


@pytest.mark.parametrize("make", [lambda path: path, as_mmcif])
def test_the_first_of_alternate_locations_is_taken_with_a_warning(tmp_path, lines, make):
    path = tmp_path / "box.pdb"
    path.write_text("".join([*lines[:2], *in_two_places(lines[2]), *lines[3:]]))
    with pytest.warns(UserWarning, match="alternate locations"):
        pdb = read_pdb(make(path))
    path.write_text("".join(lines))
    np.testing.assert_allclose(
        np.array(pdb.positions.value_in_unit(unit.nanometer)),
        np.array(read_pdb(path).positions.value_in_unit(unit.nanometer)),
        # Files have a thousandth of an Angstrom.
        atol=1e-4,
    )


@pytest.mark.filterwarnings("error")
def test_letters_without_another_place_and_later_models_are_no_alternates(tmp_path, lines):
    path = tmp_path / "box.pdb"
    atoms = [f"{line[:16]}A{line[17:]}" for line in lines if line.startswith("HETATM")]
    models = [part for number in (1, 2) for part in (f"MODEL        {number}\n", *atoms, "ENDMDL\n")]
    path.write_text("".join([*lines[:2], *models, "END\n"]))
    assert read_pdb(path).topology.getNumAtoms() == 81
