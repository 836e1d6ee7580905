"""Restarts stay on the platform of their checkpoint, or say in one line that they do not."""

import shutil
from pathlib import Path

import pytest

from openmm_sier.cli.main import MISUSED
from tests.support.commands import SHORT, complaint, rewrite_notes, run

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def begun(tmp_path_factory, box):
    """Directory of a run on Reference that ended at step 10, and of one that went on to step 20."""
    place = tmp_path_factory.mktemp("begun")
    for name, steps in (("part", 10), ("whole", 20)):
        # A checkpoint at step 10 in both. With a coarser mesh the platforms' energies would differ by 1 kJ/mol.
        options = [*SHORT, "--checkpoint-every", "0.04", "--report-every", "0.008"]
        run("run", box, *options, "--steps", steps, "--out", place / f"{name}.dcd")
    return place


@pytest.fixture
def part(begun, tmp_path, capsys):
    """Checkpoint of the run that ended, with its files, in the current directory."""
    for path in begun.glob("part.*"):
        shutil.copy(path, tmp_path)
    capsys.readouterr()
    return Path("part.chk")


def differences(capsys):
    return [line for line in capsys.readouterr().out.splitlines() if line.startswith("part.chk was written on")]


def test_a_restart_finds_the_coordinates_by_its_checkpoint(begun, box, part, capsys):
    shutil.copy(box, ".")
    rewrite_notes(part, lambda notes: notes["plan"].update(box=box.name))
    run("run", "--restart", part, "--steps", 20)
    assert part.with_suffix(".dcd").read_bytes() == (begun / "whole.dcd").read_bytes()
    assert "run needs BOX, a file of coordinates, or --restart" in complaint(
        capsys, "run", "--steps", "2", code=MISUSED
    )


def test_another_platform_is_reported_in_one_line_and_noted(box, part, capsys):
    run("run", box, "--restart", part, "--steps", 11, "--platform", "CPU")
    (line,) = differences(capsys)
    assert line.startswith("part.chk was written on Reference, and the run continues on CPU (Threads ")
    run("run", box, "--restart", part, "--steps", 12)
    assert differences(capsys) == []


def test_a_platform_that_is_not_here_must_be_replaced_by_name(box, part, capsys):
    rewrite_notes(part, lambda notes: notes.update(platform={"Platform": "Abacus"}))
    message = complaint(capsys, "run", box, "--restart", part, "--steps", 11)
    assert "part.chk was written on the Abacus platform, which OpenMM does not have here: choose one of" in message
    assert "Reference" in message
    run("run", box, "--restart", part, "--steps", 11, "--platform", "Reference")
