"""Verdicts on samples whose distributions are known exactly: those of harmonic oscillators and of an ideal gas."""

from __future__ import annotations

import numpy as np
import pytest

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.measure import validation
from openmm_sier.measure.statistics import Estimate
from openmm_sier.measure.validation import LIMIT, ensemble_verdict, kinetic_verdicts, order_verdict, sampled
from tests.support.canonical import DOF, ROWS, P, T, log

pytest.importorskip("physical_validation", reason="pip install openmm-sier[validation]")


def verdicts(**options):
    return {verdict.check: verdict for verdict in kinetic_verdicts(sampled([log(**options)], T, P))}


def failures(**options):
    return {name for name, verdict in verdicts(**options).items() if verdict.distance > LIMIT}


# --- kinetic energies ---


def test_canonical_kinetic_energies_pass():
    found = verdicts()
    assert len(found) == 6
    assert max(verdict.distance for verdict in found.values()) < LIMIT
    # One in two is taken where chance makes neighbours look alike.
    assert min(verdict.samples for verdict in found.values()) >= ROWS / 2


def test_a_rotation_that_is_too_cold_is_told_from_translation():
    """As SIER2 with a step that is too long; 4 % are eight standard errors."""
    found = failures(heated=(1.0, 0.96))
    assert "rotation: mean kinetic energy" in found
    assert not any(name.startswith("translation") for name in found)


def test_degrees_of_freedom_that_are_miscounted_fail():
    """The log's temperature is then off by 6/192, six standard errors, though its kinetic energy is right."""
    found = failures(counted=DOF - 6)
    assert "translation: mean kinetic energy" in found
    assert not any(name.startswith("rotation") for name in found)


def test_a_width_that_is_too_narrow_fails():
    """As with a thermostat that scales velocities; a width is known to 1/sqrt(2*400) = 3.5 %."""
    found = failures(narrowed=0.7)
    assert {"translation: width of its distribution", "rotation: width of its distribution"} <= found
    assert not any(name.endswith("mean kinetic energy") for name in found)


def test_the_shape_counts_where_mean_and_width_are_right():
    """Two peaks of the right mean and width: as of a run that was hot for half of its time and cold for half."""
    found = log()
    for name in ("Translational Temperature (K)", "Rotational Temperature (K)"):
        signs = np.where(np.random.default_rng(3).random(ROWS) < 0.5, -1, 1)
        found[name] = T * (1 + np.sqrt(2 / DOF) * signs * np.random.default_rng(4).normal(1, 0.05, ROWS))
    heat = 0.5 * DOF * GAS_CONSTANT
    found["Kinetic Energy (kJ/mole)"] = heat * (
        found["Translational Temperature (K)"] + found["Rotational Temperature (K)"]
    )
    checks = {verdict.check: verdict.distance for verdict in kinetic_verdicts(sampled([found], T, P))}
    assert checks["translation: its shape"] > LIMIT
    assert checks["translation: mean kinetic energy"] < LIMIT


# --- energies and volumes ---


def pair(two, pressures=(P, P), **wrong):
    """The verdict on runs at T and at another state point."""
    constant = wrong.pop("constant_volume", False)
    logs = log(pressure=pressures[0]), log(**{"temperature": two, "pressure": pressures[1], "seed": 2} | wrong)
    points = [(T, pressures[0]), (two, pressures[1])]
    return ensemble_verdict(
        *(sampled([one], t, None if constant else p) for one, (t, p) in zip(logs, points, strict=True))
    )


@pytest.mark.parametrize("constant_volume", [True, False])
def test_energies_at_two_temperatures(constant_volume):
    """The best interval is 2 T/sqrt(dof/2) = 61 K; with volumes, whose work adds 65 to these 96, 47 K."""
    found = pair(345.0, constant_volume=constant_volume)
    assert found.check.startswith("potential energy" if constant_volume else "enthalpy")
    assert found.distance < LIMIT
    # Said to be at 380 K: the slope is 38 % too small then, and known to 6 %.
    wrong = pair(380.0, constant_volume=constant_volume, temperature=345.0)
    assert wrong.distance > LIMIT


def test_volumes_at_two_pressures():
    found = pair(T, (1000.0, 1250.0))
    assert found.check == "volume at 1000 and 1250 bar"
    assert found.distance < LIMIT
    assert pair(T, (1000.0, 1500.0), pressure=1250.0).distance > LIMIT


def test_pairs_that_tell_nothing_are_refused():
    with pytest.raises(ValueError, match="differ in temperature or pressure"):
        pair(345.0, (1000.0, 1250.0))
    with pytest.raises(ValueError, match="differ in temperature or pressure"):
        pair(T)
    with pytest.raises(validation.TooFewError, match="potential energy at 300 and 900 K"):
        pair(900.0, constant_volume=True)
    with pytest.raises(validation.TooFewError, match="independent samples, 20 are needed"):
        kinetic_verdicts(sampled([log(rows=15)], T, P))


def test_correlated_samples_count_once():
    """Each sample five times over: g of this series is 5, so that one in five is taken."""
    once = log(rows=200)
    repeated = {name: np.repeat(values, 5) for name, values in once.items()}
    found = sampled([repeated, repeated], T, None)
    assert 2 * 200 / 1.6 <= len(found.potential) <= 2 * 200 * 1.3
    assert len(found.groups[0].energies) <= 2 * 200 * 1.3
    assert [group.dof for group in found.groups] == pytest.approx([DOF, DOF])


# --- the order ---


def test_the_order_is_that_of_the_ratio():
    clean = Estimate(16.0, 0.0), Estimate(1.0, 0.0)
    assert order_verdict((2, 1), clean, 4).distance < 0.1
    # log(16/4) and log(16/8) over the share of the next order, 0.1.
    assert order_verdict((2, 1), clean, 2).distance > LIMIT
    assert order_verdict((2, 1), clean, 3).distance > LIMIT
    # Fluctuations that are hardly known tell nothing.
    assert order_verdict((2, 1), (Estimate(16.0, 8.0), Estimate(1.0, 0.5)), 2).distance < LIMIT


def test_the_fluctuation_is_that_of_all_logs(rng):
    """Of independent normal values: in each log 20 windows of 50, straight lines taken out."""
    time = np.arange(1000) * 0.02

    def drawn(*widths):
        logs = [{"Time (ps)": time, "Conserved Energy (kJ/mole)": rng.normal(0, width, 1000)} for width in widths]
        return validation.fluctuation(logs)

    # 3/sqrt(2*1000) = 0.07 of chance, 2 % less by the lines. The error of 20 windows is known to 16 %.
    one = drawn(3.0)
    assert one.value == pytest.approx(2.94, abs=0.2)
    assert one.error == pytest.approx(0.067, rel=0.5)
    # With a run of another width the mean square is (3² + 1²)/2.
    assert drawn(3.0, 1.0).value == pytest.approx(0.98 * 5**0.5, abs=0.2)
    assert drawn(*[3.0] * 16).error == pytest.approx(one.error / 4, rel=0.5)


def test_rare_rows_have_a_fluctuation(rng):
    """Rows 1 ps apart: windows are longer than 1 ps, since a line through two values leaves nothing."""
    log = {"Time (ps)": np.arange(40.0), "Conserved Energy (kJ/mole)": rng.normal(0, 3, 40)}
    # 40 values know their width to 11 %; lines through windows of 8 take two of eight degrees of freedom.
    assert validation.fluctuation([log]).value == pytest.approx(3 * 0.75**0.5, rel=0.5)
