"""Pictures of logs: panels and means of logs whose statistics are known, picture files, and refusals."""

import sys
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.analysis import read_log
from openmm_sier.cli import pictures
from openmm_sier.cli.logged_runs import read_run
from openmm_sier.cli.settling import read_runs
from openmm_sier.inputs import equilibration
from tests.support.commands import SMALL, SYSTEMS, complaint, contents, run
from tests.support.logs import write_log, write_notes
from tests.support.matrices import representatives

pytest.importorskip("matplotlib")

POTENTIAL = "Potential Energy (kJ/mole)"


def eight(ensemble, **options):
    names = [f"seed{seed}.csv" for seed in range(1, 9)]
    for seed, name in enumerate(names, 1):
        write_log(name, ensemble, seed=seed, **options)
    return names


# --- panels ---


@pytest.mark.parametrize(
    ("ensemble", "titles"),
    [
        ("nve", ["Conserved energy H", "Potential energy V", "Temperatures"]),
        ("nvt", ["Potential energy V", "Conserved energy H", "Temperatures"]),
        ("npt", ["Potential energy V", "Conserved energy H", "Temperatures", "Density"]),
        ("hmc", ["Potential energy V", "Temperatures", "Accepted trials"]),
    ],
)
def test_each_ensemble_has_its_panels(ensemble, titles):
    write_log("a.csv", ensemble)
    write_notes("a.csv", ensemble)
    assert [panel.title for panel in pictures.panels(read_runs([Path("a.csv")]))] == titles


def test_means_over_equal_times_are_those_of_their_rows():
    write_log("a.csv")
    runs = read_runs([Path("a.csv")])
    times, means = pictures.means_of(runs, POTENTIAL)
    # The most are 60, each of a sixtieth of 20 ps: by turns of 8 and 9 rows, the first of the row at the start too.
    values, rows = runs.first.log[POTENTIAL], np.ceil(np.arange(501) * 60 / 500 - 1e-6).astype(int).clip(1) - 1
    assert times == pytest.approx(20 / 60 * (np.arange(60) + 0.5))
    assert means[0] == pytest.approx([values[rows == number].mean() for number in range(60)])


def test_lines_of_a_short_log_are_its_rows():
    write_log("a.csv", rows=12)
    runs = read_runs([Path("a.csv")])
    _, (means,) = pictures.means_of(runs, POTENTIAL)
    assert means[1:] == pytest.approx(runs.first.log[POTENTIAL][2:])


# --- files ---


@pytest.mark.parametrize(
    ("ensemble", "ending"),
    representatives([("npt", ".png"), ("hmc", ".svg")], ("npt", ".png")),
)
def test_pictures_of_one_and_of_eight(ensemble, ending, capsys):
    names = eight(ensemble, rows=101)
    logs = contents(Path())
    drawn = []
    # Drawn again, a picture is the same to the byte.
    for paths in (names[:1], names, names):
        run("summary", *paths, "--plot", f"a{ending}", "--overwrite")
        drawn.append(Path(f"a{ending}").read_bytes())
        assert drawn[-1].startswith(b"\x89PNG" if ending == ".png" else b"<?xml")
    assert drawn[0] != drawn[1] == drawn[2]
    assert f"wrote a{ending}" in capsys.readouterr().out
    Path(f"a{ending}").unlink()
    assert contents(Path()) == logs


def test_a_run_draws_at_its_end(box, capsys):
    short = ["run", box, *SMALL, "--report-every", "0.004", "--steps", "10", "--plot", "a.svg"]
    run(*short)
    assert "wrote box.chk, box.dcd, box.csv, a.svg" in capsys.readouterr().out
    # The title of the run is that of its checkpoint.
    assert read_run(Path("box.csv")).plan.title == "SIER2, NVE, 4 fs"
    before = contents(Path())
    for name in ("box.chk", "box.dcd", "box.csv"):
        Path(name).unlink()
    before = contents(Path())
    assert "a.svg exists" in complaint(capsys, *short)
    assert contents(Path()) == before
    run(*short, "--overwrite")


def test_a_run_too_short_for_a_picture_is_complete(box, capsys):
    command = ["run", box, *SMALL, "--steps", "10", "--plot", "a.png"]
    assert "box.csv has 2 rows so far and needs 3 or more" in complaint(capsys, *command)
    assert sorted(contents(Path())) == ["box.chk", "box.csv", "box.dcd"]
    assert len(read_log("box.csv")["Step"]) == 2


def test_a_molecule_alone(capsys):
    """Its potential energy is constant, and it has no box."""
    molecule = SYSTEMS / "tip4p-1.pdb"
    run("run", molecule, "--time", "2", "--equilibrate", "0.1", "--platform", "Reference", "--plot", "a.png")
    assert Path("a.png").exists()


def test_a_log_that_is_being_written_is_drawn():
    write_log("a.csv")
    with open("a.csv", "a") as file:
        file.write("501,20.04,-50")
    assert len(read_run(Path("a.csv")).log["Step"]) == 501


# --- refusals ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.csv", "--plot", "a.jpg"], "the name of a picture must end in .png or .svg, got a.jpg"),
        (["a.csv", "--plot", "none/a.png"], "there is no directory none for a.png"),
        (["none.csv"], "none.csv: No such file or directory"),
        (["a.csv", "a.csv"], "a.csv is given twice: each run counts once"),
        (
            ["a.csv", "bath.csv"],
            "bath.csv and a.csv differ in ensemble or columns: give runs of one kind",
        ),
        (
            ["tensor.csv"],
            "tensor.csv is not a log of openmm-sier run, since it has no column Potential Energy (kJ/mole)",
        ),
        (["a.dcd"], "a.dcd is not a log of openmm-sier run: give the .csv file that --report wrote"),
        (["short.csv"], "short.csv has 2 rows so far and needs 3 or more: let the run continue"),
        (["a.csv", "--skip", "20"], "--skip 20 leaves nothing: the shortest run has 20 ps"),
    ],
)
def test_wrong_logs_are_refused_in_one_line(capsys, arguments, message):
    for name, ensemble in (("a.csv", "nve"), ("bath.csv", "nvt")):
        write_log(name, ensemble)
        write_notes(name, ensemble)
    write_log("short.csv", rows=2)
    write_log("tensor.csv", columns=["Step", "Time (ps)"])
    Path("a.dcd").write_bytes(bytes(range(256)))
    before = contents(Path())
    code = 2 if "must end in" in message or "given twice" in message else 1
    assert message in complaint(capsys, "summary", "--plot", "a.png", *arguments, code=code)
    assert contents(Path()) == before


def test_a_picture_destroys_no_log(capsys):
    write_log("a.png")
    before = contents(Path())
    assert "a.png would overwrite the input a.png: give another name" in complaint(
        capsys, "summary", "a.png", "--plot", "a.png"
    )
    assert contents(Path()) == before


def test_a_picture_in_the_way_is_refused(capsys):
    write_log("a.csv")
    Path("a.png").write_bytes(b"mine")
    line = ["summary", "a.csv", "--plot", "a.png"]
    assert "a.png exists" in complaint(capsys, *line)
    assert Path("a.png").read_bytes() == b"mine"
    run(*line, "--overwrite")
    assert Path("a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("ending", representatives([".png", ".svg"], ".png"))
def test_a_run_that_continues_replaces_the_picture_of_its_log_alone(box, capsys, ending):
    """Not that of another log, nor a photo."""
    line = ["run", box, *SMALL, "--report-every", "0.004", "--plot", (name := f"a{ending}")]
    run(*line, "--steps", "10")
    own = Path(name).read_bytes()
    run("run", box, *SMALL[-4:], "--restart", "box.chk", "--steps", "20", "--plot", name)
    longer = Path(name).read_bytes()
    assert own != longer
    write_log("other.csv")
    run("summary", "other.csv", "--plot", name, "--overwrite")
    others = Path(name).read_bytes()
    for content in (others, b"mine"):
        Path(name).write_bytes(content)
        again = ["--restart", "box.chk", "--steps", "30", "--plot", name]
        for command in (["run", box, *again], [*line, "--steps", "20", "--resume"]):
            assert f"{name} exists" in complaint(capsys, *command)
            assert Path(name).read_bytes() == content
    Path(name).write_bytes(own)
    # A complete run draws its picture again.
    run(*line, "--steps", "20", "--resume")
    assert Path(name).read_bytes() == longer


def test_missing_matplotlib_names_the_extra(box, capsys, monkeypatch):
    """Before a run begins, not at its end."""
    write_log("a.csv")
    before = contents(Path())
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    picture = ["--plot", "a.png"]
    for command in (["summary", "a.csv", *picture], ["run", box, *SMALL, *picture]):
        message = complaint(capsys, *command)
        assert "pictures need matplotlib; install it with: pip install 'openmm-sier[plot]'" in message
    assert contents(Path()) == before


@pytest.mark.thorough
def test_runs_that_differ_in_more_than_the_seed_draw_a_warning(box, capsys, monkeypatch):
    # Whatever a lattice of water does in 0.1 ps, it is not equilibrated.
    monkeypatch.setattr(equilibration, "_are_within_bounds", lambda *_: False)
    for out, options in (("a", []), ("b", ["--seed", "2"]), ("c", ["--seed", "2", "--dt", "2"])):
        run("run", box, *SMALL, "--steps", "20", "--report-every", "0.004", *options, "--out", f"{out}.dcd")
    capsys.readouterr()
    run("summary", "a.csv", "b.csv", "--plot", "a.png")
    output = capsys.readouterr().out
    assert "differ in" not in output
    # Nor does a picture hide how they began.
    assert "Not equilibrated at the start: 2 of 2 runs" in output
    run("summary", "a.csv", "b.csv", "c.csv")
    output = capsys.readouterr().out
    assert "warning: c.csv and a.csv differ in dt: their mean belongs to no ensemble" in output
    # A title that took the first step for that of all would be wrong.
    assert "3 runs, 0.04 ps, SIER2, NVE, 4 fs and SIER2, NVE, 2 fs" in " ".join(output.split())
