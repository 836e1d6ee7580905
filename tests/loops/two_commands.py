"""Two commands on one output, started at random distances: one must be refused in one line, and disturb nothing.

    python -m tests.loops.two_commands [--times 100] [--pairs run,restart restart,run] [--seed 1]

The files of the command that goes on must be those of one that was alone, byte for byte, and nothing else may be left.
A second command that comes when the first has ended finds its files, or begins anew with --overwrite. The status is 1
if anything differs.
"""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from studies.boxes import write_lattice
from studies.command import Settings, chosen, command
from studies.report import SILENT, Report

#: Names of the files of a run.
TRAJECTORY, CHECKPOINT = "run.dcd", "run.chk"

#: Steps of a run, of which `HALF` are done where a restart begins.
STEPS, HALF = 60, 20

#: Options that make a run short, with a frame and a row every few steps.
OPTIONS = {
    "scheme": "sier2",
    "dt": 1,
    "ensemble": "nvt",
    "platform": "Reference",
    "equilibrate": 0.005,
    "every": 0.004,
    "report_every": 0.006,
    "checkpoint_every": 0.01,
    "steps": STEPS,
}

#: Seconds in which a command has to end.
PATIENCE = 120.0

#: Pairs by the names that users give.
PAIRS = {f"{pair[0]},{pair[1]}": pair for pair in product(("run", "restart"), repeat=2)}


class Disturbed(ValueError):
    """Two commands wrote into one file, or both were refused."""


def started(kind: str, place: Path, steps: int = STEPS) -> subprocess.Popen[str]:
    """One of the two commands in a process of its own."""
    if kind == "restart":
        options = ["--platform", "Reference", "--restart", CHECKPOINT, "--steps", str(steps)]
    else:
        given = OPTIONS | {"steps": steps, "out": TRAJECTORY}
        options = [text for key, value in given.items() for text in (f"--{key.replace('_', '-')}", str(value))]
        options.append("--overwrite")
    program = [sys.executable, "-m", "openmm_sier.cli", "run", "box.pdb", *options]
    return subprocess.Popen(program, cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """The exit code and the standard error of a command."""
    try:
        output = process.communicate(timeout=PATIENCE)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        raise Disturbed(f"a command did not end in {PATIENCE:g} s") from None
    return process.returncode, output


def alone(kind: str, place: Path, steps: int = STEPS) -> None:
    """Carry out a command that nothing disturbs."""
    code, output = ended(started(kind, place, steps))
    if code:
        raise Disturbed(f"{kind} alone failed: {output}")


def prepare(directory: Path, restart: bool) -> None:
    """Write what commands start from: the box and, for a restart, the files of half a run."""
    write_lattice(directory / "box.pdb", 8)
    if restart:
        alone("run", directory, HALF)


def results(directory: Path) -> dict[str, bytes]:
    """The files of the run, and locks. Checkpoints are left out, since they note the path of the box."""
    paths = sorted(directory.glob("run.*")) + sorted(directory.rglob(".*.lock"))
    return {path.name: path.read_bytes() for path in paths if path.name != CHECKPOINT}


def collide(directory: Path, first: str, second: str, times: int, seed: int) -> Counter[str]:
    """Start two commands again and again in a directory; how often they met in each of the ways of `meeting`.

    Raises:
        Disturbed: something differs from an undisturbed run.
    """
    restart = "restart" in (first, second)
    start, undisturbed, here = directory / "start", directory / "undisturbed", directory / "here"
    start.mkdir()
    prepare(start, restart)
    shutil.copytree(start, undisturbed)
    begun = time.monotonic()
    alone("restart" if restart else first, undisturbed)
    # Imports take most of the time, of both commands alike.
    latest = 0.5 * (time.monotonic() - begun)
    expected, chance = results(undisturbed), random.Random(seed)
    met: Counter[str] = Counter()
    for _ in range(times):
        shutil.copytree(start, here)
        one = started(first, here)
        time.sleep(chance.uniform(0, latest))
        two = started(second, here)
        met[meeting(ended(two), ended(one))] += 1
        result = results(here)
        if different := {name for name in {*result, *expected} if result.get(name) != expected.get(name)}:
            raise Disturbed(f"{', '.join(sorted(different))} in {here} are not those of an undisturbed run")
        shutil.rmtree(here)
    return met


def meeting(two: tuple[int, str], one: tuple[int, str]) -> str:
    """How the second and the first command met, by their exit codes and messages."""
    if one[0] and two[0]:
        raise Disturbed(f"both commands failed: {one[1]}{two[1]}")
    # A restart of a run that is complete has a code of its own.
    refused = [output for code, output in (two, one) if code == 1]
    if not refused:
        return "second came after the first"
    lines = [line for line in refused[0].splitlines() if line.startswith("openmm-sier: ")]
    if len(lines) != 1 or "is being written by another process" not in lines[0]:
        raise Disturbed(f"a refused command said: {refused[0]}")
    return "second refused" if two[0] == 1 else "first refused"


@dataclass(frozen=True, kw_only=True)
class TwoSettings(Settings):
    """Pairs of commands, and the number of starts.

    Attributes:
        times: how often each pair is started.
        pairs: of commands; all four unless given.
    """

    times: int = 100
    pairs: tuple[str, ...] = ()


def study(settings: TwoSettings, report: Report = SILENT) -> None:
    """Start all pairs in directories that are removed.

    Raises:
        Disturbed: something differs from an undisturbed run.
        ValueError: there is no such pair.
    """
    for first, second in chosen(settings.pairs, PAIRS, "pair"):
        try:
            with tempfile.TemporaryDirectory() as directory:
                met = collide(Path(directory), first, second, settings.times, settings.seed)
        except Disturbed as error:
            raise Disturbed(f"{first}, {second}: {error}") from error
        report.note(f"{first}, {second}: {', '.join(f'{count} {what}' for what, count in met.items())}")


main = command(TwoSettings, study, __doc__, __name__)
