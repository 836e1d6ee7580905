"""`openmm-sier run` on a small box of water, ended by signals at random moments and continued again and again.

    python -m tests.loops.kill_loop [--kills N] [--signals KILL TERM] [--resume]

At the end the trajectory must have every frame once, in order. Trajectory and log must be those of an undisturbed run,
byte for byte. A signal that can be handled must give its exit code and, after the first step, leave a checkpoint of the
step that the message names. The status is 1 if not.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mdtraj
import numpy as np

from openmm_sier.cli.files import checkpoints
from studies.boxes import write_lattice
from studies.command import Settings, command
from studies.report import SILENT, Report

#: A frame every 4 steps, a row every 6 and a checkpoint every 10, so that many kills come while something is written.
EVERY, ROWS, CHECKPOINTS = 4, 6, 10

#: The command, with signals handled as when a terminal starts it, since background jobs of a script ignore SIGINT.
LAUNCH = """
import signal, sys
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
from openmm_sier.cli.main import main
sys.exit(main())
"""
COMMAND = [sys.executable, "-c", LAUNCH, "run", "box.pdb", "--platform", "Reference"]
PLAN = ["--scheme", "sier2", "--ensemble", "npt", "--dt", "1", "--equilibrate", "0.05"]
PLAN += ["--every", "0.004", "--report-every", "0.006", "--checkpoint-every", "0.01"]

#: Signals by the names that `kill` uses.
SIGNALS: tuple[Literal["KILL", "TERM", "INT", "HUP"], ...] = ("KILL", "TERM", "INT", "HUP")

#: Longest times in seconds to a kill. One kill in `ONE_IN` comes within `EARLY` of the start of the program, all others
#: within `LATE` of the first checkpoint.
EARLY, ONE_IN, LATE = 4.0, 4, 0.4

#: Seconds in which a run has to end after a signal. Steps take a few ms.
PATIENCE = 60.0

#: More steps than any of these runs reaches.
ENDLESS = 100_000_000


class Lost(ValueError):
    """Something did not survive the kills."""


def line_of(directory: Path, out: str, steps: int, resume: bool) -> list[str]:
    """The command that begins a run, or continues from its checkpoint: always the same with `resume`."""
    if resume:
        return [*COMMAND, *PLAN, "--out", out, "--resume", "--steps", str(steps)]
    checkpoint = Path(out).with_suffix(".chk")
    begin = [*PLAN, "--overwrite", "--out", out]
    way = ["--restart", str(checkpoint)] if (directory / checkpoint).exists() else begin
    return [*COMMAND, *way, "--steps", str(steps)]


def killed_at(directory: Path, out: str, rng: np.random.Generator, early: bool, name: str, resume: bool) -> None:
    """Start or continue the endless run and end it by a signal.

    Raises:
        Lost: the run ended by itself, or did not end as the signal demands.
    """
    number = getattr(signal, f"SIG{name}")
    checkpoint = (directory / out).with_suffix(".chk")
    before = _changed(checkpoint)
    with open(directory / "said.txt", "w") as caught:
        process = subprocess.Popen(
            line_of(directory, out, ENDLESS, resume), cwd=directory, stdout=caught, stderr=caught
        )
    while not early and _changed(checkpoint) == before:
        if process.poll() is not None:
            raise Lost(f"the run ended by itself: {(directory / 'caught.txt').read_text()}")
        time.sleep(0.002)
    time.sleep(rng.uniform(0, EARLY if early else LATE))
    process.send_signal(number)
    try:
        code = process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        raise Lost(f"SIG{name} did not end the run within {PATIENCE:g} s") from None
    message = (directory / "said.txt").read_text()
    # A signal that comes before the command handles it ends Python like any program; `main` reports Ctrl-C.
    if number == signal.SIGKILL or (early and (code == -number or "interrupted" in message)):
        return
    if code != 128 + number or f"stopped by SIG{name}" not in message:
        raise Lost(f"SIG{name} ended the run with the code {code}: {message}")
    named = re.search(r"at step (\d+)", message)
    if named and int(named.group(1)) != last_step(directory, out):
        raise Lost(f"the checkpoint is of step {last_step(directory, out)}, but: {message}")


def _changed(path: Path) -> int:
    return path.stat().st_mtime_ns if path.exists() else 0


def last_step(directory: Path, out: str) -> int:
    checkpoint = (directory / out).with_suffix(".chk")
    return checkpoints.read_checkpoint(checkpoint)[1].step if checkpoint.exists() else 0


def finish(directory: Path, out: str, steps: int, resume: bool) -> None:
    """Run to a step undisturbed."""
    line = line_of(directory, out, steps, resume)
    process = subprocess.run(line, cwd=directory, capture_output=True, text=True, check=False)
    if process.returncode:
        raise Lost(f"the run to step {steps} failed: {process.stdout}{process.stderr}")


def compare(directory: Path, one: str, two: str, steps: int) -> None:
    """Check that two runs left the same complete files.

    Raises:
        Lost: naming what differs.
    """
    for name, other in zip(*([each, f"{Path(each).stem}.csv"] for each in (one, two)), strict=True):
        if (directory / name).read_bytes() != (directory / other).read_bytes():
            raise Lost(f"{name} is not {other}")
    frames = mdtraj.load(str(directory / one), top=str(directory / "box.pdb")).n_frames
    rows = (directory / one).with_suffix(".csv").read_bytes().count(b"\n") - 2
    if (frames, rows) != (steps // EVERY, steps // ROWS):
        raise Lost(f"after {steps} steps {one} has {frames} frames and {rows} rows")


@dataclass(frozen=True, kw_only=True)
class LoopSettings(Settings):
    """How often and how a run is killed.

    Attributes:
        kills: how many.
        signals: which take turns.
        resume: whether the command finds its checkpoint by itself.
    """

    kills: int = 50
    signals: tuple[Literal["KILL", "TERM", "INT", "HUP"], ...] = SIGNALS
    resume: bool = False
    out: Path = Path("killed")


def kill_loop(settings: LoopSettings) -> Counter[str]:
    """Kill and continue a run, then compare it with an undisturbed one.

    Returns:
        The number of steps, and of kills by each signal.

    Raises:
        Lost: something did not survive.
    """
    directory, out, whole = settings.out, "killed.dcd", "whole.dcd"
    write_lattice(directory / "box.pdb", 27)
    rng, met = np.random.default_rng(settings.seed), Counter[str]()
    for number in range(settings.kills):
        # Shifted by one in every `ONE_IN` kills, so that early kills meet all signals.
        name = settings.signals[(number + number // ONE_IN) % len(settings.signals)]
        killed_at(directory, out, rng, number % ONE_IN == ONE_IN - 1, name, settings.resume)
        met[f"kills by SIG{name}"] += 1
    met["steps"] = last_step(directory, out) + CHECKPOINTS
    for each in (out, whole):
        finish(directory, each, met["steps"], settings.resume)
    if settings.resume:
        # Once more, where the run is complete.
        finish(directory, out, met["steps"], resume=True)
    compare(directory, out, whole, met["steps"])
    return met


def study(settings: LoopSettings, report: Report = SILENT) -> None:
    """Kill a run in the directory `out`, which is left, and compare."""
    for name, count in kill_loop(settings).items():
        report.note(f"{name}: {count}")
    report.note("every frame and row once, in order, as in the run that nothing disturbed")


main = command(LoopSettings, study, __doc__, __name__)
