"""Findings about logs whose statistics are known: drift, heat, temperatures that differ."""

from pathlib import Path

import pytest

from openmm_sier.cli.findings import findings
from openmm_sier.cli.settling import read_runs
from tests.support.logs import write_log, write_notes

ROTATION = "Rotational Temperature (K)"


def of_log(path):
    runs = read_runs([Path(path)])
    return findings(runs, [over_all for over_all, _ in runs.means()])


@pytest.mark.parametrize("ensemble", ["nve", "nvt", "npt", "hmc", None])
def test_a_log_without_drift_and_differences_has_no_findings(ensemble):
    """Noise whose means are zero; of the three or four estimates none reaches three errors with this seed."""
    write_log("a.csv", ensemble or "nvt")
    if ensemble:
        write_notes("a.csv", ensemble)
    assert of_log("a.csv") == []


@pytest.mark.parametrize(
    ("ensemble", "sentence"),
    [("nve", "drift of the conserved energy H"), ("nvt", "heat of the steps, which the bath takes up")],
)
def test_a_drift_is_found(ensemble, sentence):
    """From 20 ps, the slope of white noise of 0.5 kJ/mol has an error of 0.004 kJ/mol/ps; this one is 25 times that."""
    write_log("a.csv", ensemble, drift=0.1)
    write_notes("a.csv", ensemble)
    assert of_log("a.csv") == [f"Significant: {sentence}"]


@pytest.mark.parametrize(("ensemble", "reference"), [("nve", "T_trans"), ("nvt", "the bath (297 K)")])
def test_a_cold_rotation_is_found(ensemble, reference):
    """The error of a mean of 501 temperatures of which three are worth one is 0.9 K; that of a difference 1.3 K."""
    write_log("a.csv", ensemble, change=lambda log: log.update({ROTATION: log[ROTATION] - 15}))
    write_notes("a.csv", ensemble)
    (sentence,) = of_log("a.csv")
    assert sentence.startswith("Significant: T_rot differs by -1")
    assert sentence.endswith(f" K from {reference}")
