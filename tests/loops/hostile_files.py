"""Damaged and crafted files: a command answers each in a line, executes nothing, and loses nothing.

    python -m tests.loops.hostile_files [--minutes 60] [--seed 1]

Hypothesis changes one file of a small run and calls a command that reads it, in this process. The file that is being
tried lies in the directory `--out` until the next one, also after a crash of the process.
"""

from __future__ import annotations

import copy
import io
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import openmm
from cyclopts import App
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

from openmm_sier.cli import main
from openmm_sier.inputs.inputs import read_input
from studies.boxes import write_lattice

#: Of the small run, and of each command that goes on with it.
STEPS, LATER = 10, 12

#: Seconds after which a command is said to hang. The slowest takes a tenth of that on a busy machine.
LONGEST = 60

#: A file that what is executed makes, in the directory of the run.
MARKER = "executed"

#: Exit codes of the command, without those of signals.
EXIT_CODES = range(5)

SCRIPT = f"<ForceField><Script>open({MARKER!r}, 'w')</Script></ForceField>"

#: What stands beside the files of the run, in its directory and outside it.
BYSTANDERS = {
    "thesis.tex": r"\documentclass{book}",
    "photo.dcd": "a photo, in spite of its name",
    "field.xml": SCRIPT,
    "../elsewhere/field.xml": SCRIPT,
    "../elsewhere/letter.txt": "Dear all,",
}

#: Values in place of those of a file.
VALUES = [None, True, False, -1, 0, 1, 1.5, 2**63, 10**400, float("nan"), float("inf"), "", "x", "1", "\x1b[31mred"]
VALUES += ["../elsewhere/letter.txt", "thesis.tex", "photo.dcd", "field.xml", "../elsewhere/field.xml", "evil.xml"]
VALUES += [[], {}, [[1]], {"size": 0}, "nvt", "hmc", "sier4g", "\u202ered", "a" * 5000]

#: Bytes in place of, or between, those of a file.
BYTES = [b"nan", b"-1", b"1e308", b"0", b"99999999999999", b"\x1b[31m", b"\xff", b"\x00", b"\n", b",", b"<", b'"']
BYTES += [b"<!DOCTYPE s [<!ENTITY a 'b'>]>", b"\xef\xbb\xbf", b"CONECT    1    2\n", b"TER\n", b"ENDMDL\n"]

NUMBER = re.compile(rb"-?\d+\.?\d*")


class Unsafe(AssertionError):
    """Forbidden behaviour of a command with a file."""


class Hangs(BaseException):
    """A command takes too long; no `except Exception` of the command stops this one."""


class Code:
    """A computation of a PythonForce that leaves a marker where it is unpickled."""

    def __call__(self, state: openmm.State) -> tuple[float, None]:
        return 0.0, None

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (MARKER, "w")


class Case(NamedTuple):
    """A file that is changed, and the command that reads it.

    Attributes:
        name: of the file.
        content: its bytes.
        arguments: of the command.
    """

    name: str
    content: bytes
    arguments: list[str]


#: The settings of the run of `make_run` in TOML.
SETTINGS = f"""\
box = "box.pdb"
out = "run.dcd"
scheme = "sier2"
dt = 2.0
platform = "Reference"
equilibrate = 0.0
steps = {STEPS}
every = 0.008
report_every = 0.008
checkpoint_every = 0.02
"""


@contextmanager
def working_in(directory: Path) -> Iterator[None]:
    """Make a directory the current one; `contextlib.chdir` came with Python 3.11."""
    earlier = os.getcwd()
    os.chdir(directory)
    try:
        yield
    finally:
        os.chdir(earlier)


def make_run(directory: Path) -> None:
    """Write a small run, its System, its State and its settings into a directory, with bystanders."""
    for name, text in BYSTANDERS.items():
        place = directory / name
        place.parent.mkdir(exist_ok=True)
        place.write_text(text)
    with working_in(directory):
        box = write_lattice(Path("box.pdb"), molecules=8)
        steps = f"--steps {STEPS} --every 0.008 --report-every 0.008 --checkpoint-every 0.02"
        options = f"--scheme sier2 --dt 2 --platform Reference --equilibrate 0 {steps}"
        if main.main(["run", str(box), "--out", "run.dcd", *options.split()]):
            raise ValueError("the run of the test failed")
        Path("run.toml").write_text(SETTINGS)
        system = read_input(box).system
        Path("system.xml").write_text(openmm.XmlSerializer.serialize(system))
        with zipfile.ZipFile("run.chk") as archive:
            Path("state.xml").write_bytes(archive.read("state.xml"))
        evil = openmm.XmlSerializer.clone(system)
        evil.addForce(openmm.PythonForce(Code()))
        Path("evil.xml").write_text(openmm.XmlSerializer.serialize(evil))


def changed_bytes(content: bytes) -> st.SearchStrategy[bytes]:
    """Return damaged copies of bytes: cut, doubled, with others in between, or with another number."""

    def splice(begin: int, length: int, between: bytes) -> bytes:
        return content[:begin] + between + content[begin + length :]

    def double(begin: int, length: int) -> bytes:
        return content[: begin + length] + content[begin:]

    place = st.integers(0, len(content))
    length = st.integers(0, 200)
    strategies = [
        st.builds(
            splice, place, length | st.just(len(content)), st.sampled_from([b"", *BYTES]) | st.binary(max_size=8)
        ),
        st.builds(double, place, length),
    ]
    numbers = [match.span() for match in NUMBER.finditer(content)]
    if numbers:
        span = st.sampled_from(numbers)
        strategies.append(st.builds(lambda at, new: splice(at[0], at[1] - at[0], new), span, st.sampled_from(BYTES)))
    return st.one_of(strategies)


def places_in(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path to each value of what JSON holds."""
    if path:
        yield path
    if isinstance(value, dict):
        for key, item in value.items():
            yield from places_in(item, (*path, key))


def changed_notes(content: bytes) -> st.SearchStrategy[bytes]:
    """Return notes with one to three values that are others or missing."""
    notes = json.loads(content)
    change = st.tuples(st.sampled_from(list(places_in(notes))), st.sampled_from(VALUES), st.integers(0, 9))

    def build(changes: list[tuple[tuple[Any, ...], Any, int]]) -> bytes:
        copied = copy.deepcopy(notes)
        for path, value, kind in changes:
            holder = copied
            for key in path[:-1]:
                holder = holder.get(key, {}) if isinstance(holder, dict) else {}
            if not isinstance(holder, dict):
                continue
            if kind:
                holder[path[-1]] = value
            else:
                holder.pop(path[-1], None)
        return json.dumps(copied).encode()

    return st.lists(change, min_size=1, max_size=3).map(build)


def changed_xml(content: bytes, evil: bytes) -> st.SearchStrategy[bytes]:
    """Return XML in which an element has another attribute, another name, no place, or code within it."""
    code = ElementTree.fromstring(evil).find(".//Force[@type='PythonForce']")
    tree = ElementTree.fromstring(content)
    size = sum(1 for _ in tree.iter())
    names = sorted({name for element in tree.iter() for name in element.attrib} | {"type", "version"})
    tags = sorted({element.tag for element in tree.iter()} | {"Force", "System", "State", "Integrator"})
    values = st.sampled_from(["System", "State", "PythonForce", "CustomIntegrator", "nan", "-1", "0", "1e308", "x", ""])

    def build(number: int, kind: str, name: str, tag: str, value: str) -> bytes:
        copied = copy.deepcopy(tree)
        element = list(copied.iter())[number]
        if kind == "attribute":
            element.set(name, value)
        elif kind == "name":
            element.tag = tag
        elif kind == "code":
            element.append(copy.deepcopy(code))
        elif kind == "type":
            copied.set("type", value)
        else:
            element.clear()
        return ElementTree.tostring(copied)

    kinds = st.sampled_from(["attribute", "name", "code", "type", "clear"])
    # The first elements are those of which each has its own meaning; most others are particles.
    number = st.integers(0, min(size - 1, 30)) | st.integers(0, size - 1)
    return st.builds(build, number, kinds, st.sampled_from(names), st.sampled_from(tags), values)


def changed_state(content: bytes, evil: bytes) -> st.SearchStrategy[bytes]:
    """Return other States, and Systems with code in place of them, under the tag of a State too."""
    disguised = ElementTree.fromstring(evil)
    disguised.tag = "State"
    crafted = st.sampled_from([evil, ElementTree.tostring(disguised), b"", b"<State/>"])
    return st.one_of(changed_xml(content, evil), changed_bytes(content), crafted)


def changed_checkpoint(content: bytes, evil: bytes) -> st.SearchStrategy[bytes]:
    """Return checkpoints with other notes, another State, a System in place of it, or damaged bytes."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}

    def with_member(changed: str, content: bytes) -> bytes:
        result = io.BytesIO()
        with zipfile.ZipFile(result, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, member in members.items():
                archive.writestr(name, content if name == changed else member)
        return result.getvalue()

    notes, state = members["notes.json"], members["state.xml"]
    return st.one_of(
        st.builds(with_member, st.just("notes.json"), changed_notes(notes) | changed_bytes(notes)),
        st.builds(with_member, st.just("state.xml"), changed_state(state, evil)),
        changed_bytes(content),
    )


def cases(directory: Path) -> st.SearchStrategy[Case]:
    """Return changed files of a run, each with a command that reads it."""
    files = {path.name: path.read_bytes() for path in directory.iterdir() if path.is_file()}
    evil = files["evil.xml"]
    short = f"--steps {STEPS} --equilibrate 0 --dt 2 --scheme sier2 --platform Reference --every 0.02".split()
    # Steps are given, since a changed number of them may last for days.
    resumed = ["run", "--restart", "run.chk", "--steps", str(LATER)]
    begun = ["run", "--out", "new.dcd", "--report", "new.csv", *short]
    summary = ["summary", "run.csv", "--json", "numbers.json"]
    readers = {
        "run.chk": (
            changed_checkpoint(files["run.chk"], evil),
            [resumed, [*begun, "--start", "run.chk"], summary, ["run", "box.pdb", "--out", "run.dcd", "--resume"]],
        ),
        "run.csv": (changed_bytes(files["run.csv"]), [summary, resumed]),
        "run.dcd": (changed_bytes(files["run.dcd"]), [resumed]),
        "box.pdb": (changed_bytes(files["box.pdb"]), [["info", "box.pdb"], [*begun, "box.pdb"]]),
        "run.toml": (changed_bytes(files["run.toml"]), [[*begun, "--config", "run.toml"]]),
        "system.xml": (
            changed_xml(files["system.xml"], evil) | changed_bytes(files["system.xml"]),
            [["info", "box.pdb", "--topology", "system.xml"], [*begun, "box.pdb", "--topology", "system.xml"]],
        ),
        "state.xml": (
            changed_state(files["state.xml"], evil),
            [["info", "state.xml", "--topology", "system.xml"]],
        ),
    }
    return st.one_of(
        [
            st.builds(Case, st.just(name), contents, st.sampled_from(commands))
            for name, (contents, commands) in readers.items()
        ]
    )


def contents(directory: Path) -> dict[str, bytes]:
    """Return all files in a directory and in the one beside it, by their names."""
    places = [*directory.iterdir(), *(directory.parent / "elsewhere").iterdir()]
    return {os.path.relpath(path, directory): path.read_bytes() for path in places if path.is_file()}


@contextmanager
def limit(seconds: int) -> Iterator[None]:
    """Raise `Hangs` in what takes longer."""

    def stop(*_: Any) -> None:
        raise Hangs(f"not done after {seconds} s")

    earlier = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, earlier)


def check(case: Case, originals: Path, directory: Path) -> int:
    """Carry out a command with its changed file, and return its exit code.

    Raises:
        Unsafe: it executed code, failed without a clear line, or changed files that are not its own.
    """
    shutil.rmtree(directory.parent, ignore_errors=True)
    shutil.copytree(originals.parent, directory.parent)
    (directory / case.name).write_bytes(case.content)
    before = contents(directory)
    out = io.StringIO()
    err = io.StringIO()
    with working_in(directory), redirect_stdout(out), redirect_stderr(err), limit(LONGEST):
        code = main.main(list(case.arguments))
    _check_words(code, out.getvalue(), err.getvalue())
    _check_files(case, before, contents(directory))
    return code


def _check_words(code: int, out: str, err: str) -> None:
    if code not in EXIT_CODES:
        raise Unsafe(f"exit code {code}")
    if code and not (err.splitlines() or [""])[-1].startswith("openmm-sier: "):
        raise Unsafe(f"no message: {err!r}")
    if "--debug shows where" in err or "Traceback" in err:
        raise Unsafe(f"an error that nobody expected: {err!r}")
    letters = {letter for letter in out + err if letter != "\n" and not letter.isprintable()}
    if letters:
        raise Unsafe(f"control characters {letters} in {out + err!r}")


def _check_files(case: Case, before: dict[str, bytes], after: dict[str, bytes]) -> None:
    if MARKER in after:
        raise Unsafe("code was executed")
    goes_on = case.arguments[0] == "run" and "new.dcd" not in case.arguments
    outputs = {"run.chk", "run.csv", "run.dcd"} if goes_on else set()
    made = {"new.dcd", "new.csv", "new.chk", "numbers.json"}
    if others := after.keys() - before.keys() - made:
        raise Unsafe(f"new files {others}")
    for name, content in before.items():
        if name not in after:
            raise Unsafe(f"{name} is gone")
        if name not in outputs and after[name] != content:
            raise Unsafe(f"{name} was changed")
        # A DCD file counts its frames in the first 48 bytes; a checkpoint is replaced as a whole.
        if name != case.name and name != "run.chk" and not after[name][48:].startswith(content[48:]):
            raise Unsafe(f"{name} was shortened")


def search(out: Path, examples: int, seed: int | None = None) -> dict[str, int]:
    """Try so many files.

    Args:
        out: directory for the files.
        examples: their number.
        seed: of the search; None for the same files in every call.

    Returns:
        How many files of each kind led to each exit code.

    Raises:
        Unsafe: see `check`; the file is the simplest one that Hypothesis found.
    """
    originals = out / "originals" / "run"
    shutil.rmtree(originals.parent, ignore_errors=True)
    originals.mkdir(parents=True)
    with redirect_stdout(io.StringIO()):
        make_run(originals)
    counts: dict[str, int] = {}

    @settings(
        max_examples=examples,
        deadline=None,
        derandomize=seed is None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )
    @given(cases(originals))
    def try_files(case: Case) -> None:
        code = check(case, originals, out / "tried" / "run")
        name = f"{case.name}, exit {code}"
        counts[name] = counts.get(name, 0) + 1

    (try_files if seed is None else seeded(seed)(try_files))()
    return counts


app = App(help=__doc__)


@app.default
def loop(minutes: float = 60, seed: int = 1, out: Path | None = None) -> None:
    """Search with one seed after the other, until the time is over."""
    end = time.monotonic() + 60 * minutes
    place = out or Path(tempfile.mkdtemp())
    total: dict[str, int] = {}
    while time.monotonic() < end:
        for name, number in search(place, 500, seed).items():
            total[name] = total.get(name, 0) + number
        print(f"seed {seed}: {sum(total.values())} files", dict(sorted(total.items())), flush=True)
        seed += 1


if __name__ == "__main__":
    sys.exit(app())
