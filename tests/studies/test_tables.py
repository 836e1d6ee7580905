"""Analysis in studies: pooled runs, points with errors, costs, laws, and refusals of a pool."""

import math

import numpy as np
import pandas as pd
import pytest

from studies import equipartition, schemes, speed, step_study, timing, whole_run
from studies.equipartition import MEASURED
from studies.hmc import solvated
from studies.speed import Turn

# --- acceptance -------------------------------------------------------------------------------------------------------


def test_a_trajectory_that_could_not_be_followed_is_rejected():
    row = solvated.statistics([0.1, math.nan])
    assert row["acceptance"] == pytest.approx(0.5 * math.exp(-0.1))
    assert math.isnan(row["spread"])


def test_the_law_of_acceptance_by_size():
    """Boxes whose spreads are 0.01 for each root of the number of atoms."""
    rows = pd.DataFrame({"atoms": [100, 400], "spread": [0.1, 0.2], "trials": [50, 50]})
    rows = rows.assign(moving="all", scheme="sier4g", masses="3", per_force=2.0, solute=10, waters=30)
    (law,) = solvated.laws(rows).to_dict("records")
    assert law["one"] == pytest.approx(0.01)
    # An acceptance of 0.5 is that of a spread of 1.349.
    assert law["atoms_50"] == pytest.approx(134.9**2, rel=1e-3)


# --- temperatures -----------------------------------------------------------------------------------------------------


def run_of(mean, error, time, predicted=math.nan, broken=""):
    measured = dict.fromkeys(MEASURED, mean) | {f"{name}_error": error for name in MEASURED}
    place = {"method": "SIER4", "step": 4.0, "fs_per_force": 1.0, "time": time}
    return place | measured | {"drift": mean, "predicted": predicted, "broken": broken}


def pooled(*rows):
    (result,) = equipartition.pooled(pd.DataFrame(rows)).to_dict("records")
    return result


def test_replicas_are_pooled_by_their_lengths():
    """Three times the length weighs as much, and has a standard error less by the square root of it."""
    row = pooled(run_of(1.0, 0.3, 30.0), run_of(2.0, 0.3 * 3**0.5, 10.0))
    assert row["time"] == 40.0
    # The best estimate of all, whose error is that of one run of 40 ps.
    assert (row["difference"], row["difference_error"]) == pytest.approx((1.25, 0.3 * (3 / 4) ** 0.5))
    assert row["drift"] == pytest.approx(1.25)
    assert math.isnan(row["predicted"])
    parts = run_of(1.0, 0.3, 30.0, -2.0), run_of(1.0, 0.3, 10.0, -1.0), run_of(1.0, 0.3, 10.0)
    assert pooled(*parts)["predicted"] == -1.5
    assert pooled(run_of(1.0, 0.3, 30.0), run_of(0.0, 1.0, 10.0, broken="too hot"))["broken"] == "too hot"


# --- schemes ----------------------------------------------------------------------------------------------------------


def test_points_are_means_over_starts_with_their_errors():
    names = ["liquid", "method", "fs_per_force", "percent", "broken"]
    runs = [("A", "OpenMM Verlet", 2.0, 0.9, ""), ("A", "OpenMM Verlet", 2.0, 1.1, "")]
    runs += [("A", "X", 4.0, 1.0, ""), ("A", "X", 4.0, 2.0, ""), ("B", "X", 4.0, 3.0, "")]
    runs += [("A", "Y", 4.0, 1.0, ""), ("A", "Y", 4.0, math.nan, "too long")]
    same = {"order": 2, "forces": 1, "step": 4.0, "drift": 0.0}
    rows = schemes.points(pd.DataFrame(runs, columns=names).assign(**same)).set_index(["liquid", "method"])
    verlet, x, y = (rows.loc["A", name] for name in ("OpenMM Verlet", "X", "Y"))
    # The standard error of two values is half their difference.
    assert (verlet["percent"], verlet["percent_error"]) == pytest.approx((1.0, 0.1))
    assert (verlet["relative"], verlet["relative_error"]) == (1.0, 0.0)
    assert (x["relative"], x["relative_error"]) == pytest.approx((1.5, 1.5 * math.hypot(0.5 / 1.5, 0.1)))
    assert x["starts"] == 2
    assert math.isnan(y["percent"])
    assert y["broken"] == "too long"
    # One start has no error, and a liquid without Verlet nothing to be divided by.
    assert math.isnan(rows.loc[("B", "X"), "percent_error"])
    assert math.isnan(rows.loc[("B", "X"), "relative"])


# --- steps and costs --------------------------------------------------------------------------------------------------


def point(method, h, forces=1, box="spce-512", time=180.0, **found):
    place = {"box": box, "method": method, "step": forces * h, "fs_per_force": h, "runs": 2, "time": time}
    unknown = dict.fromkeys((name for key in step_study.MEASURED for name in (key, f"{key}_error")), math.nan)
    given = {name: x for key, pair in found.items() for name, x in zip((key, f"{key}_error"), pair, strict=True)}
    return place | unknown | given


def test_errors_are_shared_by_rows_of_one_box_and_method():
    rows = [
        point("SIER2", 4.0, time=90.0, density=(1.0, 0.002), energy=(-46.0, math.nan)),
        point("SIER2", 1.0, time=10.0, density=(0.99, 0.001), energy=(-47.0, math.nan)),
        point("SIER4G", 1.0, 3, density=(0.99, 0.007)),
    ]
    result = step_study.with_shared_errors(pd.DataFrame(rows))
    # (90^2 0.002^2 + 10^2 0.001^2)/100 is the square of the error of 1 ps.
    factor = math.sqrt(0.000325)
    assert list(result["density"]) == [1.0, 0.99, 0.99]
    assert list(result["density_error"]) == pytest.approx([factor / 90**0.5, factor / 10**0.5, 0.007])
    # An error that no row has stays unknown.
    assert result["energy_error"].isna().all()


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
    turns = {
        speed.REFERENCE: np.array(3 * [Turn(2.0, 0.002, 0.001)]),
        speed.BATH_REFERENCE: np.array(3 * [Turn(8.0, 0.004, 0.002)]),
        "other": np.array(3 * [Turn(12.0, 0.004, 0.003)]),
    }
    reference, _, own = speed.rows_of(turns, "CPU")
    # 1 fs/ms is 86.4 ns/day.
    assert (reference["ns_per_day"], reference["ns_per_day_processor"]) == pytest.approx((86.4, 172.8))
    assert (own["over"], own["over_middle"]) == pytest.approx((2.0, 1.0))
    assert speed.rows_of(turns, "CUDA")[2]["over"] == pytest.approx(3.0)


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
