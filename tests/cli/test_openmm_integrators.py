"""`openmm-sier run` with OpenMM's own integrators: the same files, the same restarts, the same start."""

from pathlib import Path

import openmm
import pytest

from openmm_sier.observe import openmm_integrators
from openmm_sier.stability.runaway import RunawayError
from tests.support.commands import complaint, log, run

FAST = ["--dt", "2", "--platform", "Reference", "--equilibrate", "0.01", "--seed", "7"]
FAST += ["--every", "0.02", "--report-every", "0.02", "--checkpoint-every", "0.06"]


def test_runs_that_start_from_each_other_have_the_same_motion(box):
    """Verlet's velocities are half a step behind: without the half step the energy would jump by some per cent."""
    run("run", box, "--scheme", "sier2", *FAST, "--time", "0.04", "--out", "ours.dcd")
    chosen = [*FAST[2:4], *FAST[8:], "--time", "0.04"]
    run("run", box, "--scheme", "verlet", "--dt", "2", *chosen, "--start", "ours.chk", "--out", "verlet.dcd")
    run("run", box, "--scheme", "sier2", "--dt", "2", *chosen, "--start", "verlet.chk", "--out", "again.dcd")
    for before, after in (("ours.csv", "verlet.csv"), ("verlet.csv", "again.csv")):
        one, two = log(before), log(after)
        for name in ("Kinetic Energy (kJ/mole)", "Rotational Temperature (K)"):
            # SETTLE places atoms within 1e-8 nm; velocities follow to the tolerance of constraints, 1e-7.
            assert two[name][0] == pytest.approx(one[name][-1], rel=1e-5)


def test_what_they_cannot_do_is_refused(box, capsys):
    message = complaint(capsys, "run", box, "--scheme", "langevinmiddle", "--ensemble", "nve", code=2)
    assert "OpenMM LangevinMiddle supports the ensembles nvt, npt, got nve" in message
    message = complaint(capsys, "run", box, "--scheme", "verlet", "--ensemble", "hmc", code=2)
    assert "OpenMM Verlet supports the ensembles nve, nvt, npt, got hmc" in message
    message = complaint(capsys, "run", box, "--scheme", "verlet", "--rigid", "HOH", code=2)
    assert "--rigid HOH needs a scheme of this package" in message
    seldom = ["--scheme", "verlet", "--ensemble", "npt", "--checkpoint-every", "0.02"]
    message = complaint(capsys, "run", box, *seldom, *FAST[:4], *FAST[4:6], code=2)
    assert "--checkpoint-every 0.02 is too short" in message
    assert not list(Path().glob("*.csv"))


@pytest.mark.parametrize("error", [RunawayError("too hot"), openmm.OpenMMException("Particle coordinate is NaN")])
def test_a_step_that_is_too_long_is_reported(box, capsys, monkeypatch, error):
    """The first step ends too hot, or with positions that OpenMM finds to be not finite."""

    def fails(*_):
        raise error

    monkeypatch.setattr(openmm_integrators.OpenMMIntegrator, "step", fails)
    chosen = ["--scheme", "langevinmiddle", "--dt", "60", "--time", "60", "--equilibrate", "0", *FAST[2:4]]
    message = complaint(capsys, "run", box, *chosen, code=3)
    assert (
        f"became unstable at step 0 (0 ps): {error}; the step of 60 fs is too long for OpenMM LangevinMiddle" in message
    )
    assert "for which 2 fs is usual: --dt 2" in message
