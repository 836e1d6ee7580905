"""Long checks, made short."""

import pytest

from openmm_sier import SIER4G
from studies.checks import net_force, reversal, two_commands
from studies.checks.kill_loop import LoopSettings, kill_loop
from studies.checks.two_commands import TwoSettings


@pytest.mark.slow
def test_killed_at_random_moments_again_and_again(tmp_path):
    """What the study does fifty times: not a bit may differ from a run that nothing disturbed."""
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


@pytest.mark.slow
def test_the_net_force_grows_where_pme_is_balanced():
    """Threefold and more over 20 states; one state scatters by a third about that mean."""
    split, balanced = (net_force.net_force("spce-512.pdb", 5e-4, done, states=1) for done in (False, True))
    assert balanced > 1.5 * split > 0


@pytest.mark.slow
def test_trajectories_come_back_unless_chaos_has_its_time():
    """The rounding of forces leaves some 1e-7 nm after 60 fs; 1e-5 is a tenth of what is accepted."""
    distance, unit = reversal.missed(SIER4G, 10, 6.0).split()
    assert unit == "nm"
    assert float(distance) < 1e-5
    assert "missed its start by" in reversal.missed(SIER4G, 100, 6.0)
