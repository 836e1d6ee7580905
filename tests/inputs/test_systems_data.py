"""The shipped boxes of water against experiment and the literature, and the program that makes them."""

import functools
import re

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import RigidBodies
from openmm_sier.inputs import forcefields
from tests.support.commands import SYSTEMS, make
from tests.support.waters import plain_context

KCAL = 4.184  #: kJ
DEBYE = 0.0208194  #: e nm
PURE = ["spce", "tip3p", "tip4p", "tip4p2005", "tip5p"]
SALT = "tip3p-nacl-512.pdb"


@functools.cache
def liquid(model):
    return forcefields.read_box(SYSTEMS / f"{model}-512.pdb")


def reference_context(box):
    """A Context at the box's positions, constraints obeyed and virtual sites placed."""
    cpu = openmm.Platform.getPlatformByName("CPU")
    context = openmm.Context(box.system, openmm.VerletIntegrator(0.001), cpu, {"Threads": "1"})
    context.setPositions(box.positions)
    context.applyConstraints(1e-6)
    context.computeVirtualSites()
    return context


# --- the force fields ---


def test_shipped_boxes_name_their_force_fields():
    files = {path.name: forcefields.pick(path)[0] for path in SYSTEMS.glob("*.pdb")}
    assert len(files) == 10
    assert files["peptide.pdb"] == ("amber14-all.xml", "amber14/tip3p.xml")


def nonbonded(model):
    """Charges (e), sigma (nm), epsilon (kJ/mol) and positions (n, 3) in nm of the sites of one molecule."""
    field = forcefields.load([make.MODELS[model].pure], SYSTEMS)
    geometry = make.water_geometry(field) * unit.nanometer
    topology, positions = forcefields.add_virtual_sites(make.make_topology(1, 0), geometry, field)
    system = forcefields.pme_system(topology, field)
    context = plain_context(system, positions)
    context.computeVirtualSites()
    (force,) = (f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
    rows = [force.getParticleParameters(i) for i in range(system.getNumParticles())]
    charge, sigma, epsilon = np.array([[value._value for value in row] for row in rows]).T
    return charge, sigma, epsilon, context.getState(positions=True).getPositions(asNumpy=True)._value


@pytest.mark.parametrize(
    ("model", "dipole"),
    # The models' own papers, cited in systems/README.md; two decimals are printed there.
    [("spce", 2.35), ("tip3p", 2.35), ("tip4p", 2.18), ("tip4p2005", 2.305), ("tip5p", 2.29)],
)
def test_dipole_moment_is_that_of_the_literature(model, dipole):
    charge, _, _, positions = nonbonded(model)
    assert abs(charge.sum()) < 1e-12
    assert abs(np.linalg.norm(charge @ positions) / DEBYE - dipole) < 0.005


# --- the boxes ---


@pytest.mark.thorough
@pytest.mark.parametrize("model", PURE)
def test_box_holds_512_whole_molecules_at_the_density_of_experiment(model):
    box = liquid(model)
    assert box.files == (make.MODELS[model].pure,)
    assert [r.name for r in box.topology.residues()] == ["HOH"] * 512
    (edge, *others) = box.topology.getUnitCellDimensions().value_in_unit(unit.nanometer)
    assert others == [edge, edge]
    # 512 times 18.01528 g/mol; the edge in the file has 0.0001 nm, hence 0.5e-4 x 3/2.486 = 6e-5 of the density.
    assert abs(512 * 18.01528 / 602.214076 / edge**3 - 0.9973) < 1e-4
    # A PDB file has 0.0001 nm: two atoms are off by at most sqrt(3) x 0.5e-4 nm each.
    positions = app.PDBFile(str(SYSTEMS / f"{model}-512.pdb")).getPositions(asNumpy=True)
    legs = positions.value_in_unit(unit.nanometer).reshape(512, 3, 3)
    field = make.water_geometry(forcefields.load([make.MODELS[model].pure], SYSTEMS))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        lengths = np.linalg.norm(legs[:, a] - legs[:, b], axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(field[a] - field[b]), atol=1.8e-4)


@pytest.mark.parametrize(("model", "energy"), [("spce", -11.08), ("tip3p", -9.49), ("tip4p", -9.85)])
def test_box_has_the_energy_of_the_liquid(model, energy):
    """Excess energies in kcal/mol at 298 K: L. Wang, R. Abel, R. A. Friesner and B. J. Berne, J. Chem. Theory Comput.
    5, 1462 (2009), Table 3."""
    context = reference_context(liquid(model))
    result = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole) / 512
    # One snapshot scatters by sqrt(k T^2 c/512) = 0.25 kJ/mol, the heat capacity c being some 45 J/mol/K; thrice that.
    # A start from a lattice is 20 kJ/mol off.
    assert abs(result - energy * KCAL) < 0.75


def test_salt_solution_has_its_ions_and_its_density():
    box = forcefields.read_box(SYSTEMS / SALT)
    assert box.files == ("amber14/tip3p.xml",)
    names = [residue.name for residue in box.topology.residues()]
    assert [names.count(name) for name in ("HOH", "NA", "CL")] == [494, 9, 9]
    edge = box.topology.getUnitCellDimensions()[0].value_in_unit(unit.nanometer)
    mass = 494 * 18.01528 + 9 * (22.98977 + 35.453)
    # 1.011 mol/kg at 297 K, between 1.0362 at 1 mol/kg and 1.0723 at 2 mol/kg (25 C): Rogers and Pitzer (1982).
    assert abs(mass / 602.214076 / edge**3 - 1.0371) < 2e-4
    positions = box.positions.value_in_unit(unit.nanometer)
    ions = np.array(positions)[[atom.index for atom in box.topology.atoms() if atom.residue.name != "HOH"]]
    between = ions[:, None] - ions[None]
    between -= edge * np.round(between / edge)
    # Nothing overlaps: Na-Cl in contact is at 0.27 nm.
    assert np.linalg.norm(between, axis=2)[np.triu_indices(18, 1)].min() > 0.22


def test_one_molecule_is_rigid_and_without_a_box():
    box = forcefields.read_box(SYSTEMS / "tip4p-1.pdb")
    assert box.topology.getPeriodicBoxVectors() is None
    assert RigidBodies.from_system(box.system).n == 1


def test_readme_has_every_file_and_every_dipole():
    text = (SYSTEMS / "README.md").read_text()
    for path in SYSTEMS.iterdir():
        if path.suffix in (".pdb", ".xml", ".py", ".toml"):
            assert path.name in text
    for model in PURE:
        charge, _, _, positions = nonbonded(model)
        assert f"{np.linalg.norm(charge @ positions) / DEBYE:.3f}" in text


# --- the program ---


def test_densities_are_those_of_the_tables():
    # Water: W. Wagner and A. Pruss, J. Phys. Chem. Ref. Data 31, 387 (2002), at 4, 20, 25 and 30 C, g/cm3.
    for celsius, density in ((4, 0.999975), (20, 0.998207), (25, 0.997047), (30, 0.995649)):
        assert abs(make.water_density(273.15 + celsius) - density) < 3e-6
    for row, temperature in zip(make.SALT_VOLUMES, make.SALT_TEMPERATURES, strict=True):
        for volume, molality in zip(row, make.SALT_MOLALITIES, strict=True):
            # The fourth-degree polynomial in the molality leaves up to 1.3e-5.
            assert abs(make.salt_water_density(temperature, molality) * volume - 1) < 2e-5
    with pytest.raises(ValueError, match="--density"):
        make.water_density(400)
    with pytest.raises(ValueError, match="--density"):
        make.salt_water_density(297, 8)


@pytest.mark.thorough
def test_made_box_is_read_back(tmp_path, capsys):
    out = tmp_path / "made.pdb"
    command = ["--model", "spce", "--salt", "2", "--molecules", "40", "--melt", "0.02", "--equilibrate", "0.02"]
    assert make.main([*command, "--out", str(out), "--threads", "1"]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    box = forcefields.read_box(out)
    assert box.files == ("amber14/spce.xml",)
    assert RigidBodies.from_system(box.system).n == 40
    assert re.search(r"and 1 NaCl, 1\.461 mol/kg", out.read_text())


def test_a_file_is_replaced_only_on_request(tmp_path, capsys):
    out = tmp_path / "made.pdb"
    out.write_text("mine\n")
    command = ["--model", "tip3p", "--molecules", "1", "--out", str(out)]
    assert make.main(command) == 1
    assert f"{out} exists" in capsys.readouterr().err
    assert out.read_text() == "mine\n"
    assert make.main([*command, "--overwrite"]) == 0
    assert "TIP3P" in out.read_text().upper()
