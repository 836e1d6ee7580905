"""Quantities of a log: conservation, temperatures, density, acceptance. The table at the end of a run."""

import math
from typing import NamedTuple

import numpy as np

from openmm_sier.analysis.observables import energy_error
from openmm_sier.analysis.statistics import Estimate, format_number, mean_and_error, rms, slope_and_error
from openmm_sier.inputs.report import duration
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL, TEMPERATURES

#: Names of the temperatures in tables and pictures, by their columns.
TEMPERATURE_NAMES = dict(zip(TEMPERATURES, ("T_trans", "T_rot", "T of flexible molecules"), strict=True))

DENSITY = "Density (g/mL)"

#: Columns of hybrid Monte Carlo.
ACCEPTANCE, ENERGY_ERROR = "Acceptance", "Energy Error (kT)"

#: Fewest rows of a log for means.
FEWEST_ROWS = 3


class Quantity(NamedTuple):
    """A quantity of a log.

    Attributes:
        name: for tables.
        value: with its error, if it has one.
        unit: of both.
        form: Python's format of a value without an error; "" for three digits.
    """

    name: str
    value: Estimate | float
    unit: str
    form: str = ""

    def __str__(self) -> str:
        if isinstance(self.value, Estimate):
            text = str(self.value)
        else:
            text = f"{self.value:{self.form}}" if self.form else format_number(self.value, digits=3)
        return "-" if text in ("-", "nan") else f"{text} {self.unit}"


def cost_rows(steps: int, ps: float, seconds: float, evaluations: int) -> list[tuple[str, str]]:
    """Return names and values of the wall time of a run, without the time for its files.

    Args:
        steps: number of steps.
        ps: length of a step.
        seconds: wall time of the steps.
        evaluations: number of force evaluations.
    """
    if not steps or not seconds:
        return []
    return [
        ("wall time per step", duration(seconds / steps)),
        ("force evaluations per step", f"{evaluations / steps:.2f}"),
        ("speed of the integration", f"{steps * ps / 1000 / seconds * 86400:.2f} ns/day"),
    ]


def quantities(log: dict[str, np.ndarray], ensemble: str | None, moves_volume: bool) -> list[Quantity]:
    """Return all quantities of a log.

    H is the conserved energy: the total energy less the heat that a thermostat or a volume move has added. Its
    rms and that of V are relative to their means over the log. In a bath its drift is the heat of the steps, and
    rms(H) means nothing. There is none in hybrid Monte Carlo, nor with the baths of OpenMM.

    Args:
        log: its columns by name, see `openmm_sier.observe.conservation.COLUMNS`, and those of trials.
        ensemble: of the run; None if unknown.
        moves_volume: whether the pressure was constant.
    """
    energies = [Quantity("potential energy V", mean_and_error(log[POTENTIAL]), "kJ/mol")]
    if ensemble != "hmc" and not np.isnan(log[CONSERVED]).any():
        energies += _conservation(log, ensemble)
    further = [Quantity("density", mean_and_error(log[DENSITY]), "g/ml")] if moves_volume else []
    return [*energies, *_temperatures(log), *further, *_trials(log)]


def _conservation(log: dict[str, np.ndarray], ensemble: str | None) -> list[Quantity]:
    H, V = log[CONSERVED], log[POTENTIAL]
    drift = slope_and_error(log["Time (ps)"], H)
    if ensemble in ("nvt", "npt"):
        return [Quantity("heat of the steps, which the bath takes up", drift, "kJ/mol/ps")]
    return [
        Quantity("drift of the conserved energy H", drift, "kJ/mol/ps"),
        Quantity("fluctuation rms(H)", rms(H) if len(H) > 2 else math.nan, "kJ/mol"),
        Quantity("rms(H)/rms(V)", 100 * energy_error(H, V), "%"),
    ]


def _temperatures(log: dict[str, np.ndarray]) -> list[Quantity]:
    """Return means of the temperatures, that of flexible molecules only if there are any."""
    named = [(name, log[column]) for column, name in TEMPERATURE_NAMES.items()]
    return [
        Quantity(name, mean_and_error(values), "K")
        for name, values in named
        if name != "T of flexible molecules" or not np.isnan(values).all()
    ]


def _trials(log: dict[str, np.ndarray]) -> list[Quantity]:
    """Return quantities of the trials of hybrid Monte Carlo; none if there were none."""
    if ACCEPTANCE not in log:
        return []
    errors = log[ENERGY_ERROR]
    spread = float(np.std(errors[np.isfinite(errors)])) if np.isfinite(errors).any() else math.nan
    return [
        Quantity("trials accepted", 100 * float(log[ACCEPTANCE][-1]), "%", ".1f"),
        Quantity("their energy errors", spread, "kT (sd)", ".2g"),
    ]
