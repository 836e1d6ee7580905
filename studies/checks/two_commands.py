"""Two commands on one output, started at random distances: one must be refused in one line, and disturb nothing.

    python -m studies.checks.two_commands [--times 100] [--pairs run,restart ensemble,run] [--seed 1]

The files of the command that goes on must be those of one that was alone, byte for byte, and nothing else may be left.
A second command that comes when the first has ended finds its files, or begins anew with --overwrite. In one of four
collisions the first command is killed after the second has been refused, and started once more. The status is 1 if
anything differs.
"""

from __future__ import annotations

import importlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import pandas as pd

from openmm_sier.cli import main as command_line
from openmm_sier.cli import run as _imported_before_the_fork  # noqa: F401
from openmm_sier.cli.member import CHECKPOINT
from studies import records
from studies.boxes import write_lattice
from studies.command import Settings, chosen, command
from studies.records import Record
from studies.report import SILENT, Report

COMMANDS = ("run", "restart", "ensemble")

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

#: The member of the ensemble, whose files all three commands write.
MEMBER = "members-of/seed1"

#: Seconds in which a command has to end.
PATIENCE = 120.0


#: Pairs by the names that users give.
PAIRS = {f"{first},{second}": (first, second) for first, second in product(COMMANDS, COMMANDS)}

#: How the two commands of a collision met.
MEETINGS = ("second refused", "first refused", "second came after the first", "first killed")

COLUMNS = {"pair": "{pair}", "started": "{times}", **{name: f"{{{name}}}" for name in MEETINGS}}


class Disturbed(ValueError):
    """Two commands wrote into one file, or both were refused."""


class Command:
    """One of the three commands, in a process that is forked, since the imports would take most of the time."""

    def __init__(self, kind: str, place: Path, steps: int = STEPS):
        self._said = tempfile.TemporaryFile()  # noqa: SIM115
        self.code: int | None = None
        self._process = os.fork()
        if self._process == 0:
            code = 70
            try:
                os.chdir(place)
                with open(os.devnull, "w") as null:
                    os.dup2(null.fileno(), 1)
                os.dup2(self._said.fileno(), 2)
                # Whoever calls this may have put something else there.
                sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
                sys.argv = ["openmm-sier", *arguments(kind, steps)]
                code = command_line.main(sys.argv[1:])
            finally:
                sys.stderr.flush()
                os._exit(code)

    def ended(self) -> bool:
        if self.code is None:
            found, status = os.waitpid(self._process, os.WNOHANG)
            self.code = os.waitstatus_to_exitcode(status) if found else None
        return self.code is not None

    def wait(self) -> int | None:
        end = time.monotonic() + PATIENCE
        while not self.ended():
            if time.monotonic() > end:
                self.kill()
                raise Disturbed(f"a command did not end in {PATIENCE:g} s")
            time.sleep(0.01)
        return self.code

    def kill(self) -> None:
        os.kill(self._process, signal.SIGKILL)
        while not self.ended():
            time.sleep(0.01)

    def said(self) -> str:
        self._said.seek(0)
        return self._said.read().decode()


def arguments(kind: str, steps: int) -> list[str]:
    """The command line of a command."""
    if kind == "ensemble":
        return ["ensemble", "members-of.toml", "--processes", "1"]
    if kind == "restart":
        checkpoint = f"{MEMBER}/{CHECKPOINT}"
        return ["run", "box.pdb", "--platform", "Reference", "--restart", checkpoint, "--steps", str(steps)]
    given = OPTIONS | {"steps": steps}
    options = [text for key, value in given.items() for text in (f"--{key.replace('_', '-')}", str(value))]
    return ["run", "box.pdb", *options, "--overwrite", "--out", f"{MEMBER}/run.dcd"]


def alone(kind: str, place: Path, steps: int = STEPS) -> None:
    """Carry out a command that nothing disturbs."""
    command = Command(kind, place, steps)
    if command.wait():
        raise Disturbed(f"{kind} alone failed: {command.said()}")


def again(kind: str, place: Path) -> None:
    """Carry out a killed command once more. A restart that was killed after its last step finds nothing left to do."""
    command = Command(kind, place)
    if command.wait() and not (kind == "restart" and f"is at step {STEPS} " in command.said()):
        raise Disturbed(f"{kind} after it was killed failed: {command.said()}")


def prepare(directory: Path, restart: bool) -> None:
    """Write what commands start from: the box, the plan and, for a restart, the files of half a run."""
    directory.mkdir()
    write_lattice(directory / "box.pdb", 8)
    lines = [f"{key} = {value!r}".replace("'", '"') for key, value in OPTIONS.items()]
    plan = ["[options]", *lines, 'box = "box.pdb"', "[members]", "seed = [1]", ""]
    (directory / "members-of.toml").write_text("\n".join(plan))
    (directory / MEMBER).mkdir(parents=True)
    if restart:
        alone("run", directory, HALF)


def results(directory: Path) -> dict[str, bytes]:
    """The files of the run. Checkpoints are left out, since they note the path of the box."""
    place = directory / MEMBER
    return {path.name: path.read_bytes() for path in sorted(place.glob("run.*")) if path.name != CHECKPOINT}


def collide(directory: Path, first: str, second: str, times: int, seed: int) -> Counter[str]:
    """Start two commands again and again.

    Args:
        directory: where the files go.
        first, second: what is started, of `COMMANDS`.
        times: how often.
        seed: of the distances.

    Returns:
        How often they met in each of the ways of `MEETINGS`.

    Raises:
        Disturbed: something differs from an undisturbed run.
    """
    restart = "restart" in (first, second)
    with suppress(ImportError):
        # Each command would import it anew after the fork, which takes longer than its run.
        importlib.import_module("numba")
    start, undisturbed, here = directory / "start", directory / "undisturbed", directory / "here"
    prepare(start, restart)
    shutil.copytree(start, undisturbed)
    begun = time.monotonic()
    alone("restart" if restart else first, undisturbed)
    # The second command comes while the first is running, or shortly after it.
    latest = 1.2 * (time.monotonic() - begun)
    expected, chance = results(undisturbed), random.Random(seed)
    met: Counter[str] = Counter()
    for number in range(times):
        shutil.copytree(start, here)
        one = Command(first, here)
        time.sleep(chance.uniform(0, latest))
        two = Command(second, here)
        two.wait()
        if two.code == 1 and number % 4 == 3 and not one.ended():
            one.kill()
            met["first killed"] += 1
            again(first, here)
        elif one.wait() and two.code:
            raise Disturbed(f"both {first} and {second} failed: {one.said()}{two.said()}")
        met[_ending(one, two)] += 1
        _compare(here, expected)
        shutil.rmtree(here)
    return met


def _ending(one: Command, two: Command) -> str:
    refused = two if two.code == 1 else one
    if refused.code == 1:
        said = [line for line in refused.said().splitlines() if line.startswith("openmm-sier: ")]
        if len(said) != 1 or "is being written by process" not in said[0]:
            raise Disturbed(f"a refused command said: {refused.said()}")
        return "second refused" if refused is two else "first refused"
    return "second came after the first"


def _compare(place: Path, expected: dict[str, bytes]) -> None:
    found = results(place)
    if found != expected:
        different = [name for name in {*found, *expected} if found.get(name) != expected.get(name)]
        raise Disturbed(f"{', '.join(different)} in {place} are not those of an undisturbed run")
    if left := sorted(path.name for path in place.rglob(".*.lock")):
        raise Disturbed(f"{', '.join(left)} stayed behind in {place}")


@dataclass(frozen=True)
class TwoSettings(Settings):
    """What is started, and how often.

    Attributes:
        times: how often each pair is started.
        pairs: of commands; all nine unless given.
    """

    times: int = 100
    pairs: tuple[str, ...] = ()


def study(settings: TwoSettings, report: Report = SILENT) -> Record:
    """Start all pairs in directories that are removed, and write two-commands.json.

    Raises:
        Disturbed: something differs from an undisturbed run.
        ValueError: there is no such pair.
    """
    rows = []
    for first, second in chosen(settings.pairs, PAIRS, "pair"):
        try:
            with tempfile.TemporaryDirectory() as directory:
                met = collide(Path(directory), first, second, settings.times, settings.seed)
        except Disturbed as error:
            raise Disturbed(f"{first}, {second}: {error}") from error
        rows.append({"pair": f"{first}, {second}", "times": settings.times, **{name: met[name] for name in MEETINGS}})
        report.note(f"{first}, {second}: {', '.join(f'{count} {what}' for what, count in met.items())}")
    found = pd.DataFrame(rows)
    report.table(records.table("Two commands on one output", found, COLUMNS))
    return Record(settings.recorded(), {"rows": found}, {}).write(settings.out / "two-commands.json")


main = command(TwoSettings, study, __doc__, __name__)
