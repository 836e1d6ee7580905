"""Two commands on one output: the second is refused, and the next one starts when the first is gone."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from openmm_sier.cli.errors import RunError
from openmm_sier.cli.files.locks import FileLocks
from tests.support.commands import SMALL, SYSTEMS, complaint, contents, run
from tests.support.matrices import representatives

#: Seconds after which a test fails rather than wait.
LIMIT = 300

#: Locks the files that it is given and says so, until its standard input ends.
HOLDER = """
import sys
from pathlib import Path
from openmm_sier.cli.files.locks import FileLocks
with FileLocks() as locks:
    locks.hold(map(Path, sys.argv[1:]))
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder():
    """A function that makes another process lock files."""
    started = []

    def hold(*names):
        process = subprocess.Popen(
            [sys.executable, "-c", HOLDER, *names], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout.readline() == "held\n"
        return process

    yield hold
    for process in started:
        process.kill()
        process.communicate(timeout=LIMIT)


def names():
    """All files in the current directory, hidden ones too."""
    return sorted(contents(Path()))


def test_second_holder_is_refused(holder):
    holder("a.dcd", "a.csv")
    for _ in range(2):
        with FileLocks() as locks, pytest.raises(RunError, match=r"^a\.csv is being written"):
            locks.hold([Path("b.csv"), Path("a.csv")])
        # The lock on b.csv that it got first is gone.
        assert names() == [".a.csv.lock", ".a.dcd.lock"]


def test_lock_of_a_killed_process_is_free(holder):
    first = holder("a.dcd")
    first.send_signal(signal.SIGKILL)
    first.wait(LIMIT)
    assert names() == [".a.dcd.lock"]
    with FileLocks() as locks:
        locks.hold([Path("a.dcd")])
        assert names() == [".a.dcd.lock"]
    assert not names()


def test_a_lock_that_cannot_be_made_is_named():
    name = f"{'x' * 250}.dcd"
    with FileLocks() as locks, pytest.raises(OSError, match="File name too long") as refusal:
        locks.hold([Path(name)])
    assert Path(refusal.value.filename).name == f".{name}.lock"


@pytest.mark.thorough
def test_a_file_has_one_lock_by_all_its_names(holder):
    Path("there").mkdir()
    Path("link.dcd").symlink_to("there/a.dcd")
    Path("here").symlink_to("there")
    holder("link.dcd")
    # By its own name too, since --overwrite would replace the link.
    for name in ("there/a.dcd", "here/a.dcd", "link.dcd", os.path.abspath("link.dcd")):
        with FileLocks() as locks, pytest.raises(RunError):
            locks.hold([Path(name)])


OUTPUTS = ["--out", "a.dcd", "--pressure-tensor", "p.csv"]


@pytest.mark.parametrize("taken", representatives(["a.chk", "a.dcd", "a.csv", "p.csv"], "a.csv"))
def test_every_file_of_a_run_is_locked(box, holder, capsys, taken):
    holder(taken)
    Path("a.csv").write_text("mine\n")
    before = contents(Path())
    message = complaint(capsys, "run", box, *SMALL, *OUTPUTS, "--overwrite")
    assert f"{taken} is being written by another process" in message
    assert contents(Path()) == before


@pytest.mark.thorough
def test_restart_is_refused_before_its_checkpoint_is_read(box, holder, capsys):
    run("run", box, *SMALL, "--steps", "5")
    capsys.readouterr()
    holder("box.csv")
    again = ["run", box, "--platform", "Reference", "--restart", "box.chk", "--steps", "10"]
    before = contents(Path())
    assert "box.csv is being written by another process" in complaint(capsys, *again)
    assert contents(Path()) == before
    Path("box.chk").write_bytes(b"half")
    assert "not a checkpoint" in complaint(capsys, *again)
    holder("box.chk")
    # A run that begins anew removes the checkpoint before it writes its own.
    Path("box.chk").unlink()
    assert "box.chk is being written by" in complaint(capsys, *again)


@pytest.mark.thorough
def test_two_commands_started_one_after_the_other(tmp_path):
    """What `python -m tests.loops.two_commands` does a hundred times for each pair."""
    program = [sys.executable, "-m", "tests.loops.two_commands", "--times", "1", "--out", str(tmp_path)]
    # A process that it may fork.
    process = subprocess.run(
        [*program, "--pairs", "run,restart"],
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
        cwd=SYSTEMS.parent,
    )
    assert process.returncode == 0, process.stderr
