"""Quantities of a log: conservation, temperatures, density, acceptance. The table at the end of a run."""

import math
from typing import NamedTuple

import numpy as np

from openmm_sier.analysis.observables import energy_error
from openmm_sier.analysis.statistics import Estimate, format_number, mean_and_error, rms, slope_and_error
from openmm_sier.inputs.report import duration
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL, TEMPERATURES

#: Names of the temperatures in tables, in the order of their columns.
NAMES_OF_TEMPERATURES = ("T_trans", "T_rot", "T of flexible molecules")

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
        text = str(self.value) if isinstance(self.value, Estimate) else self.single(self.value)
        return "-" if text in ("-", "nan") else f"{text} {self.unit}"

    def single(self, value: float) -> str:
        """Return a value of this quantity in one run, with the digits of the mean if that has an error."""
        mean = self.value
        if not isinstance(mean, Estimate):
            return f"{value:{self.form}}" if self.form else format_number(value, digits=3)
        if not (math.isfinite(mean.error) and mean.error > 0):
            return format_number(value)
        digits = max(0, 1 - math.floor(math.log10(mean.error)))
        return f"{value:.{digits}f}" if digits < 7 else format_number(value)


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


def rows(log: dict[str, np.ndarray], ensemble: str, moves_volume: bool) -> list[tuple[str, str]]:
    """Return names and values for the table at the end.

    Args:
        log: columns of the log by name, see `openmm_sier.observe.conservation.COLUMNS`, and those of trials.
        ensemble: of the run.
        moves_volume: whether the pressure was constant.
    """
    named = [(quantity.name, str(quantity)) for quantity in (*energies(log, ensemble), *temperatures(log))]
    # Trials draw new momenta, so that the total momentum means nothing.
    if ACCEPTANCE not in log:
        momentum = np.linalg.norm([log[f"Momentum {axis} (dalton nm/ps)"] for axis in "xyz"], axis=0)
        named.append(("total momentum, first and last", f"{momentum[0]:.2g}, {momentum[-1]:.2g} dalton nm/ps"))
    further = [density(log)] if moves_volume else []
    return named + [(quantity.name, str(quantity)) for quantity in (*further, *trials(log))]


def energies(log: dict[str, np.ndarray], ensemble: str | None) -> list[Quantity]:
    """Return energies of a log.

    H is the conserved energy: the total energy less the heat that a thermostat or a volume move has added. Its
    rms and that of V are relative to their means over the whole log. In a bath its drift is the heat of the steps, and
    rms(H) means nothing.

    Args:
        log: its columns.
        ensemble: of the run; None if unknown.
    """
    if ensemble == "nve":
        return _conservation(log)
    potential = potential_energy(log)
    # Energy errors of trials have rows of their own. OpenMM does not count the heat of its baths.
    if ensemble == "hmc" or np.isnan(log[CONSERVED]).any():
        return [potential]
    if ensemble is None:
        return [potential, *_conservation(log)]
    return [potential, Quantity("heat of the steps, which the bath takes up", drift(log), "kJ/mol/ps")]


def _conservation(log: dict[str, np.ndarray]) -> list[Quantity]:
    H, V = log[CONSERVED], log[POTENTIAL]
    return [
        Quantity("drift of the conserved energy H", drift(log), "kJ/mol/ps"),
        Quantity("fluctuation rms(H)", rms(H) if len(H) > 2 else math.nan, "kJ/mol"),
        Quantity("rms(H)/rms(V)", 100 * energy_error(H, V), "%"),
    ]


def drift(log: dict[str, np.ndarray]) -> Estimate:
    """Return the drift of the conserved energy, kJ/mol/ps."""
    return slope_and_error(log["Time (ps)"], log[CONSERVED])


def potential_energy(log: dict[str, np.ndarray]) -> Quantity:
    """Return the mean of the potential energy."""
    return Quantity("potential energy V", mean_and_error(log[POTENTIAL]), "kJ/mol")


def temperatures(log: dict[str, np.ndarray]) -> list[Quantity]:
    """Return means of the temperatures, that of flexible molecules only if there are any."""
    named = [(name, log[column]) for name, column in zip(NAMES_OF_TEMPERATURES, TEMPERATURES, strict=True)]
    return [
        Quantity(name, mean_and_error(values), "K")
        for name, values in named
        if name != NAMES_OF_TEMPERATURES[-1] or not np.isnan(values).all()
    ]


def density(log: dict[str, np.ndarray]) -> Quantity:
    """Return the mean density."""
    return Quantity("density", mean_and_error(log[DENSITY]), "g/ml")


def trials(log: dict[str, np.ndarray]) -> list[Quantity]:
    """Return quantities of the trials of hybrid Monte Carlo; none if there were none."""
    if ACCEPTANCE not in log:
        return []
    errors = log[ENERGY_ERROR]
    spread = float(np.std(errors[np.isfinite(errors)])) if np.isfinite(errors).any() else math.nan
    return [
        Quantity("trials accepted", 100 * float(log[ACCEPTANCE][-1]), "%", ".1f"),
        Quantity("their energy errors", spread, "kT (sd)", ".2g"),
    ]
