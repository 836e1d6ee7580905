"""Calls of the command line in tests: small boxes, output files and error messages."""

import importlib.util
import json
import os
import sys
import time
import zipfile
from pathlib import Path

import mdtraj
import pytest

from openmm_sier.analysis import read_log
from openmm_sier.cli import main
from studies.boxes import write_lattice as write_lattice

SYSTEMS = Path(__file__).parents[2] / "systems"

#: Options of a short run with the cheapest scheme.
SHORT = ["--scheme", "sier2", "--dt", "4", "--platform", "Reference", "--equilibrate", "0.1"]
SHORT += ["--every", "0.02", "--checkpoint-every", "0.1"]

#: The same with a mesh on which the Reference platform computes forces four times as fast as on the usual one.
SMALL = [*SHORT, "--tolerance", "1e-3"]


def load_program(path):
    """A program of the project as a module."""
    path = SYSTEMS.parent / path
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


#: The program that makes the boxes of the project.
make = load_program("systems/make.py")


def frames(path, box):
    return mdtraj.load(str(path), top=str(box))


def log(path):
    return read_log(path)


def complaint(capsys, *arguments, code=1):
    """The one line on standard error with which a command line fails."""
    assert main.main([str(argument) for argument in arguments]) == code
    # Lines about progress come from slow machines.
    errors = capsys.readouterr().err.splitlines(keepends=True)
    err = "".join(line for line in errors if not line.endswith(" left\n"))
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert err.startswith("openmm-sier")
    return err


def run(*arguments):
    assert main.main([str(argument) for argument in arguments]) == 0


def wait_for(condition, process, limit=120.0):
    """Wait until a condition is true while a process runs, at most `limit` s."""
    end = time.monotonic() + limit
    while not condition():
        assert process.poll() is None, "the command ended by itself"
        if time.monotonic() > end:
            process.kill()
            pytest.fail(f"the command did not come so far in {limit:g} s")
        time.sleep(0.02)


def contents(directory):
    """All files below a directory with their bytes, links as where they lead."""
    return {
        str(path.relative_to(directory)): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in sorted(Path(directory).rglob("*"))
        if path.is_symlink() or path.is_file()
    }


def rewrite_notes(checkpoint, change):
    """Replace the notes in a checkpoint by the result of a function of them."""
    with zipfile.ZipFile(checkpoint) as archive:
        state, notes = archive.read("state.xml"), json.loads(archive.read("notes.json"))
    change(notes)
    with zipfile.ZipFile(checkpoint, "w") as archive:
        archive.writestr("state.xml", state)
        archive.writestr("notes.json", json.dumps(notes))
