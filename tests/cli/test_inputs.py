"""What people bring: files of AMBER, GROMACS, CHARMM and OpenMM are read as OpenMM reads them, run and restarted."""

import shutil
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import openmm
import pytest
from mdtraj.formats import DCDTrajectoryFile
from openmm import app, unit
from scipy.io import netcdf_file

from openmm_sier.cli.files.checkpoints import read_checkpoint
from openmm_sier.inputs.file_kinds import file_kind
from openmm_sier.inputs.forcefields import CUTOFF, EWALD_TOLERANCE, LARGEST_CUTOFF, SWITCH
from openmm_sier.inputs.inputs import read_input
from openmm_sier.prepare.masses import set_hydrogen_masses
from openmm_sier.prepare.pme import balance_pme
from tests.support import inputs
from tests.support.commands import SHORT, SMALL, complaint, contents, run, write_lattice
from tests.support.inputs import EDGE
from tests.support.matrices import representatives
from tests.support.waters import force_of, plain_context

EDGES = "--edges 0.96 0.96 0.96"

#: What `openmm-sier run` does with a box of this width.
CUT_OFF = LARGEST_CUTOFF * EDGE
SETTINGS = {
    "nonbondedMethod": app.PME,
    "nonbondedCutoff": CUT_OFF * unit.nanometer,
    "switchDistance": CUT_OFF * SWITCH / CUTOFF * unit.nanometer,
    "constraints": app.HBonds,
    "rigidWater": True,
    "ewaldErrorTolerance": EWALD_TOLERANCE,
    "removeCMMotion": False,
}


class Input(NamedTuple):
    """Coordinates, a topology, and what goes with them."""

    coordinates: str
    topology: str
    forcefield: tuple[str, ...] = ()
    edges: tuple[float, ...] = ()

    @property
    def arguments(self):
        files = ("--forcefield", *self.forcefield) if self.forcefield else ()
        edges = ("--edges", *map(str, self.edges)) if self.edges else ()
        return (self.coordinates, "--topology", self.topology, *files, *edges)


AMBER = Input("amber.inpcrd", "amber.prmtop")
GROMACS = Input("gromacs.gro", "gromacs.top")
CHARMM = Input("charmm.crd", "charmm.psf", ("charmm.prm", "charmm.rtf"), 3 * (EDGE,))
STATE = Input("openmm-state.xml", "openmm-system.xml")
PDB = Input("structure.pdb", "openmm-system.xml")
MMCIF = Input("structure.cif", "amber.prmtop")
ALL = {"amber": AMBER, "gromacs": GROMACS, "charmm": CHARMM, "state": STATE, "pdb": PDB, "mmcif": MMCIF}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A directory with all of them. The System is that of the prmtop file, and removes the motion of the centre."""
    place = tmp_path_factory.mktemp("inputs")
    shutil.copytree(inputs.FILES, place, dirs_exist_ok=True)
    box = app.AmberInpcrdFile(str(place / AMBER.coordinates)).boxVectors
    prmtop = app.AmberPrmtopFile(str(place / AMBER.topology), periodicBoxVectors=box)
    inputs.write_openmm(place, prmtop.createSystem(**SETTINGS | {"removeCMMotion": True}))
    for name in ("structure.pdb", "structure.cif"):
        inputs.write_pdb(place / name, prmtop.topology, inputs.positions())
    return place


@pytest.fixture(autouse=True)
def here(written, directory):
    """Copies of all files, in the current directory."""
    shutil.copytree(written, ".", dirs_exist_ok=True)


def energy(system, positions):
    return plain_context(system, positions).getState(energy=True).getPotentialEnergy()._value


def read(given):
    return read_input(given.coordinates, given.topology, given.forcefield, "hbonds", edges=given.edges or None)


# --- energies ---


def of_amber():
    coordinates = app.AmberInpcrdFile("amber.inpcrd")
    prmtop = app.AmberPrmtopFile("amber.prmtop", periodicBoxVectors=coordinates.boxVectors)
    return prmtop.createSystem, coordinates.positions


def of_gromacs():
    coordinates = app.GromacsGroFile("gromacs.gro")
    top = app.GromacsTopFile("gromacs.top", periodicBoxVectors=coordinates.getPeriodicBoxVectors())
    return top.createSystem, coordinates.positions


def of_charmm():
    psf = app.CharmmPsfFile("charmm.psf")
    psf.setBox(*3 * [EDGE * unit.nanometer])
    parameters = app.CharmmParameterSet("charmm.prm", "charmm.rtf")
    return partial(psf.createSystem, parameters, flexibleConstraints=False), app.CharmmCrdFile("charmm.crd").positions


def of_openmm():
    state = openmm.XmlSerializer.deserialize(Path("openmm-state.xml").read_text())

    def create(**_):
        system = openmm.XmlSerializer.deserialize(Path("openmm-system.xml").read_text())
        system.setDefaultPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        return system

    return create, state.getPositions()


@pytest.mark.parametrize(
    ("given", "reader"), [(AMBER, of_amber), (GROMACS, of_gromacs), (CHARMM, of_charmm), (STATE, of_openmm)]
)
def test_energies_are_those_of_openmms_own_reader_to_the_last_bit(given, reader):
    result = read(given)
    create, positions = reader()
    system = create(**SETTINGS)
    balance_pme(system)
    assert energy(result.system, result.positions) == energy(system, positions)
    assert result.system.getNumConstraints() == system.getNumConstraints() == 3 * 26 + 2
    assert len(result.listed) == result.topology.getNumAtoms() == 82


def test_all_formats_hold_one_system():
    """They were written from the same numbers; a prmtop file has nine digits of them.

    Energies of some 1e3 kJ/mol between molecules are then off by 1e-5 at most. Tails of Lennard-Jones, which OpenMM
    leaves out for CHARMM, are left out.
    """
    results = {}
    for name, case in ALL.items():
        box = read(case)
        force_of(box.system).setUseDispersionCorrection(False)
        results[name] = energy(box.system, box.positions)
    assert results["gromacs"] > 100
    for name in results:
        assert results[name] == pytest.approx(results["gromacs"], abs=1e-5), name


# --- runs ---


@pytest.mark.parametrize(
    ("name", "ensemble"),
    representatives(
        [("gromacs", "npt"), ("charmm", "nve"), ("amber", "npt"), ("state", "npt")],
        ("gromacs", "npt"),
        ("charmm", "nve"),
    ),
)
def test_restarts_are_bit_for_bit_alike(name, ensemble):
    case = ALL[name]
    small = SHORT if case in (STATE, PDB) else SMALL
    command = ["run", *case.arguments, *small, "--ensemble", ensemble, "--checkpoint-every", "0.04"]
    run(*command, "--steps", "20", "--out", "whole.dcd")
    run(*command, "--steps", "10", "--out", "cut.dcd")
    # The checkpoint knows the topology and everything else.
    run("run", case.coordinates, "--platform", "Reference", "--steps", "20", "--restart", "cut.chk")
    assert_same_runs("cut", "whole")


@pytest.mark.thorough
def test_named_residues_stay_rigid_and_a_restart_knows_them(capsys):
    command = ["run", *AMBER.arguments, *SMALL, "--rigid", "HPO", "--checkpoint-every", "0.04"]
    run(*command, "--steps", "20", "--out", "whole.dcd")
    run(*command, "--steps", "10", "--out", "cut.dcd")
    again = ["run", AMBER.coordinates, "--platform", "Reference", "--restart", "cut.chk"]
    run(*again, "--steps", "20")
    assert_same_runs("cut", "whole")
    assert "--rigid HOH differs from" in complaint(capsys, *again, "--steps", "30", "--rigid", "HOH")
    with DCDTrajectoryFile("whole.dcd") as frames:
        x = frames.read()[0]
    assert x.shape[1:] == (82, 3)
    peroxide = x[:, :4]
    # Six degrees of freedom move by some 0.02 nm and 0.1 nm in 60 fs; that all move by less than a hundredth of it has
    # a probability of 1e-12.
    assert np.ptp(peroxide, axis=0).max() > 1e-4
    distances = np.linalg.norm(peroxide[:, :, None] - peroxide[:, None], axis=3)
    # The DCD file has single precision in Angstrom, of coordinates up to 10.
    assert np.ptp(distances, axis=0).max() < 1e-5


def assert_same_runs(one, two):
    for ending in (".dcd", ".csv"):
        assert Path(one + ending).read_bytes() == Path(two + ending).read_bytes()
    first, second = (openmm.XmlSerializer.serialize(read_checkpoint(Path(f"{name}.chk"))[0]) for name in (one, two))
    assert first == second


def test_run_that_starts_from_a_checkpoint_has_its_topology():
    run("run", *CHARMM.arguments, *SMALL, "--steps", "2")
    run("run", CHARMM.coordinates, "--start", "charmm.chk", "--steps", "1", "--platform", "Reference", "--out", "b.dcd")
    plans = [read_checkpoint(Path(name))[1].plan for name in ("charmm.chk", "b.chk")]
    for name in ("topology", "forcefield", "edges"):
        assert plans[0][name] == plans[1][name] is not None


@pytest.mark.parametrize("name", ["amber.prmtop", "charmm.prm", "amber.inpcrd"])
@pytest.mark.thorough
def test_input_that_was_edited_since_is_refused(capsys, name):
    """The notes hold fingerprints of all files that the command line names."""
    case = CHARMM if name == "charmm.prm" else AMBER
    run("run", *case.arguments, *SMALL, "--steps", "2", "--out", "a.dcd")
    text = Path(name).read_text()
    # A title or comment, of which no energy depends.
    changed = {"amber.prmtop": ("made", "mada"), "amber.inpcrd": ("water", "Water")}.get(name, ("\n", "\n\n"))
    Path(name).write_text(text.replace(*changed, 1))
    before = contents(Path())
    message = complaint(
        capsys, "run", case.coordinates, "--platform", "Reference", "--steps", "4", "--restart", "a.chk"
    )
    assert f"{name} is not the file that the run of a.chk read" in message
    assert contents(Path()) == before


@pytest.mark.thorough
def test_files_may_be_moved_before_a_restart():
    run("run", *AMBER.arguments, *SMALL, "--steps", "20", "--out", "a.dcd")
    Path("moved").mkdir()
    for path in (*AMBER[:2], "a.chk", "a.dcd", "a.csv"):
        Path(path).rename(Path("moved") / path)
    again = ["run", f"moved/{AMBER.coordinates}", "--topology", f"moved/{AMBER.topology}", "--platform", "Reference"]
    run(*again, "--steps", "40", "--restart", "moved/a.chk")
    with DCDTrajectoryFile("moved/a.dcd") as frames:
        assert len(frames) == 8


def test_outputs_destroy_no_topology(capsys):
    message = complaint(capsys, "run", *GROMACS.arguments, "--report", "gromacs.top", "--overwrite")
    assert "gromacs.top would overwrite the input" in message


# --- other commands ---


def test_a_state_alone_has_molecules_by_bonds_and_elements_by_mass(capsys):
    topology = read(STATE).topology
    assert [residue.name for residue in topology.residues()] == ["M1", *26 * ["HOH"]]
    assert [atom.element.symbol for atom in topology.atoms()][:7] == ["H", "O", "O", "H", "O", "H", "H"]
    run("info", *STATE.arguments, "--rigid", "M1")
    assert "82 particles, 162 degrees of freedom" in capsys.readouterr().out


def test_water_that_a_top_file_makes_flexible_becomes_rigid(capsys):
    path = Path(GROMACS.topology)
    path.write_text(f"#define FLEXIBLE\n{path.read_text()}")
    run("info", *GROMACS.arguments)
    assert "26 rigid bodies" in capsys.readouterr().out


# --- refusals ---


#: What a System has already.
OF_A_SYSTEM = ("--forcefield a.xml", "--constraints none", EDGES, "--cutoff 0.4", "--switch 0.3", "--tolerance 0.0001")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["amber.inpcrd"],
            "amber.inpcrd is a coordinate file of AMBER, without a force field: give its `topology` (--topology) too",
        ),
        (["gromacs.gro"], "gromacs.gro is a gro file of GROMACS, without a force field"),
        (
            ["amber.prmtop"],
            "amber.prmtop is a prmtop file of AMBER, but coordinates are expected: give these, and",
        ),
        (["amber.prmtop", "--topology", "amber.inpcrd"], "amber.inpcrd is a coordinate file of AMBER, but the top"),
        (["gromacs.top", "--topology", "amber.prmtop"], "gromacs.top is a top file of GROMACS, but coordinates are"),
        (
            ["amber.inpcrd", "--topology", "structure.pdb"],
            "structure.pdb is a PDB file, but the topology must be a prmtop",
        ),
        (["amber.inpcrd", "--topology", "molecules.rtf"], "molecules.rtf: No such file"),
        (["charmm.crd", "--topology", "charmm.psf"], "charmm.psf is a psf file of CHARMM, which needs its parameters"),
        (
            [*AMBER.arguments, "--forcefield", "tip3p.xml"],
            "--forcefield has no effect with amber.prmtop, which is a pr",
        ),
        ([*GROMACS.arguments, "--forcefield", "a.xml"], "--forcefield has no effect with gromacs.top"),
        *(
            ([*STATE.arguments, *words.split()], f"{words.split()[0]} has no effect with openmm-system.xml, which is a")
            for words in OF_A_SYSTEM
        ),
        ([*AMBER.arguments, *EDGES.split()], "amber.inpcrd has a periodic box of its own: leave out `edges` (--edges)"),
        (
            ["openmm-state.xml", "--topology", "amber.prmtop"],
            "openmm-state.xml is a State of OpenMM and needs a System",
        ),
        (["vacuum.inpcrd", "--topology", "amber.prmtop"], "vacuum.inpcrd has no periodic box, but amber.prmtop was"),
        (["charmm.crd", "--topology", "charmm.psf", "--forcefield", "none.prm"], "none.prm"),
        (["charmm.crd", "--topology", "charmm.psf", "--forcefield", "charmm.crd"], "Unrecognized file type"),
    ],
)
def test_inputs_that_are_refused(capsys, arguments, message):
    code = 2 if "has no effect" in message else 1
    assert message in complaint(capsys, "run", *arguments, code=code)


def test_coordinates_of_other_atoms_are_refused(capsys):
    lines = Path("gromacs.gro").read_text().splitlines(keepends=True)
    # Of the first molecule of water, the oxygen after a hydrogen.
    Path("other.gro").write_text("".join([*lines[:6], lines[7], lines[6], *lines[8:]]))
    message = complaint(capsys, "info", "other.gro", "--topology", "gromacs.top")
    assert "other.gro has H1 where gromacs.top has atom 5 (O of HOH 2): are the atoms in another order?" in message
    Path("short.gro").write_text("".join([lines[0], "   79\n", *lines[2:-4], lines[-1]]))
    assert "short.gro has 79 atoms, but gromacs.top has 82" in complaint(
        capsys, "info", "short.gro", "--topology", "gromacs.top"
    )
    Path("twice.gro").write_text("".join([*lines[:9], f"{lines[9][:20]}{lines[6][20:]}", *lines[10:]]))
    assert "are in the same place" in complaint(capsys, "info", "twice.gro", "--topology", "gromacs.top")


def test_files_that_are_damaged_are_named(capsys):
    for name in (AMBER.topology, GROMACS.topology, CHARMM.topology, STATE.topology, STATE.coordinates):
        case = next(case for case in ALL.values() if name in case[:2])
        text = Path(name).read_text()
        Path(name).write_text(text[: len(text) // 2])
        assert name in complaint(capsys, "info", *case.arguments)
        Path(name).write_text(text)


@pytest.mark.parametrize(
    ("residue", "message"),
    [
        ("HPO", "(OA of HPO 1) where openmm-system.xml has a particle of 1.008 dalton"),
        ("HOH", "(H1 of HOH 2) where openmm-system.xml has a particle of 16 dalton"),
    ],
)
def test_a_system_of_other_particles_is_refused(capsys, residue, message):
    """A System has masses alone. The first two atoms of a residue change places."""
    lines = Path(PDB.coordinates).read_text().splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if f" {residue} " in line)
    lines[first : first + 2] = [lines[first + 1], lines[first]]
    Path("other.pdb").write_text("".join(line for line in lines if not line.startswith("CONECT")))
    assert message in complaint(capsys, "info", "other.pdb", "--topology", PDB.topology)


def change_system(change):
    system = openmm.XmlSerializer.deserialize(Path(STATE.topology).read_text())
    change(system)
    Path(STATE.topology).write_text(openmm.XmlSerializer.serialize(system))


def test_heavy_hydrogens_in_a_system_are_hydrogens():
    change_system(lambda system: set_hydrogen_masses(system, 4.0))
    symbols = [atom.element.symbol for atom in read(STATE).topology.atoms()]
    assert symbols == [*"HOOH", *26 * "OHH"]


def test_a_barostat_in_a_system_is_refused(capsys):
    change_system(lambda system: system.addForce(openmm.MonteCarloBarostat(1.0, 300.0)))
    message = complaint(capsys, "info", *STATE.arguments)
    assert "openmm-system.xml has a MonteCarloBarostat, but the run sets the ensemble: remove this Force" in message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda system: system.setParticleMass(4, -0.1), "The mass of particle 4 is -0.1 dalton"),
        (lambda system: system.setParticleMass(4, float("nan")), "The mass of particle 4 is nan dalton"),
    ],
    ids=["negative mass", "mass"],
)
def test_a_system_with_impossible_masses_is_refused(capsys, change, message):
    change_system(change)
    assert f"openmm-system.xml as a System of OpenMM: {message}" in complaint(capsys, "info", *STATE.arguments)


def test_without_a_box_there_is_no_cut_off(capsys):
    arguments = ["vacuum.inpcrd", "--topology", "vacuum.prmtop"]
    run("run", *arguments, *SHORT, "--steps", "1")
    assert "27 residues without a periodic box, no cut-off" in capsys.readouterr().out
    assert "a cut-off or switch needs a periodic box" in complaint(capsys, "run", *arguments, "--cutoff", "0.4")


def test_mmcif_files_are_read_with_a_force_field(capsys):
    pdb = app.PDBFile(str(write_lattice(Path("lattice.pdb"), 8)))
    inputs.write_pdb(Path("lattice.cif"), pdb.topology, np.array(pdb.positions.value_in_unit(unit.nanometer)))
    run("info", "lattice.cif", "--forcefield", "tip3p.xml")
    run("info", "lattice.pdb", "--forcefield", "tip3p.xml")
    structure, same = capsys.readouterr().out.split("lattice.pdb")
    assert structure.replace("lattice.cif", "").split() == same.split()


def test_restart_files_of_amber_may_be_netcdf():
    """Of their velocities nothing is taken."""
    with netcdf_file("amber.rst7", "w") as file:
        for name, length in {"atom": 82, "spatial": 3, "cell_spatial": 3, "cell_angular": 3}.items():
            file.createDimension(name, length)
        values = 10 * inputs.positions()
        for name, content, axes in (
            ("coordinates", values, ("atom", "spatial")),
            ("cell_lengths", np.full(3, 10 * EDGE), ("cell_spatial",)),
            ("cell_angles", np.full(3, 90.0), ("cell_angular",)),
        ):
            file.createVariable(name, "d", axes)[:] = content
    text, binary = read(AMBER), read(AMBER._replace(coordinates="amber.rst7"))
    # The text has 1e-8 nm; the box agrees to rounding.
    np.testing.assert_allclose(binary.positions._value, text.positions._value, atol=1e-8)
    edges = np.array(binary.topology.getPeriodicBoxVectors()._value)
    np.testing.assert_allclose(edges, EDGE * np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (
            "* title\n*\n 2\n    1    1 ALA  N      0.00000   0.00000   0.00000 A    1   0.0\n",
            "a crd file of CHARMM",
        ),
        ("* a title with a star\n 2 1.0\n   0.0000000   0.0000000   0.0000000\n", "a coordinate file of AMBER"),
        ("\n  3\n    1SOL     OW    1   0.126   1.624   1.679  0.1227 -0.0580  0.0434\n", "a gro file of GROMACS"),
        ('\n#include "oplsaa.ff/forcefield.itp"\n', "a top file of GROMACS"),
        ("data_1\n_atom_site.id\nATOM 1\n", "a PDBx/mmCIF file"),
        ("<?xml version='1.0'?>\n<ForceField>", "of no kind that is known"),
        ("", "of no kind that is known"),
    ],
)
def test_kinds_follow_from_contents(text, kind):
    Path("file").write_text(text)
    assert file_kind("file") == kind
