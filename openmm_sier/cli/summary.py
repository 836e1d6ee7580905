"""The table at the end of a run: conservation and cost."""

import math

import numpy as np

from openmm_sier.analysis.observables import energy_error
from openmm_sier.analysis.statistics import Estimate, mean_and_error, rms, slope_and_error
from openmm_sier.inputs.report import duration
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL


def cost_rows(steps: int, ps: float, seconds: float, evaluations: int) -> list[tuple[str, str]]:
    """Names and values of the wall time of a run, without the time for its files.

    Args:
        steps: number of them.
        ps: length of each.
        seconds: that they took.
        evaluations: force evaluations that the integrator counted.
    """
    if not steps or not seconds:
        return []
    return [
        ("wall time per step", duration(seconds / steps)),
        ("force evaluations per step", f"{evaluations / steps:.2f}"),
        ("speed of the integration", f"{steps * ps / 1000 / seconds * 86400:.2f} ns/day"),
    ]


def rows(log: dict[str, np.ndarray], ensemble: str, moves_volume: bool) -> list[tuple[str, str]]:
    """Names and values for the table at the end.

    H is the conserved energy: the total energy less the heat that a thermostat or a volume move has added. Its
    rms and that of V are about their means over the whole run. In a bath its drift is the heat of the steps, and rms(H)
    tells nothing.

    Args:
        log: columns of the log by name, see `openmm_sier.observe.conservation.COLUMNS`, and those of trials.
        ensemble: of the run.
        moves_volume: whether the pressure was constant.
    """
    found = _conservation_rows(log) if ensemble == "nve" else _bath_rows(log, ensemble)
    for name, kind in (("T_trans", "Translational"), ("T_rot", "Rotational"), ("T of flexible molecules", "Flexible")):
        values = log[f"{kind} Temperature (K)"]
        if kind != "Flexible" or not np.isnan(values).all():
            found.append((name, _value(mean_and_error(values), "K")))
    # Trials draw momenta anew, that of the whole box included: it says nothing there.
    if "Acceptance" not in log:
        momentum = np.linalg.norm([log[f"Momentum {axis} (dalton nm/ps)"] for axis in "xyz"], axis=0)
        found.append(("total momentum, first and last", f"{momentum[0]:.2g}, {momentum[-1]:.2g} dalton nm/ps"))
    if moves_volume:
        found.append(("density", _value(mean_and_error(log["Density (g/mL)"]), "g/ml")))
    if "Acceptance" in log:
        errors = log["Energy Error (kT)"]
        spread = float(np.std(errors[np.isfinite(errors)])) if np.isfinite(errors).any() else math.nan
        found.append(("trials accepted", f"{100 * log['Acceptance'][-1]:.1f} %"))
        found.append(("their energy errors", f"{spread:.2g} kT (sd)"))
    return found


def _conservation_rows(log: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    time, H, V = (log[name] for name in ("Time (ps)", CONSERVED, POTENTIAL))
    return [
        ("drift of the conserved energy H", _value(slope_and_error(time, H), "kJ/mol/ps")),
        ("fluctuation rms(H)", _value(rms(H) if len(H) > 2 else math.nan, "kJ/mol")),
        ("rms(H)/rms(V)", _value(100 * energy_error(H, V), "%")),
    ]


def _bath_rows(log: dict[str, np.ndarray], ensemble: str) -> list[tuple[str, str]]:
    found = [("potential energy V", _value(mean_and_error(log[POTENTIAL]), "kJ/mol"))]
    # Energy errors of trials have rows of their own. OpenMM does not count the heat of its baths.
    if ensemble != "hmc" and not np.isnan(log[CONSERVED]).any():
        drift = slope_and_error(log["Time (ps)"], log[CONSERVED])
        found.append(("heat of the steps, which the bath takes up", _value(drift, "kJ/mol/ps")))
    return found


def _value(found: Estimate | float, unit: str) -> str:
    text = str(found) if isinstance(found, Estimate) else f"{found:.3g}"
    return "-" if text in ("-", "nan") else f"{text} {unit}"
