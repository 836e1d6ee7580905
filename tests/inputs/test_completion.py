"""Completion and solvation of structures of archives: additions, their report, and refusals."""

import random
import sys
from collections import Counter

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier.inputs.completion import FILES, STRETCHED, as_pdb, complete, solvate
from openmm_sier.inputs.inputs import read_input
from openmm_sier.inputs.pdb_files import ForceFieldError, box_vectors
from tests.support.incomplete_structures import FIRST, LAST, kept, villin, write_incomplete
from tests.support.matrices import representatives

PDBFixer = pytest.importorskip("pdbfixer").PDBFixer

#: A sulfate far from the chain.
SULFATE = [
    f"HETATM 9{i:03d}  {name:3s} SO4 B   1    {30 + x:8.3f}{30 + y:8.3f}{30 + z:8.3f}  1.00  0.00           {name[0]}"
    for i, (name, x, y, z) in enumerate(
        [
            ("S", 0, 0, 0),
            ("O1", 0.86, 0.86, 0.86),
            ("O2", 0.86, -0.86, -0.86),
            ("O3", -0.86, 0.86, -0.86),
            ("O4", -0.86, -0.86, 0.86),
        ]
    )
]


@pytest.fixture(scope="module")
def structure(tmp_path_factory):
    return write_incomplete(tmp_path_factory.mktemp("archive") / "1VII.pdb")


@pytest.fixture(scope="module")
def whole(structure):
    return complete(structure)


def heavy(topology):
    return [
        (int(atom.residue.id), atom.residue.name, atom.name)
        for atom in topology.atoms()
        if atom.element.symbol != "H" and atom.residue.name not in ("HOH", "NA", "CL")
    ]


def test_missing_parts_are_added_and_reported(whole):
    expected = kept(villin())
    # The chain ends early, and has a terminal oxygen there.
    assert sorted(heavy(whole.topology)) == sorted([*expected, (LAST, expected[-1][1], "OXT")])
    changes = dict(whole.changes)
    assert changes["residues added"] == "1 between ASP A 44 and ASP A 46"
    assert changes["missing at an end, left out"] == "26 after VAL A 50"
    # Of phenylalanine seven of its side chain, the terminal oxygen, and nine of glutamic acid, which is missing.
    assert changes["heavy atoms added"] == "17"
    hydrogens = sum(atom.element.symbol == "H" for atom in whole.topology.atoms())
    assert changes["hydrogens added"].startswith(f"{hydrogens},")


@pytest.mark.thorough
def test_ends_are_added_where_they_are_asked_for(structure):
    longer = complete(structure, ends=True)
    assert longer.topology.getNumResidues() == 36
    assert ("residues added", "26 after VAL A 50") in longer.changes


def test_atoms_that_were_placed_badly_are_placed_again(structure, whole, monkeypatch):
    """PDBFixer may leave torn bonds, by the processor and the number of threads; in double precision it does not."""
    add, platforms = PDBFixer.addMissingAtoms, []

    def torn_at_first(fixer, seed):
        add(fixer, seed)
        platforms.append(fixer.platform and fixer.platform.getName())
        if len(platforms) == 1:
            fixer.positions[-1] += openmm.Vec3(1, 0, 0) * unit.nanometer

    monkeypatch.setattr(PDBFixer, "addMissingAtoms", torn_at_first)
    completed = complete(structure)
    assert platforms == [None, "Reference"]
    assert completed.changes == whole.changes
    places = completed.positions.value_in_unit(unit.nanometer)
    lengths = [unit.norm(places[one.index] - places[two.index]) for one, two in completed.topology.bonds()]
    assert max(lengths) < STRETCHED


@pytest.mark.parametrize("shape", representatives(["cube", "dodecahedron"], "dodecahedron"))
def test_run_reads_what_is_made(whole, shape, tmp_path):
    solvated = solvate(whole, shape, padding=0.6, salt=0.5)
    path = tmp_path / "box.pdb"
    path.write_text(as_pdb(solvated))
    box = read_input(path)
    assert box.files == FILES
    assert box.system.getNumParticles() == solvated.topology.getNumAtoms()
    # A PDB file has lengths to 1e-4 nm and angles to 5e-5 rad. Read vectors may be another choice for the same lattice.
    written, read = box_vectors(solvated.topology), box_vectors(box.topology)
    assert np.linalg.det(read) == pytest.approx(np.linalg.det(written), rel=5e-4)
    whole_numbers = read @ np.linalg.inv(written)
    assert whole_numbers == pytest.approx(np.round(whole_numbers), abs=5e-4)
    names = Counter(residue.name for residue in box.topology.residues())
    changes = dict(solvated.changes)
    assert changes["waters added"] == str(names["HOH"])
    assert changes["ions added"] == f"{names['CL']} CL, {names['NA']} NA"
    assert min(names["CL"], names["NA"]) >= 1
    force = next(force for force in box.system.getForces() if isinstance(force, openmm.NonbondedForce))
    charges = [
        force.getParticleParameters(i)[0].value_in_unit(unit.elementary_charge) for i in range(len(box.positions))
    ]
    # Sums of charges to five digits.
    assert sum(charges) == pytest.approx(0, abs=1e-3)


@pytest.mark.thorough
def test_virtual_sites_are_left_to_the_reader(structure, tmp_path):
    files = ("amber14-all.xml", "amber14/tip4pew.xml")
    solvated = solvate(complete(structure, files), "octahedron", padding=0.6, salt=0)
    assert all(atom.element is not None for atom in solvated.topology.atoms())
    path = tmp_path / "box.pdb"
    path.write_text(as_pdb(solvated))
    waters = sum(residue.name == "HOH" for residue in solvated.topology.residues())
    assert read_input(path).system.getNumParticles() == solvated.topology.getNumAtoms() + waters


@pytest.mark.thorough
def test_templates_that_are_patched_at_ends_are_known(structure):
    """As those of CHARMM are."""
    assert complete(structure, ("charmm36.xml", "charmm36/water.xml")).files[0] == "charmm36.xml"


@pytest.mark.thorough
def test_selenomethionine_becomes_methionine(tmp_path):
    path = write_incomplete(tmp_path / "a.pdb")
    text = path.read_text().replace("MET A  41", "MSE A  41").replace(" SD  MSE", "SE   MSE")
    path.write_text(text.replace("  36  MET LEU", "  36  MSE LEU"))
    assert dict(complete(path).changes)["residues replaced"] == "1 MSE by MET"


def test_a_gap_without_a_sequence_is_refused(tmp_path):
    path = write_incomplete(tmp_path / "a.pdb", sequence=False)
    with pytest.raises(ForceFieldError, match=r"gap .*ASP A 44 and ASP A 46"):
        complete(path)


@pytest.mark.thorough
def test_a_residue_without_a_template_is_named_and_may_be_left_out(tmp_path, monkeypatch):
    # PDBFixer looks for hydrogens of residues that it does not know at the archive, which tests do not ask.
    monkeypatch.setattr("pdbfixer.pdbfixer.urlopen", lambda _: (_ for _ in ()).throw(OSError("no network")))
    path = write_incomplete(tmp_path / "a.pdb", also=SULFATE)
    with pytest.raises(ForceFieldError, match=r"SO4.*\(--leave-out\)"):
        complete(path)
    result = complete(path, leave_out=["SO4"])
    assert ("residues left out", "1 SO4") in result.changes
    with pytest.raises(ForceFieldError, match="GOL"):
        complete(path, leave_out=["GOL"])


@pytest.mark.thorough
def test_force_fields_without_water_or_ions_are_refused(structure, whole):
    with pytest.raises(ForceFieldError, match=r"amber14-all\.xml: "):
        solvate(complete(structure, ("amber14-all.xml",)))
    with pytest.raises(ForceFieldError, match=r"tip3p\.xml: "):
        complete(structure, ("tip3p.xml",))


@pytest.mark.thorough
def test_random_numbers_of_other_integrators_continue(whole):
    random.seed(5)
    expected = random.random()
    random.seed(5)
    solvate(whole, padding=0.3)
    assert random.random() == expected


def test_without_pdbfixer(structure, monkeypatch):
    monkeypatch.setitem(sys.modules, "pdbfixer", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'openmm-sier\[setup\]'"):
        complete(structure)


def test_numbers_of_residues_stay(whole):
    numbers = [int(residue.id) for residue in whole.topology.residues()]
    assert numbers == list(range(FIRST, LAST + 1))
