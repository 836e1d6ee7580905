"""Integrators from XML, copies and pickles."""

from __future__ import annotations

import copy
import inspect
import math
from dataclasses import replace
from typing import Any

import openmm

from openmm_sier.integrators import settings
from openmm_sier.integrators.settings import Settings


def revived(integrator: openmm.Integrator, base: type) -> openmm.Integrator:
    """Turn a plain CustomIntegrator read from XML back into the SIER integrator it was; return others unchanged.

    Args:
        integrator: openmm.Integrator.
        base: the class of all SIER integrators.

    Raises:
        settings.SettingsError: what is stored cannot be used here, as the message says.
    """
    if type(integrator) is openmm.CustomIntegrator and settings.is_stored(integrator):
        found = settings.stored(integrator)
        _give_class(integrator, settings.class_at(found.kind, base), found)
    return integrator


def unpickled(xml: str, cls: type, attributes: dict[str, Any]) -> Any:
    """An integrator from its XML, with the attributes that XML does not hold in full."""
    plain = inspect.unwrap(openmm.XmlSerializer._deserializeIntegrator)(xml)
    _give_class(plain, cls, attributes["_settings"])
    for name in attributes.keys() - vars(plain).keys():
        setattr(plain, name, copy.deepcopy(attributes[name]))
    return plain


def _give_class(plain: Any, cls: type, found: Settings) -> None:
    variables = {plain.getGlobalVariableName(i) for i in range(plain.getNumGlobalVariables())}
    if missing := set(found.ensemble.record) - variables:
        raise settings.SettingsError(f"A stored SIER integrator has no variable {missing.pop()}")
    plain.__class__ = cls
    plain._use(found)
    step = openmm.CustomIntegrator.getStepSize(plain)._value * plain._native_steps
    if not math.isclose(step, found.step, rel_tol=1e-12):
        # The step was set where this package was not imported.
        plain._settings = replace(found, step=step)
