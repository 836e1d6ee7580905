"""Restarts stay on the platform of their checkpoint."""

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


def test_a_restart_finds_the_coordinates_by_its_checkpoint(begun, box, part, capsys):
    shutil.copy(box, ".")
    rewrite_notes(part, lambda notes: notes["plan"].update(box=box.name))
    run("run", "--restart", part, "--steps", 20)
    assert part.with_suffix(".dcd").read_bytes() == (begun / "whole.dcd").read_bytes()
    assert "expected BOX" in complaint(capsys, "run", "--steps", "2", code=MISUSED)


def test_a_restart_stays_on_the_platform_of_its_checkpoint(box, part, capsys):
    run("run", box, "--restart", part, "--steps", 11, "--platform", "CPU")
    assert "on the CPU platform" in capsys.readouterr().out
    run("run", box, "--restart", part, "--steps", 12)
    assert "on the CPU platform" in capsys.readouterr().out


def test_a_platform_that_is_not_here_must_be_replaced_by_name(box, part, capsys):
    rewrite_notes(part, lambda notes: notes.update(platform={"Platform": "Abacus"}))
    message = complaint(capsys, "run", box, "--restart", part, "--steps", 11, code=MISUSED)
    assert "argument --platform: expected one of those that OpenMM has here, Reference" in message
    assert "got Abacus" in message
    run("run", box, "--restart", part, "--steps", 11, "--platform", "Reference")
