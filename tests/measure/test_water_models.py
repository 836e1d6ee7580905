"""Which water model a PDB file holds, where its geometry tells, and what is said where it does not."""

from __future__ import annotations

import functools

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier.measure import forcefields
from openmm_sier.measure.forcefields import ForceFieldError, read_box
from openmm_sier.measure.water_models import WATER_MODELS
from openmm_sier.system.molecules import Bonds, joined_by
from tests.support.commands import SYSTEMS
from tests.support.waters import platform

MOLECULES = 40


@functools.cache
def one_molecule(file):
    """Positions (k, 3) in nm and elements of one molecule, constraints obeyed and virtual sites placed by OpenMM."""
    topology = app.Topology()
    residue = topology.addResidue("HOH", topology.addChain())
    oxygen, *hydrogens = (
        topology.addAtom(name, app.Element.getBySymbol(name[0]), residue) for name in ("O", "H1", "H2")
    )
    for hydrogen in hydrogens:
        topology.addBond(oxygen, hydrogen)
    field = forcefields.load([file])
    rough = np.array([[0, 0, 0], [0.09, 0.01, 0], [-0.02, 0.09, 0]]) * unit.nanometer
    topology, positions = forcefields.add_virtual_sites(topology, rough, field)
    system = field.createSystem(topology, rigidWater=True)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform())
    context.setPositions(positions)
    context.applyConstraints(1e-10)
    context.computeVirtualSites()
    found = context.getState(positions=True).getPositions(asNumpy=True)._value
    return found, [atom.element for atom in topology.atoms()]


def write(path, geometry, elements, ions=0, breathing=0.0, seed=1):
    """A PDB file of molecules of a geometry, turned at random on a lattice, rounded as PDB files are.

    Every other molecule is larger, the rest smaller, by a fraction `breathing`.
    """
    rng = np.random.default_rng(seed)
    topology, places = app.Topology(), []
    chain = topology.addChain()
    side = 4
    topology.setUnitCellDimensions([1.5] * 3 * unit.nanometer)
    for i in range(MOLECULES + ions):
        centre = 0.37 * np.array([i % side, i // side % side, i // side**2])
        if i >= MOLECULES:
            topology.addAtom("CL", app.element.chlorine, topology.addResidue("CL", chain))
            places.append(centre[None])
            continue
        residue = topology.addResidue("HOH", chain)
        names = iter(("O", "H1", "H2"))
        atoms = [topology.addAtom(next(names) if e else f"M{k}", e, residue) for k, e in enumerate(elements)]
        heavy = [atom for atom in atoms if atom.element is not None]
        topology.addBond(heavy[0], heavy[1])
        topology.addBond(heavy[0], heavy[2])
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        places.append(centre + (1 + (-1) ** i * breathing) * geometry @ turn)
    with open(path, "w") as file:
        app.PDBFile.writeFile(topology, np.concatenate(places) * unit.nanometer, file)
    return path


def atoms_alone(geometry, elements):
    kept = [i for i, element in enumerate(elements) if element is not None]
    return geometry[kept], [elements[i] for i in kept]


FILES = [model.file for model in WATER_MODELS if model.file is not None]
UNIQUE = ["opc3.xml", "tip3pfb.xml", "tip4p.xml", "tip4pfb.xml", "opc.xml"]


@pytest.mark.parametrize("file", FILES)
def test_the_table_has_the_geometries_of_the_files(file):
    geometry, elements = one_molecule(file)
    (model,) = (model for model in WATER_MODELS if model.file == file)
    oxygen, first, second = atoms_alone(geometry, elements)[0]
    distances = [np.linalg.norm(first - oxygen), np.linalg.norm(second - first)]
    distances += [np.linalg.norm(x - oxygen) for x, e in zip(geometry, elements, strict=True) if e is None][:1]
    assert model.sites == len(elements)
    # As many digits as the table has.
    np.testing.assert_allclose(model.distances, distances, atol=6e-7)


@pytest.mark.parametrize("file", UNIQUE)
def test_a_geometry_that_one_model_has_is_taken(tmp_path, file):
    box = read_box(write(tmp_path / "box.pdb", *one_molecule(file)))
    assert box.files == (file,)
    assert "whose geometry the water has" in box.reason


def test_sites_without_mass_are_not_needed_where_the_atoms_tell(tmp_path):
    """OPC's oxygen and hydrogens are those of no other model."""
    box = read_box(write(tmp_path / "box.pdb", *atoms_alone(*one_molecule("opc.xml"))))
    assert box.files == ("opc.xml",)
    assert box.topology.getNumAtoms() == 4 * MOLECULES


@pytest.mark.parametrize(
    ("file", "bare", "candidates"),
    [
        ("tip3p.xml", False, ["TIP3P (--forcefield tip3p.xml)", "charmm36/water.xml", "tip4p2005.xml", "tip5p.xml"]),
        ("tip4pew.xml", True, ["tip3p.xml", "TIP4P-Ew (--forcefield tip4pew.xml)"]),
        # OpenMM's Modeller adds OPC and all other water of four sites in this geometry.
        ("tip4pew.xml", False, ["TIP4P-Ew (--forcefield tip4pew.xml)", "OPC (--forcefield opc.xml)", "tip4pfb.xml"]),
        ("spce.xml", False, ["SPC/E (--forcefield spce.xml)", "SPC (OpenMM has no file for it)"]),
        ("tip4p2005.xml", False, ["tip4p2005.xml", "TIP4P-D (OpenMM has no file for it)"]),
        ("tip5p.xml", False, ["tip5p.xml", "charmm36/tip5pew.xml"]),
    ],
)
def test_a_geometry_of_several_models_has_to_be_named(tmp_path, file, bare, candidates):
    molecule = one_molecule(file)
    path = write(tmp_path / "box.pdb", *(atoms_alone(*molecule) if bare else molecule))
    with pytest.raises(ForceFieldError, match="has the geometry of several models") as refusal:
        read_box(path)
    for candidate in candidates:
        assert candidate in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert read_box(path, [file]).files == (file,)


def test_a_geometry_of_no_model_is_refused_with_all_that_may_be_named(tmp_path):
    """A molecule 1 % wider than TIP4P-Ew: 0.001 nm off, ten times what rounding makes of one molecule."""
    geometry, elements = one_molecule("tip4pew.xml")
    with pytest.raises(ForceFieldError, match="the geometry of no known model") as refusal:
        read_box(write(tmp_path / "box.pdb", 1.01 * geometry, elements))
    assert "TIP4P-Ew (--forcefield tip4pew.xml)" in str(refusal.value)


def test_flexible_water_is_not_taken_for_a_rigid_model(tmp_path):
    """Bonds that vibrate by 2 % have the right mean and are no rigid water."""
    geometry, elements = one_molecule("opc3.xml")
    with pytest.raises(ForceFieldError, match="the geometry of no known model"):
        read_box(write(tmp_path / "box.pdb", geometry, elements, breathing=0.02))


@pytest.mark.parametrize("seed", range(8))
def test_rounding_of_a_pdb_file_is_allowed(tmp_path, seed):
    """Other roundings of the same molecules; the tolerance is four standard errors of them."""
    box = read_box(write(tmp_path / "box.pdb", *one_molecule("tip4p.xml"), seed=seed))
    assert box.files == ("tip4p.xml",)


def test_with_ions_the_file_that_has_them_is_named(tmp_path):
    with_file = write(tmp_path / "opc.pdb", *one_molecule("opc.xml"), ions=2)
    assert read_box(with_file).files == ("amber14/opc.xml",)
    tip5p = write(tmp_path / "tip5p.pdb", *one_molecule("tip5p.xml"), ions=2)
    with pytest.raises(ForceFieldError, match=r"TIP5P \(--forcefield charmm36/tip5p.xml\)"):
        read_box(tip5p)
    assert read_box(tip5p, ["charmm36/tip5p.xml"]).system.getNumParticles() == 5 * MOLECULES + 2
    tip4p = write(tmp_path / "tip4p.pdb", *one_molecule("tip4p.xml"), ions=2)
    with pytest.raises(ForceFieldError, match=r"residues CL besides TIP4P water. Name force fields for them with --fo"):
        read_box(tip4p)


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(SYSTEMS.glob("*.pdb")), ids=lambda path: path.name)
def test_shipped_boxes_name_their_force_field(path):
    assert read_box(path).reason == "named in the PDB file"


def test_molecules_cut_by_the_boundary_are_recognized(tmp_path):
    path = write(tmp_path / "box.pdb", *one_molecule("tip4p.xml"))
    pdb = app.PDBFile(str(path))
    whole = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    cut = (whole + 0.05) % 1.5
    assert np.abs(cut - whole).max() > 1
    with open(path, "w") as file:
        app.PDBFile.writeFile(pdb.topology, cut * unit.nanometer, file)
    assert read_box(path).files == ("tip4p.xml",)
    # Positions in the file have 0.0001 nm.
    mended = joined_by(Bonds.guessed(pdb.topology), cut, 1.5 * np.eye(3)).reshape(-1, 4, 3)
    np.testing.assert_allclose(np.linalg.norm(mended[:, 1] - mended[:, 0], axis=1), 0.09572, atol=2e-4)
