"""The loops, made short."""

import pytest

from tests.loops import two_commands
from tests.loops.kill_loop import LoopSettings, kill_loop
from tests.loops.two_commands import TwoSettings


@pytest.mark.slow
def test_killed_at_random_moments_again_and_again(tmp_path):
    """What the command does fifty times: not a bit may differ from a run that nothing disturbed."""
    met = kill_loop(LoopSettings(out=tmp_path, kills=3, signals=("KILL", "TERM")))
    assert (met["kills by SIGKILL"], met["kills by SIGTERM"]) == (2, 1)
    assert met["steps"] >= 30


@pytest.mark.slow
def test_one_command_line_goes_on_after_every_kill(tmp_path):
    """Four kills, so that one comes early, before there is a checkpoint or while the command reads it."""
    met = kill_loop(LoopSettings(out=tmp_path, kills=4, signals=("KILL", "TERM"), suffix=".xtc", resume=True))
    assert met["steps"] >= 30


def test_pairs_of_commands_are_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"unknown pair 'run,walk'; known are run,run, run,restart"):
        two_commands.study(TwoSettings(pairs=("run,walk",), out=tmp_path))
