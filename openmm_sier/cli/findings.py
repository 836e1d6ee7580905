"""Findings of `summary`: values that differ from those expected by more than their errors explain."""

from __future__ import annotations

import math
from collections.abc import Sequence

from openmm_sier.analysis.statistics import FEWEST, Estimate
from openmm_sier.cli.logged_runs import Runs
from openmm_sier.cli.results import Quantity

#: Standard errors from which on a difference is significant.
SIGNIFICANT = 3.0


def findings(runs: Runs, means: Sequence[Quantity]) -> list[str]:
    """Return a sentence on each significant drift, heat of the steps, and difference of a temperature.

    Temperatures are compared with that of the bath or, at constant energy, with that of translation.

    Args:
        runs: the runs.
        means: the quantities over all of them.
    """
    plan = runs.first.plan
    temperatures = [quantity for quantity in means if quantity.unit == "K"]
    if plan is not None and plan.ensemble != "nve":
        name, reference = f"the bath ({plan.temperature:g} K)", Estimate(plan.temperature, 0.0)
    else:
        name, reference = temperatures[0].name, _estimate(temperatures[0])
    sentences = [
        f"Significant: {quantity.name}"
        for quantity in means
        if quantity.unit == "kJ/mol/ps" and _is_significant(_estimate(quantity))
    ]
    for quantity in temperatures:
        difference = _difference(_estimate(quantity), reference)
        if quantity.name != name and _is_significant(difference):
            sentences.append(f"Significant: {quantity.name} differs by {difference} K from {name}")
    return sentences


def _estimate(quantity: Quantity) -> Estimate:
    return quantity.value if isinstance(quantity.value, Estimate) else Estimate(quantity.value, math.nan)


def _difference(one: Estimate, other: Estimate) -> Estimate:
    return Estimate(one.value - other.value, math.hypot(one.error, other.error), min(one.samples, other.samples))


def _is_significant(estimate: Estimate) -> bool:
    """Return whether a value differs from 0 by more than its error explains."""
    # An error from few samples is too small by up to a factor of two.
    return abs(estimate.value) > SIGNIFICANT * estimate.error * (2 if estimate.samples < FEWEST else 1)
