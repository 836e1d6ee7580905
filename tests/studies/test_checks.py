"""Long checks, made short."""

from __future__ import annotations

import pytest

from studies.checks import two_commands
from studies.checks.kill_loop import kill_loop
from studies.checks.two_commands import TwoSettings


@pytest.mark.slow
def test_killed_at_random_moments_again_and_again(tmp_path):
    """What the study does fifty times: not a bit may differ from a run that nothing disturbed."""
    met = kill_loop(tmp_path, ".dcd", kills=3, signals=("KILL", "TERM"))
    assert (met["by SIGKILL"], met["by SIGTERM"]) == (2, 1)
    assert met["steps"] >= 30
    assert met["frames"] == met["steps"] // 4


def test_pairs_of_commands_are_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"unknown pair 'run,walk'; known are run,run, run,restart"):
        two_commands.study(TwoSettings(pairs=("run,walk",), out=tmp_path))
