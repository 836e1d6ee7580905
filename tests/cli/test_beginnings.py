"""New runs from checkpoints of others, body states, and lines about progress."""

from pathlib import Path

import numpy as np
import pytest
from openmm import app, unit

from openmm_sier.cli import console
from openmm_sier.cli.files import checkpoints
from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.inputs import equilibration
from tests.support.commands import SMALL, SYSTEMS, complaint, frames, log, run, write_lattice


@pytest.fixture(scope="module")
def npt_run(box):
    """Directory of a run at constant pressure, in which the volume changes with each move."""
    options = [*SMALL, *("--ensemble", "npt", "--pressure", "-500", "--dt", "2", "--temperature", "310")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MonteCarloVolumeMove, "is_accepted", lambda *_: True)
        run("run", box, *options, "--time", "0.2", "--out", box.with_name("npt.dcd"))
    return box.parent


def momentum(rows):
    """Magnitude of the total momentum, dalton nm/ps."""
    return np.linalg.norm([rows[f"Momentum {axis} (dalton nm/ps)"] for axis in "xyz"], axis=0)


# --- from a checkpoint ---


@pytest.mark.thorough
@pytest.mark.parametrize("ensemble", ["nve", "nvt"])
def test_run_starts_from_a_checkpoint_of_another_ensemble(box, npt_run, capsys, ensemble):
    """Potential energy and volume are those of the end of the other run; step and clock start from zero."""
    start = npt_run / "npt.chk"
    # Moves accepted whatever they cost leave 600 K or more, where the default step would be too long.
    options = ("--ensemble", ensemble, "--scheme", "sier4g", "--steps", "50", "--dt", "1")
    run("run", box, "--platform", "Reference", "--start", start, *options)
    out = capsys.readouterr().out
    assert "equilibrated" not in out
    assert "minimized" not in out
    before, after = log(npt_run / "npt.csv"), log("box.csv")
    assert (after["Step"][0], after["Time (ps)"][0]) == (0, 0)
    assert after["Box Volume (nm^3)"][0] == before["Box Volume (nm^3)"][-1] != before["Box Volume (nm^3)"][0]
    # Attitudes are fitted anew, which rounds them.
    assert after["Potential Energy (kJ/mole)"][0] == pytest.approx(before["Potential Energy (kJ/mole)"][-1], rel=1e-9)
    # The noise of the bath alone moves the centre of mass: it is that of the seed, whatever the molecules do.
    centre = momentum(before)[-1] ** 2 / (2 * 27 * 18.01528)
    assert centre > 0.01
    # At constant energy the centre of mass is at rest, which is all that is taken; a heat bath keeps its velocity.
    taken = centre if ensemble == "nve" else 0.0
    expected = before["Kinetic Energy (kJ/mole)"][-1] - taken
    assert after["Kinetic Energy (kJ/mole)"][0] == pytest.approx(expected, rel=1e-6)
    if ensemble == "nve":
        assert momentum(after)[0] < 1e-9
        # Of 162 degrees of freedom kT/2 each, the bath would exchange some tens of kJ/mol; SIER4G holds them to 0.01.
        assert np.ptp(after["Conserved Energy (kJ/mole)"]) < 1.0
    # The heat of the other run is not this one's.
    assert after["Conserved Energy (kJ/mole)"][0] == after["Total Energy (kJ/mole)"][0]


def test_start_determines_the_system_and_the_temperature(box, npt_run):
    start = ["run", box, "--platform", "Reference", "--start", npt_run / "npt.chk", "--steps", "1", "--overwrite"]
    run(*start, "--ensemble", "nvt")
    plan = checkpoints.read_checkpoint(Path("box.chk"))[1].plan
    assert (plan["temperature"], plan["scheme"], plan["dt"]) == (310.0, "sier2", 4.0)
    # No equilibration is none, and not new velocities.
    kinetic = log("box.csv")["Kinetic Energy (kJ/mole)"][0]
    run(*start, "--ensemble", "nvt", "--equilibrate", "0")
    assert log("box.csv")["Kinetic Energy (kJ/mole)"][0] == kinetic
    run(*start, "--ensemble", "nvt", "--temperature", "290")
    assert checkpoints.read_checkpoint(Path("box.chk"))[1].plan["temperature"] == 290.0


def test_start_equilibrates_if_asked(box, npt_run, capsys):
    start = ["run", box, "--platform", "Reference", "--start", npt_run / "npt.chk", "--steps", "1"]
    run(*start, "--equilibrate", "0.024")
    assert "equilibrated for 0.024 ps at 310 K" in capsys.readouterr().out
    # In the box of the checkpoint, from its positions.
    assert log("box.csv")["Box Volume (nm^3)"][0] == log(npt_run / "npt.csv")["Box Volume (nm^3)"][-1]


def test_starts_that_are_refused(box, npt_run, capsys):
    start = npt_run / "npt.chk"
    assert "give one of them" in complaint(capsys, "run", box, "--start", start, "--restart", start, code=2)
    assert "none.chk: No such file" in complaint(capsys, "run", box, "--start", "none.chk")
    one = SYSTEMS / "tip4p-1.pdb"
    message = complaint(capsys, "run", one, "--start", start, "--forcefield", "tip4p.xml")
    assert "npt.chk does not fit" in message
    # The same molecules with the hydrogens first, so that each takes the places of other atoms.
    lines = box.read_text().splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if line.startswith(("ATOM", "HETATM")))
    for i in range(first, first + 81, 3):
        lines[i : i + 3] = [*lines[i + 1 : i + 3], lines[i]]
    reordered = box.with_name("reordered.pdb")
    reordered.write_text("".join(line for line in lines if not line.startswith("CONECT")))
    assert "npt.chk does not fit" in complaint(capsys, "run", reordered, "--start", start)
    assert not list(Path().iterdir())


# --- wrapped and unwrapped frames ---


def test_unwrapped_frames_have_molecules_where_they_went():
    """The first molecule begins three boxes away from the others."""
    box = write_lattice(Path("box.pdb"))
    pdb = app.PDBFile(str(box))
    positions = pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    edge = pdb.topology.getUnitCellDimensions()[0].value_in_unit(unit.nanometer)
    positions[:3, 0] += 3 * edge
    with open("far.pdb", "w") as file:
        app.PDBFile.writeFile(pdb.topology, positions * unit.nanometer, file)
    options = ["run", "far.pdb", "--forcefield", "tip3p.xml", "--platform", "Reference", "--equilibrate", "0"]
    options += ["--dt", "4", "--every", "0.004", "--steps", "5"]
    run(*options, "--out", "wrapped.dcd")
    run(*options, "--out", "unwrapped.dcd", "--unwrapped")
    wrapped, unwrapped = (frames(Path(name), box).xyz for name in ("wrapped.dcd", "unwrapped.dcd"))
    # In 4 fs a hydrogen of 300 K moves by 0.006 nm.
    assert np.abs(np.diff(unwrapped, axis=0)).max() < 0.1
    # Molecules as a whole are in the box: atoms stick out by a bond at most.
    assert -0.1 < wrapped.min() < wrapped.max() < edge + 0.1
    periods = (unwrapped - wrapped) / edge
    np.testing.assert_allclose(periods, np.round(periods), atol=1e-5)
    # Its own face is never three boxes away.
    assert np.abs(periods[:, :3, 0] - 3).max() < 1.5


# --- what is shown ---


def test_the_table_repeats_that_an_equilibration_has_not_settled(capsys, monkeypatch):
    """Also after a restart; a run without an equilibration draws no warning."""
    monkeypatch.setattr(equilibration, "_are_within_bounds", lambda *_: False)
    write_lattice(Path("box.pdb"), 8)
    short = ["--platform", "Reference", "--dt", "2", "--temperature", "297", "--no-minimize"]
    run("run", "box.pdb", *short, "--steps", "2", "--equilibrate", "0.1")
    output = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "warning: not equilibrated after 0.1" in output
    row = "WARNING: not equilibrated after 0.102 ps at 297 K: T_trans = "
    assert row in output
    run("run", "--restart", "box.chk", "--steps", "4")
    assert row in " ".join(capsys.readouterr().out.replace("│", " ").split())
    run("run", "box.pdb", *short, "--steps", "2", "--equilibrate", "0", "--overwrite")
    assert "not equilibrated" not in capsys.readouterr().out


def test_progress_lines_are_rare(monkeypatch, capsys):
    """A line after 30 s, then one for every twentieth of the time so far, and at least every ten minutes."""
    now = [0.0]
    monkeypatch.setattr(console, "clock", lambda: now[0])
    with console.progress_bar("run", 100_000, 0.001) as show:
        at = []
        for second in range(1, 40_000):
            now[0] = second
            show(second)
            if capsys.readouterr().err:
                at.append(second)
    assert at[:3] == [30, 60, 90]
    assert 600 < max(np.diff(at)) + 1 <= 602
    # 20 until 600 s, ln(20)/ln(1.05) = 61 until 12000 s, and 47 in the rest.
    assert len(at) < 130
