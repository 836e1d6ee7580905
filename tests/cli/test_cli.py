"""The command line, on small boxes of water: `run` with its files, crashes and continuations, `info`, refusals."""

import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import mdtraj
import numpy as np
import pytest
from openmm import app, unit

from openmm_sier.cli import main
from openmm_sier.cli.errors import NothingLeft
from openmm_sier.cli.files import checkpoints
from openmm_sier.inputs import forcefields
from openmm_sier.version import __version__
from tests.support.commands import SMALL, SYSTEMS, complaint, frames, log, rewrite_notes, write_lattice
from tests.support.matrices import thorough

#: Frames and rows of a run of 0.4 ps with the options of SMALL: every 5th step of 4 fs, every 10th, and the start.
STEPS, FRAMES, ROWS = 100, 20, 11


@pytest.fixture(scope="module")
def whole_run(box):
    """Directory of a run of 0.4 ps that nothing disturbed."""
    assert main.main(["run", str(box), *SMALL, "--time", "0.4", "--out", str(box.with_name("whole.dcd"))]) == 0
    return box.parent


def frames_in_header(path):
    """Number of frames in the header of a DCD file; MDTraj uses the length of the file, other readers the header."""
    return int.from_bytes(path.read_bytes()[8:12], "little")


# --- a run ---


def test_run_writes_trajectory_log_checkpoint_and_table(box, capsys):
    assert main.main(["run", str(box), *SMALL, "--time", "0.4", "--scheme", "sier2", "--dt", "1"]) == 0
    out = capsys.readouterr().out
    assert "force field tip3p.xml (named in the PDB file)" in out
    for name in (
        "drift of the conserved energy",
        "rms(H)/rms(V)",
        "T_trans",
        "potential energy V",
        "wall time per step",
    ):
        assert name in out
    # One evaluation more than one a step: the first step of a run has no force to start from.
    assert re.search(r"force evaluations per step +│ +1\.00", out)
    assert frames(Path("box.dcd"), box).n_frames == FRAMES
    rows = log("box.csv")
    # 1 fs steps, rows every 0.04 ps.
    np.testing.assert_array_equal(rows["Step"], np.arange(0, 401, 40))
    np.testing.assert_allclose(rows["Time (ps)"], 0.001 * rows["Step"], atol=1e-12)
    np.testing.assert_allclose(
        rows["Total Energy (kJ/mole)"], rows["Potential Energy (kJ/mole)"] + rows["Kinetic Energy (kJ/mole)"]
    )
    assert Path("box.chk").exists()


@pytest.mark.thorough
def test_start_with_overlaps_is_minimized_and_others_are_not(box, capsys):
    short = [*SMALL, "--steps", "1", "--platform", "CPU"]
    assert main.main(["run", str(box), *short, "--out", "first.dcd"]) == 0
    assert "minimized" not in capsys.readouterr().out
    pdb = app.PDBFile(str(box))
    positions = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    # The second molecule 0.2 nm from the first one, where a liquid has none.
    positions[3:6] += positions[0] - positions[3] + [0.2, 0, 0]
    with open("close.pdb", "w") as file:
        app.PDBFile.writeFile(pdb.topology, positions * unit.nanometer, file)
    assert main.main(["run", "close.pdb", "--forcefield", "tip3p.xml", *short]) == 0
    assert "kJ/mol: the largest force on a molecule was" in capsys.readouterr().out


@pytest.mark.thorough
def test_trajectory_has_the_atoms_of_the_pdb_file_for_a_model_with_virtual_sites(capsys):
    box = write_lattice(Path("four.pdb"), forcefield="tip4p.xml")
    assert main.main(["run", str(box), *SMALL, "--time", "0.04"]) == 0
    read = frames(Path("four.dcd"), box)
    assert read.n_atoms == 3 * 27
    # O-H of TIP4P; the DCD file has single precision in Angstrom.
    bonds = mdtraj.compute_distances(read, [[0, 1], [0, 2], [3, 4]])
    np.testing.assert_allclose(bonds, 0.09572, atol=2e-6)


def test_one_molecule_without_a_box_tumbles_freely(capsys):
    assert main.main(["run", str(SYSTEMS / "tip4p-1.pdb"), "--time", "2", "--equilibrate", "0.1"]) == 0
    assert "without a periodic box" in capsys.readouterr().out
    rows = log("tip4p-1.csv")
    # Rounding alone: the molecule has no potential energy.
    np.testing.assert_allclose(rows["Total Energy (kJ/mole)"], rows["Total Energy (kJ/mole)"][0], rtol=1e-12)
    assert rows["Total Energy (kJ/mole)"][0] > 0


@pytest.mark.parametrize(
    ("options", "needed"),
    [
        (["--ensemble", "npt"], "--ensemble npt"),
        (["--ensemble", "hmc", "--pressure", "1"], "--pressure"),
        (["--pressure-tensor", "p.csv"], "--pressure-tensor"),
    ],
)
def test_what_needs_a_box_says_how_to_give_one(capsys, options, needed):
    message = complaint(capsys, "run", SYSTEMS / "tip4p-1.pdb", "--platform", "Reference", *options)
    assert f"{needed} requires a periodic box, and the input has none: give one by --edges" in message
    assert not list(Path().iterdir())


# --- crashes and continuations ---

#: Runs the command and kills it, without warning, in the middle of a write: half of the bytes of a frame or row get
#: to the file, or the whole of a new checkpoint that has not yet taken the place of the old one.
KILLER = """
import os, signal, sys
from openmm_sier.cli import main
from openmm_sier.cli.files import checkpoints, records

place, after, *arguments = sys.argv[1:]
append, replace = records.GrowingFile.append, os.replace
calls = 0

def die():
    os.kill(os.getpid(), signal.SIGKILL)

def append_half(self, record, counts=True):
    if isinstance(self, records.Log) == (place == "row") and self.count == int(after):
        self._file.write(record[: len(record) // 2])
        die()
    append(self, record, counts)

def replace_or_die(*names):
    global calls
    calls += 1
    if calls > int(after):
        die()
    replace(*names)

if place == "checkpoint":
    os.replace = replace_or_die
else:
    records.GrowingFile.append = append_half
sys.exit(main.main(arguments))
"""


@pytest.mark.parametrize(
    ("place", "after", "checkpoint", "left"),
    [
        # Checkpoints at steps 0, 25, 50 and 75. Frames every 5 steps, so that 13 of them are there at step 65; rows at
        # step 0 and every 10 steps, so that the eighth is for step 70, when the frame of that step is there.
        ("frame", 13, 50, 13),
        thorough(("row", 7, 50, 14)),
        thorough(("checkpoint", 2, 25, 10)),
    ],
)
def test_killed_run_leaves_usable_files_and_continues_without_a_gap(box, whole_run, place, after, checkpoint, left):
    out = Path("cut.dcd")
    command = ["run", str(box), *SMALL, "--time", "0.4", "--out", str(out)]
    killed = subprocess.run(
        [sys.executable, "-c", KILLER, place, str(after), *command], capture_output=True, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    assert checkpoints.read_checkpoint(Path("cut.chk"))[1].step == checkpoint
    assert frames(out, box).n_frames == left

    assert main.main([*command, "--restart", "cut.chk"]) == 0
    ours, theirs = frames(out, box), frames(whole_run / "whole.dcd", box)
    assert ours.n_frames == FRAMES
    assert frames_in_header(out) == FRAMES
    # The continuation starts from the checkpoint's doubles; what differs is the files' rounding.
    np.testing.assert_allclose(ours.xyz, theirs.xyz, atol=1e-5)
    np.testing.assert_allclose(ours.unitcell_lengths, theirs.unitcell_lengths, rtol=1e-5)
    rows, all_rows = log("cut.csv"), log(whole_run / "whole.csv")
    np.testing.assert_array_equal(rows["Step"], np.arange(0, STEPS + 1, 10))
    np.testing.assert_allclose(rows["Potential Energy (kJ/mole)"], all_rows["Potential Energy (kJ/mole)"], rtol=1e-6)


# --- refusals ---

#: What a restart keeps, each with another value.
CHANGED = (
    *(("--dt", "2"), ("--scheme", "sier4"), ("--out", "other.dcd"), ("--every", "0.5")),
    *(("--ensemble", "nvt"), ("--temperature", "310"), ("--seed", "7")),
)


def test_continuations_that_are_refused(box, whole_run, capsys):
    chk, platform = whole_run / "whole.chk", ["--platform", "Reference"]
    assert "is at step 100" in complaint(capsys, "run", box, *platform, "--restart", chk, code=NothingLeft.exit_code)
    assert "is at step 100" in complaint(capsys, "run", box, *platform, "--restart", chk, "--steps", 50)
    assert "is not a checkpoint" in complaint(capsys, "run", box, *platform, "--restart", whole_run / "whole.csv")
    assert "none.chk: No such file" in complaint(capsys, "run", box, "--restart", "none.chk")
    for length in (0, 3, 1000):
        Path("cut.chk").write_bytes(chk.read_bytes()[:length])
        message = complaint(capsys, "run", box, "--restart", "cut.chk")
        assert "cut.chk is damaged" in message
        assert "Give another one" in message
    for option, value in CHANGED:
        message = complaint(capsys, "run", box, *platform, "--restart", chk, option, value)
        assert f"{option} " in message
        assert "differs from" in message
    one = SYSTEMS / "tip4p-1.pdb"
    message = complaint(capsys, "run", one, *platform, "--restart", chk, "--time", "1")
    assert f"{one} is not the file that the run of {chk} read" in message


def test_checkpoint_of_another_version_is_refused(box, whole_run, capsys):
    shutil.copy(whole_run / "whole.chk", "old.chk")
    rewrite_notes("old.chk", lambda notes: notes.update(format=7))
    for use in ("--restart", "--start"):
        message = complaint(capsys, "run", box, use, "old.chk", "--time", "1")
        assert (
            "old.chk was written by another version of openmm-sier, in format 7; this version reads format 1: finish"
            in message
        )


def test_continuation_with_other_energies_is_refused(whole_run, box, capsys):
    """As where OpenMM's own force field has changed, which is none of the files that are noted."""
    for path in whole_run.glob("whole.*"):
        shutil.copy(path, Path())
    rewrite_notes("whole.chk", lambda notes: notes.update(potential_energy=1.001 * notes["potential_energy"]))
    command = "run", box, "--restart", "whole.chk", "--time", "1", "--platform", "Reference"
    assert "the molecules or the force field are not those of the run" in complaint(capsys, *command)


def test_bad_input_is_refused_in_one_line(box, capsys):
    assert "none.pdb: No such file or directory" in complaint(capsys, "run", "none.pdb")
    Path("text.pdb").write_text("this is no structure\n")
    assert "text.pdb is not a PDB file with atoms" in complaint(capsys, "info", "text.pdb")
    assert 'Could not locate file "none.xml"' in complaint(capsys, "run", box, "--forcefield", "none.xml")
    assert "No template found for residue" in complaint(capsys, "run", box, "--forcefield", "amber14/lipid17.xml")
    assert "must end in .dcd, got a.trr" in complaint(capsys, "run", box, "--out", "a.trr", code=2)
    assert not list(Path().glob("box.*"))


def test_bad_arguments_are_refused_in_one_line(box, capsys):
    for arguments in ("run a.pdb --dt fast", "run a.pdb --steps 5 --time 1", "run a.pdb --scheme sier3", "fly", ""):
        complaint(capsys, *arguments.split(), code=main.MISUSED)


def test_missing_rich_names_the_extra(box, capsys, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "rich"]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("console", "info"):
        monkeypatch.delitem(sys.modules, f"openmm_sier.cli.{name}", raising=False)
        monkeypatch.delattr(f"openmm_sier.cli.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "rich", None)
    monkeypatch.setitem(sys.modules, "rich.console", None)
    assert "openmm-sier[cli]" in complaint(capsys, "info", box)


def test_unexpected_error_is_one_line_or_a_traceback_on_demand(box, capsys, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("a mistake\nof ours")

    monkeypatch.setattr(forcefields, "pme_system", broken)
    assert "ZeroDivisionError: a mistake of ours" in complaint(capsys, "info", box)
    with pytest.raises(ZeroDivisionError):
        main.main(["info", str(box), "--debug"])


def test_version(capsys):
    assert main.main(["--version"]) == 0
    assert capsys.readouterr().out == f"openmm-sier {__version__}\n"


# --- info ---


def test_info_shows_the_bodies_of_a_salt_solution(capsys):
    assert main.main(["info", str(SYSTEMS / "tip3p-nacl-512.pdb")]) == 0
    out = capsys.readouterr().out
    rows = [re.sub(r" +", " ", line).strip("│ ").split(" │ ") for line in out.splitlines() if line.startswith("│")]
    assert {row[0]: (row[1], row[2], row[5]) for row in rows} == {
        "HOH": ("494", "O H1 H2", "6"),
        "NA": ("9", "NA", "3"),
        "CL": ("9", "CL", "3"),
    }
    assert "494 rigid bodies, 18 points (atoms that move by themselves), 1500 particles, 3018 degrees of freedom" in out
