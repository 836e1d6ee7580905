"""Plans of ensembles, and the command that carries them out."""

import json
import signal
import subprocess
import sys
import threading
import time

import pytest

from openmm_sier.cli.ensembles import PlanError, read_plan
from openmm_sier.cli.main import main
from openmm_sier.cli.member import execute
from openmm_sier.cli.options import OptionError
from openmm_sier.cli.pool import _RUNNING, COMPLETE, NOTES, WORKER, ensemble, fraction_done, is_complete
from tests.support.commands import complaint, wait_for, write_lattice

PLAN = """
[options]
time = 0.4
ensemble = "nvt"
platform = "Reference"
equilibrate = 0.02
report_every = 0.02
checkpoint_every = 0.04
every = 0.04
[members]
box = ["box.pdb"]
scheme = ["sier2"]
dt = [4]
seed = [1, 2]
"""


@pytest.fixture
def plan(tmp_path):
    write_lattice(tmp_path / "box.pdb", 8)
    path = tmp_path / "plan.toml"
    path.write_text(PLAN)
    return path


def test_members_are_all_combinations(plan):
    plan.write_text(PLAN.replace("dt = [4]", "dt = [2, 4.5]\nminimize = [true, false]"))
    members = read_plan(plan)
    assert len(members) == 8
    assert members[0].name == "box-sier2-dt2-minimizeTrue-seed1"
    assert members[-1].name == "box-sier2-dt4.5-minimizeFalse-seed2"
    assert members[-1].length == 0.4
    command, box, *options = members[-1].arguments
    assert (command, box) == ("run", str((plan.parent / "box.pdb").resolve()))
    assert "--no-minimize" in options
    assert options[options.index("--report-every") + 1] == "0.02"


def test_single_values_in_a_table_are_options_of_its_members(plan):
    """They are not in the names: a longer time continues members that are there."""
    text = PLAN.replace("time = 0.4\n", "").replace("[members]", "[[members]]\ntime = 0.8")
    plan.write_text(text + '\n[[members]]\ntime = 0.4\nbox = ["box.pdb"]\nscheme = ["sier4g"]\n')
    assert [(m.name, m.length) for m in read_plan(plan)] == [
        ("box-sier2-dt4-seed1", 0.8),
        ("box-sier2-dt4-seed2", 0.8),
        ("box-sier4g", 0.4),
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[options]", "[option]", "expected options, members, got option"),
        ("[options]", 'command = "run"\n[options]', "expected options, members, got command"),
        ("dt = [4]", "dt = []", r"dt in \[members\] must have values, got an empty list"),
        ("seed = [1, 2]", "seed = [1, 2]\nevery = 1", r"every is in \[options\] and in \[members\]"),
        ("dt = [4]", 'ensemble = ["nve"]', r"ensemble is in \[options\] and in \[members\]"),
        ("dt = [4]", 'out = ["here"]', "out is set by the ensemble"),
        ("seed = [1, 2]", "seed = [1, 1]", "more than one member is called box-sier2-dt4-seed1: names have the values"),
        ("dt = [4]", "dt = [-4]", "dt: expected a number from 0.05 to 1000 fs, got -4"),
        ("dt = [4]", "speed = [4]", "there is no option speed"),
        ("dt = [4]", "steps = [4]", "steps and time exclude each other"),
        ("dt = [4]", "pressure = [1]", "--pressure needs --ensemble npt or hmc"),
        ("dt = [4]", "report = ['../a.csv']", "report: outputs lie in the directory of each member"),
        (
            "dt = [4]",
            "pressure_tensor = ['there/a.csv']",
            "pressure_tensor: outputs lie in the directory",
        ),
        ("dt = [4]", "rigid = [['A', 3]]", "rigid: expected a name, got 3"),
        ('box = ["box.pdb"]', "", "box is missing"),
        ("time = 0.4", "time = ", "is no TOML file"),
        ("box.pdb", "bx.pdb", r"box bx\.pdb is neither a file beside the plan nor one of the project's own boxes"),
        # A file, but of the directory in which the command is called.
        ("box.pdb", "here/box.pdb", r"box here/box\.pdb is neither"),
    ],
)
def test_wrong_plans_are_refused_before_anything_runs(plan, capsys, monkeypatch, tmp_path, old, new, message):
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "here").mkdir(parents=True)
    (elsewhere / "here" / "box.pdb").touch()
    monkeypatch.chdir(elsewhere)
    plan.write_text(PLAN.replace(old, new))
    with pytest.raises((PlanError, OptionError), match=message):
        read_plan(plan)
    for more in ([], ["--list"]):
        assert str(plan) in complaint(capsys, "ensemble", plan, *more)
    assert not plan.with_suffix("").exists()


# --- files beside a plan ---


def test_only_inputs_are_looked_for_beside_a_plan(plan):
    """Files that are called like a scheme, a residue, an output or an ensemble do not matter."""
    for name in ("sier2", "nvt", "HOH", "log.csv", "hbonds", "Reference"):
        (plan.parent / name).write_text("mine")
    (plan.parent / "mine.xml").write_text("<ForceField/>")
    more = (
        '[options]\nreport = "log.csv"\nrigid = "HOH"\nconstraints = "hbonds"\nforcefield = ["mine.xml", "tip3p.xml"]'
    )
    plan.write_text(PLAN.replace("[options]", more))
    _, box, *options = read_plan(plan)[0].arguments
    assert box == str(plan.parent.resolve() / "box.pdb")
    assert options[options.index("--report") + 1] == "log.csv"
    assert options[options.index("--scheme") + 1] == "sier2"
    where = options.index("--forcefield")
    assert options[where + 1 : where + 3] == [str(plan.parent.resolve() / "mine.xml"), "tip3p.xml"]
    assert sum(str(plan.parent) in option for option in options) == 1


@pytest.mark.parametrize(
    ("box", "name"), [("...pdb", "__"), ("..pdb", "_"), (".hidden.pdb", "_hidden"), ("....pdb", "___")]
)
def test_members_are_called_what_lies_in_the_directory_of_the_ensemble(plan, box, name):
    (plan.parent / "box.pdb").rename(plan.parent / box)
    plan.write_text(PLAN.replace("box.pdb", box).replace('scheme = ["sier2"]\ndt = [4]\nseed = [1, 2]', ""))
    assert [member.name for member in read_plan(plan)] == [name]


@pytest.mark.parametrize("name", [COMPLETE, NOTES])
def test_a_member_with_a_damaged_note_is_done_again(plan, monkeypatch, name):
    first, _ = read_plan(plan)
    calls = []
    monkeypatch.setattr("openmm_sier.cli.member.main", lambda arguments: calls.append(arguments) or 0)
    place = plan.with_suffix("") / first.name
    place.parent.mkdir()
    carry_out(first, place, monkeypatch)
    (place / "run.chk").write_bytes(b"of a run")
    (place / COMPLETE).unlink()
    (place / name).write_bytes(b"[")
    assert not is_complete(first, place.parent)
    calls.clear()
    assert carry_out(first, place, monkeypatch) == 0
    # Whose checkpoint it is, is known from its notes alone.
    went_on = ["--restart", "run.chk"] if name == COMPLETE else ["--out", "run.dcd", "--overwrite"]
    assert calls == [[*first.arguments, *went_on]]
    assert is_complete(first, place.parent)


def outputs(place):
    return {path.name: path.read_bytes() for path in place.iterdir() if path.suffix in (".csv", ".dcd")}


def carry_out(member, place, monkeypatch):
    """Execute a member here, without a process of its own."""
    place.mkdir(exist_ok=True)
    monkeypatch.chdir(place)
    return execute(list(member.arguments))


@pytest.mark.slow
def test_kills_leave_no_trace(plan, tmp_path, monkeypatch):
    (first, *_) = read_plan(plan)
    assert carry_out(first, tmp_path / "quiet", monkeypatch) == 0
    place = tmp_path / "killed" / first.name

    def kill():
        # Before the first checkpoint, and with half of the run done.
        for part in (0, 0.5):
            while not _RUNNING or fraction_done(first, place.parent) < part:
                time.sleep(0.01)
            for child in tuple(_RUNNING):
                child.kill()
                child.wait()

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    (outcome,) = ensemble([first], tmp_path / "killed")
    thread.join()
    assert outcome.restarts == 2
    assert outputs(place) == outputs(tmp_path / "quiet")


@pytest.mark.slow
def test_a_member_does_what_is_left(plan, tmp_path, monkeypatch, capsys):
    (first, *_) = read_plan(plan)
    place = tmp_path / "member"
    assert carry_out(first, place, monkeypatch) == 0
    done = outputs(place)
    assert set(done) == {"run.csv", "run.dcd"}
    # It did not come to note that it was complete.
    (place / COMPLETE).unlink()
    assert carry_out(first, place, monkeypatch) == 0
    assert is_complete(first, tmp_path) is False
    assert is_complete(first._replace(name="member"), tmp_path)
    assert outputs(place) == done

    longer = first._replace(arguments=tuple("0.48" if word == "0.4" else word for word in first.arguments))
    assert not is_complete(longer._replace(name="member"), tmp_path)
    assert carry_out(longer, place, monkeypatch) == 0
    assert outputs(place)["run.csv"].startswith(done["run.csv"])
    assert len(outputs(place)["run.dcd"]) > len(done["run.dcd"])

    other = first._replace(arguments=tuple("0.06" if word == "0.02" else word for word in first.arguments))
    capsys.readouterr()
    assert carry_out(other, place, monkeypatch) == 1
    assert "has another member, with 0.02: choose another directory" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_lists_members_and_fails_with_them(plan, tmp_path, capsys):
    plan.write_text(PLAN.replace("seed = [1, 2]", 'rigid = ["NONE"]'))
    assert main(["ensemble", str(plan), "--list"]) == 0
    assert "0 of them complete" in capsys.readouterr().out
    assert not plan.with_suffix("").exists()
    assert "NONE" in complaint(capsys, "ensemble", plan)


@pytest.mark.slow
def test_a_member_ends_with_the_process_that_started_it(plan, tmp_path):
    (first, *_) = read_plan(plan)
    place = tmp_path / "alone"
    place.mkdir()
    arguments = [argument.replace("0.4", "400") for argument in first.arguments]
    child = subprocess.Popen(
        [sys.executable, "-m", WORKER, *arguments], cwd=place, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    wait_for((place / "run.chk").exists, child)
    child.stdin.close()
    assert child.wait(120) == 128 + signal.SIGTERM
    assert json.loads((place / NOTES).read_text())[0] == "run"
    assert not (place / COMPLETE).exists()
