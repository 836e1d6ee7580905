"""Findings about logs whose statistics are known: whether they settled, drift, heat, temperatures that differ."""

import re
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.cli.findings import findings, verdict
from openmm_sier.cli.logged_runs import read_run
from openmm_sier.cli.settling import read_runs
from tests.support.logs import write_log, write_notes
from tests.support.series import correlated

POTENTIAL, DENSITY = "Potential Energy (kJ/mole)", "Density (g/mL)"
TRANSLATION, ROTATION = "Translational Temperature (K)", "Rotational Temperature (K)"


def of_logs(*paths, skip=None):
    """The verdict and the findings of some logs."""
    runs = read_runs([Path(path) for path in paths], skip)
    return verdict(runs), findings(runs)


@pytest.mark.parametrize(
    ("ensemble", "begins"),
    [
        ("nve", ["No drift of the conserved energy shows", "Rotation: no difference from translation shows"]),
        ("nvt", ["No heat of the steps shows", "Translation and rotation: no difference from the bath of 297 K"]),
        ("npt", ["No heat of the steps shows", "Translation and rotation: no"]),
        ("hmc", ["Translation and rotation: no"]),
        (None, ["No drift of the conserved energy shows", "Rotation: no difference from translation shows"]),
    ],
)
def test_each_ensemble_has_its_findings(ensemble, begins):
    """The ensemble is that of the checkpoint; a log alone has none."""
    write_log("a.csv", ensemble or "nvt")
    if ensemble:
        write_notes("a.csv", ensemble)
    assert read_run(Path("a.csv")).ensemble == ensemble
    title, sentences = of_logs("a.csv")
    clock = "500 trials" if ensemble == "hmc" else "20 ps"
    assert title.startswith(f"{clock} without a trend of energy")
    assert len(sentences) == len(begins)
    for sentence, begin in zip(sentences, begins, strict=True):
        assert sentence.startswith(begin)


def test_a_drift_is_found_with_its_error():
    """From 20 ps, the slope of white noise of 0.5 kJ/mol has an error of 0.004 kJ/mol/ps."""
    write_log("a.csv", drift=0.1)
    _, (energy, *_) = of_logs("a.csv")
    # Within three errors, as the slopes below.
    assert float(energy.split("drifts by ")[1].split()[0]) == pytest.approx(0.1, abs=0.012)
    write_notes("b.csv", "nvt")
    for drift, verb in ((0.1, "heat"), (-0.1, "cool")):
        write_log("b.csv", "nvt", drift=drift)
        heat = of_logs("b.csv")[1][0]
        assert heat.startswith(f"The steps {verb} by ")
        assert float(heat.split(" by ")[1].split()[0]) == pytest.approx(0.1, abs=0.012)


def test_a_cold_rotation_is_found():
    """The error of a mean of 501 temperatures of which three are worth one is 0.9 K; that of a difference 1.3 K."""
    write_log("a.csv", change=lambda log: log.update({ROTATION: log[ROTATION] - 15}))
    match = re.fullmatch(r"Rotation is (.+) ± .+ K colder than translation", of_logs("a.csv")[1][-1])
    assert float(match[1]) == pytest.approx(15, abs=4)


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
    assert of_logs("a.csv", skip=8.0)[0] == title
    # What then drifts is said.
    assert read_runs([Path("a.csv")], 0).begin == 0
    assert of_logs("a.csv", skip=0)[0] == "Not settled in 20 ps: potential energy"


def test_a_short_log_shows_no_trend():
    """Of 24 rows every third is independent."""
    write_log("a.csv", rows=24)
    title, _ = of_logs("a.csv")
    assert title == "0.92 ps: too short to tell a trend of potential energy, translation and rotation"


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


def test_findings_about_temperatures_respect_their_errors():
    """Rotation keeps 0.97 of its deviations, so that 66 of 1001 rows are worth one."""

    def slow(log):
        log[ROTATION] = 297 + 12 * correlated(np.random.default_rng(2), len(log[ROTATION]), 0.97)

    log = write_log("a.csv", rows=1001, change=slow)
    _, (*_, temperatures) = of_logs("a.csv", skip=0)
    within = re.fullmatch(r"Rotation: no difference from translation shows within (\S+) K", temperatures)
    # Written with two digits.
    off = mean_and_error(log[ROTATION] - log[TRANSLATION])
    assert float(within[1]) == pytest.approx(3 * off.error * (2 if off.samples < 20 else 1), rel=0.05)


def test_a_log_that_never_settles_is_named():
    write_log("a.csv", "npt", change=lambda log: log.update({DENSITY: log[DENSITY] + 0.01 * log["Time (ps)"]}))
    assert of_logs("a.csv")[0] == "Not settled in 20 ps: density. Means leave out the first 10 ps"
