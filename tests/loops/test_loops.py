"""The loops, made short."""

from pathlib import Path

import pytest

from tests.loops import hostile_files, two_commands
from tests.loops.kill_loop import LoopSettings, kill_loop
from tests.loops.two_commands import TwoSettings


@pytest.mark.thorough
def test_one_command_line_continues_after_every_kill(tmp_path):
    """What the loop does fifty times: not a bit may differ from a run that nothing disturbed.

    The fourth kill comes early, before there is a checkpoint or while the command reads it.
    """
    met = kill_loop(LoopSettings(out=tmp_path, kills=4, signals=("KILL", "TERM"), resume=True))
    # One more checkpoint after each of three kills.
    assert met["steps"] >= 30


def test_damaged_and_crafted_files(tmp_path):
    """The same files in every run; `python -m tests.loops.hostile_files` tries others."""
    counts = hostile_files.search(tmp_path, 50)
    assert sum(counts.values()) >= 50
    kinds = {"run.chk", "run.csv", "run.dcd", "run.toml", "box.pdb", "system.xml", "state.xml"}
    assert {name.split(",")[0] for name in counts} == kinds


@pytest.mark.thorough
@pytest.mark.parametrize("wrong", ["executes code", "changes a file", "fails without a message"])
def test_the_search_of_files_finds_wrong_commands(tmp_path, monkeypatch, wrong):
    """The first call makes the run, and the second is the command that does wrong."""
    right = hostile_files.main.main
    calls = []

    def command(arguments):
        calls.append(arguments)
        if len(calls) == 1:
            return right(arguments)
        if wrong == "executes code":
            Path(hostile_files.MARKER).touch()
        elif wrong == "changes a file":
            Path("thesis.tex").write_text("")
        return int(wrong == "fails without a message")

    monkeypatch.setattr(hostile_files.main, "main", command)
    messages = {"executes code": "code was executed", "changes a file": "thesis.tex was changed"}
    with pytest.raises(hostile_files.Unsafe, match=messages.get(wrong, "no message")):
        hostile_files.search(tmp_path, 1)


def test_pairs_of_commands_are_known_ones(tmp_path):
    with pytest.raises(ValueError, match="'run,walk'"):
        two_commands.study(TwoSettings(pairs=("run,walk",), out=tmp_path))
