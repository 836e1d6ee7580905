"""The part of runs that means are taken from, of logs whose statistics are known."""

import re
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.cli.settling import read_runs, verdict
from tests.support.logs import write_log

POTENTIAL, DENSITY = "Potential Energy (kJ/mole)", "Density (g/mL)"


def verdict_on(*paths, skip=None):
    return verdict(read_runs([Path(path) for path in paths], skip))


def test_a_beginning_that_had_not_settled_is_left_out_of_means():
    """Six standard deviations off at first, which fade within 1 ps of 20."""

    def warm(log):
        log[POTENTIAL] = log[POTENTIAL] + 300 * np.exp(-log["Time (ps)"])

    write_log("a.csv", "nvt", change=warm)
    runs = read_runs([Path("a.csv")])
    assert runs.moving == ("potential energy",)
    assert (runs.drifting, runs.unclear) == ((), ())
    assert 1 < runs.begin < 6
    assert verdict(runs) == f"Settled after {runs.begin:.4g} ps: potential energy. Means are of the rest"
    # The mean of the whole is off by 300/20 = 15. The error of the mean of the rest is 4.4, and its transient below 6.
    mean, _ = runs.means()[0]
    assert mean.value.value == pytest.approx(-5000, abs=16)
    # What is left out can be chosen.
    title = "12 ps without a trend of energy or temperatures. Means leave out the first 8 ps"
    assert verdict_on("a.csv", skip=8.0) == title
    # What then drifts is said.
    assert read_runs([Path("a.csv")], 0).begin == 0
    assert verdict_on("a.csv", skip=0) == "Not settled in 20 ps: potential energy"


def test_a_short_log_shows_no_trend():
    """Of 24 rows every third is independent."""
    write_log("a.csv", rows=24)
    assert verdict_on("a.csv") == "0.92 ps: too short to tell a trend of potential energy, T_trans, T_rot"


def test_a_quantity_with_a_long_memory_is_not_settled_by_the_others():
    """The density rises with a time of 2.5 ps in runs of 8 ps, and the rest is white or settles within a picosecond."""

    def compress(log):
        time = log["Time (ps)"]
        log[DENSITY] = 0.99 + 0.1 * (log[DENSITY] - 0.99) - 0.063 * np.exp(-time / 2.5)
        log[POTENTIAL] = log[POTENTIAL] + 500 * np.exp(-time / 0.2)

    names = [f"seed{seed}.csv" for seed in (1, 2, 3)]
    for seed, name in enumerate(names, 1):
        write_log(name, "npt", seed=seed, rows=201, change=compress)
    runs = read_runs([Path(name) for name in names])
    assert "density" in (*runs.drifting, *runs.unclear)
    assert re.match(r"(8 ps: too short to tell a trend of|Not settled in 8 ps:) .*density", verdict(runs))
    # The mean of the whole is 0.971, and that of its second half 0.982.
    assert runs.begin > 3
    density = next(mean for mean, _ in runs.means() if mean.name == "density")
    assert density.value.value > 0.98


def test_a_log_that_never_settles_is_named():
    write_log("a.csv", "npt", change=lambda log: log.update({DENSITY: log[DENSITY] + 0.01 * log["Time (ps)"]}))
    assert verdict_on("a.csv") == "Not settled in 20 ps: density. Means leave out the first 10 ps"
