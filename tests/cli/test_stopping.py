"""Runs that signals end: the files are complete, the exit code is the signal's, and a restart continues."""

import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from openmm_sier.cli import info, main
from openmm_sier.cli.files import checkpoints, records
from tests.support.commands import SMALL, frames, log, wait_for

#: Seconds after which a test fails rather than wait. A run of the command takes a few.
LIMIT = 300

#: The command with the handling of signals that a terminal gives it, whatever that of the tests is.
COMMAND = """
import signal, sys
for name in ("SIGINT", "SIGTERM", "SIGHUP"):
    number = getattr(signal, name)
    signal.signal(number, signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL)
from openmm_sier.cli import main, new_run, stopping
from openmm_sier.cli.files import outputs
{patch}
sys.exit(main.main(sys.argv[1:]))
"""

#: Code of OpenMM's kind: it leaves Python to other threads, returns after minutes, and no signal cuts it short.
#: The file is made once the CPU time of the thread shows that it is being executed.
BUSY = """
def busy(*_, **__):
    import hashlib, threading, time
    clock = time.pthread_getcpuclockid(threading.get_ident())
    begun = time.clock_gettime(clock)
    def tell():
        while time.clock_gettime(clock) < begun + 0.05:
            time.sleep(0.01)
        open("busy", "w").close()
    threading.Thread(target=tell, daemon=True).start()
    hashlib.pbkdf2_hmac("sha512", b"a", b"b", 10**9)
"""


@pytest.fixture(params=["SIGINT", "SIGTERM", "SIGHUP"])
def signum(request):
    """A signal that does not end the tests where the command fails to handle it."""
    number = getattr(signal, request.param)
    before = signal.signal(number, lambda *_: pytest.fail(f"{request.param} was not handled"))
    yield number
    signal.signal(number, before)


def started(box, *options, patch="", **streams):
    command = [sys.executable, "-c", COMMAND.format(patch=patch), "run", str(box), *SMALL, *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, **streams)


def ended(process):
    """Exit code and standard error of a process that is to end soon."""
    try:
        _, err = process.communicate(timeout=LIMIT)
    finally:
        process.kill()
    return process.returncode, err


def signal_after_rows(monkeypatch, number, rows):
    """Sends a signal to this process after a number of rows of its log, twice at once as `timeout` does."""
    write = records.Log.write

    def write_and_signal(self, values):
        write(self, values)
        if self.count == rows:
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)

    monkeypatch.setattr(records.Log, "write", write_and_signal)


def test_signal_completes_the_step_and_all_files(box, signum, monkeypatch, capsys):
    options = ["run", str(box), *SMALL]
    with monkeypatch.context() as patch:
        signal_after_rows(patch, signum, 4)
        assert main.main([*options, "--time", "0.4", "--out", "cut.dcd"]) == 128 + signum
    name = signal.Signals(signum).name
    # Rows come every 10 steps, the first at step 0. Checkpoints at 25 and 50 are not what is gone on from.
    assert capsys.readouterr().err == (
        f"openmm-sier: stopped by {name} at step 30 (0.12 ps), all files are written; continue with --restart cut.chk\n"
    )
    assert checkpoints.read_checkpoint(Path("cut.chk"))[1].step == 30
    assert frames(Path("cut.dcd"), box).n_frames == 6
    assert sorted(path.name for path in Path().iterdir()) == ["cut.chk", "cut.csv", "cut.dcd"]
    # The handlers are those of before.
    assert signal.getsignal(signum).__module__ == __name__


@pytest.mark.thorough
def test_ignored_signals_stay_ignored(box, monkeypatch):
    """`nohup` and the background jobs of a script ask for it."""
    for number in (signal.SIGHUP, signal.SIGINT):
        previous = signal.signal(number, signal.SIG_IGN)
        with monkeypatch.context() as patch:
            signal_after_rows(patch, number, 2)
            assert main.main(["run", str(box), *SMALL, "--steps", "25", "--overwrite"]) == 0
        assert signal.getsignal(number) is signal.SIG_IGN
        signal.signal(number, previous)


@pytest.mark.thorough
def test_signal_before_the_first_step_ends_at_once(box):
    """Also in a minimization that takes long, from which OpenMM returns to Python only when it is done."""
    process = started(box, patch=f"{BUSY}\nnew_run.prepare = busy")
    wait_for(Path("busy").exists, process, LIMIT)
    process.send_signal(signal.SIGINT)
    code, _ = ended(process)
    assert code == -signal.SIGINT
    # What is left of locks locks nothing.
    assert [path.name for path in Path().iterdir() if path.suffix != ".lock"] == ["busy"]


@pytest.mark.thorough
def test_closed_terminal(box):
    """Hanging up sends SIGHUP, and whatever is written to the terminal afterwards fails; the cursor stays visible."""
    child, terminal = pty.fork()
    if child == 0:
        code = COMMAND.format(patch="")
        arguments = ["run", str(box), *SMALL, "--time", "1000", "--out", "cut.dcd"]
        os.execv(sys.executable, [sys.executable, "-c", code, *arguments])
    ended_at = time.monotonic() + LIMIT
    while not (Path("cut.csv").exists() and Path("cut.csv").read_text().count("\n") > 3):
        assert time.monotonic() < ended_at
        os.read(terminal, 1000)
    os.close(terminal)
    while not (status := os.waitpid(child, os.WNOHANG))[0]:
        assert time.monotonic() < ended_at, os.kill(child, signal.SIGKILL)
        time.sleep(0.05)
    assert os.waitstatus_to_exitcode(status[1]) == 129
    # Nothing was written after this checkpoint.
    assert checkpoints.read_checkpoint(Path("cut.chk"))[1].step >= log("cut.csv")["Step"][-1]


# --- what OpenMM's wrappers make of a signal ---


def test_ctrl_c_within_openmm_ends_every_command(box, monkeypatch, capsys):
    def interrupted(*_):
        raise SystemError("<method> returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(info, "execute", interrupted)
    assert main.main(["info", str(box)]) == 130
    assert capsys.readouterr().err == "openmm-sier: interrupted\n"
