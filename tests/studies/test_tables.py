"""Analysis in studies: points with errors, speeds and laws."""

import math

import numpy as np
import pandas as pd
import pytest

from studies import frame, speed, timing, whole_run


def power_law(factor, power):
    rows = [(h, factor * h**power) for h in (0.25, 0.5, 1.0, 2.0)]
    return pd.DataFrame(rows, columns=["fs_per_force", "percent"])


@pytest.mark.parametrize("power", [2, 4])
def test_step_at_a_level_of_a_power_law(power):
    assert speed.step_at(power_law(0.1, power), 0.1 * 0.7**power) == pytest.approx(0.7, rel=1e-12)


def test_median_comes_with_its_standard_error(rng):
    """Of 4000 medians of 50 normal numbers the scatter is known to 1 %; the stated errors' mean is 4 % below it."""
    results = np.array([timing.median_and_error(values) for values in rng.normal(3.0, 0.1, (4000, 50))])
    assert math.isnan(timing.median_and_error(np.array([1.0]))[1])
    assert results[:, 0].mean() == pytest.approx(3.0, abs=0.001)
    assert results[:, 1].mean() == pytest.approx(results[:, 0].std(), rel=0.1)


def test_a_speed_is_simulated_time_over_what_it_took():
    """2 fs in 1 ms of processor time and 2 ms of wall time."""
    times = {"Verlet": [0.002, 0.001], "LangevinMiddle": [0.004, 0.002], "other": [0.004, 0.003]}
    durations = {"Verlet": 2.0, "LangevinMiddle": 8.0, "other": 12.0}
    rounds = {name: np.array(3 * [each]) for name, each in times.items()}
    references = {"over": "Verlet", "over_middle": "LangevinMiddle"}
    reference, _, own = timing.compared(rounds, durations, references, "CPU")
    # 1 fs/ms is 86.4 ns/day.
    assert (reference["ns_per_day"], reference["ns_per_day_processor"]) == pytest.approx((86.4, 172.8))
    assert (own["over"], own["over_middle"]) == pytest.approx((2.0, 1.0))
    assert (own["microseconds"], own["over_error"]) == pytest.approx((3000, 0))
    assert timing.compared(rounds, durations, references, "CUDA")[2]["over"] == pytest.approx(3.0)


def test_points_are_means_over_starts_with_their_errors():
    """One start has no error, and where one broke down there is no mean."""
    runs = pd.DataFrame({"percent": [0.9, 1.1], "broken": ["", ""]})
    row = frame.over_starts(runs, ["percent"])
    # The standard error of two values is half their difference.
    assert (row["starts"], row["percent"], row["percent_error"]) == pytest.approx((2, 1.0, 0.1))
    assert math.isnan(frame.over_starts(runs[:1], ["percent"])["percent_error"])
    broken = frame.over_starts(pd.DataFrame({"percent": [1.0, math.nan], "broken": ["", "hot"]}), ["percent"])
    assert math.isnan(broken["percent"])
    assert broken["broken"] == "hot"


def test_speed_at_an_error_is_that_of_the_step_that_has_it(monkeypatch):
    """Second order, 0.04 % and 0.01 % at 1 fs: 0.1 % at 1.58 and 3.16 fs, the second at the same cost of a force."""
    monkeypatch.setattr(speed, "LEVELS", (0.1,))
    methods = {"OpenMM Verlet": 0.04, "SIER2": 0.01}
    points = pd.DataFrame(
        [
            {"method": method, "seed": seed, "fs_per_force": dt, "percent": factor * dt**2}
            for method, factor in methods.items()
            for seed in (1, 2)
            for dt in (1.0, 4.0)
        ]
    )
    place = {"box": "water-512", "fs_per_force": 2.0, "over": 1.0, "over_error": 0.0}
    rows = pd.DataFrame([place | {"method": method} for method in methods])
    verlet, own = speed.at_equal_error(rows, points).to_dict("records")
    assert verlet["fs_per_force"] == pytest.approx(math.sqrt(2.5))
    assert own["fs_per_force"] == pytest.approx(math.sqrt(10))
    assert (own["over"], own["over_error"]) == pytest.approx((2.0, 0.0))


def test_the_law_of_the_walk_is_found_again():
    """Points that follow the law give back its constants; points below the floor and of second order do not count."""
    box = {"liquid": "x", "molecules": 1, "time": 1.0, "tolerance": 1e-4, "share": 200}
    scales = {"SIER4G": 2e4, "SIER4P": 3e3}
    rows = [
        box | {"method": name, "step": h, "walk": scale * np.exp(-2 * 31.54 / h)}
        for name, scale in scales.items()
        for h in (4.5, 5.0, 6.0, 7.0)
    ]
    rows += [rows[0] | {"walk": 0.001, "step": 3.0}, rows[0] | {"method": "SIER2", "walk": 3.0}]
    result = whole_run.law(pd.DataFrame(rows))
    # Exact data: only the rounding of a least-squares solution is left.
    assert result["decay"] == pytest.approx(2, rel=1e-9)
    assert result["at_infinity"] == pytest.approx(scales, rel=1e-8)
