"""Long checks, made short."""

from __future__ import annotations

import pytest

from studies.checks.kill_loop import kill_loop


@pytest.mark.slow
def test_killed_at_random_moments_again_and_again(tmp_path):
    """What the study does fifty times: not a bit may differ from a run that nothing disturbed."""
    met = kill_loop(tmp_path, ".dcd", kills=3, signals=("KILL", "TERM"))
    assert (met["by SIGKILL"], met["by SIGTERM"]) == (2, 1)
    assert met["steps"] >= 30
    assert met["frames"] == met["steps"] // 4
