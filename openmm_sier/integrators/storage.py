"""Serialization and copies of integrators.

For OpenMM an integrator is a CustomIntegrator with settings, variables and a program. Its XML has settings and
variables. When it is read, it becomes the SIER integrator again, which gets a program with a Context. Where this
package is not imported it fails at the first step.
"""

import copy
import inspect
import math
from typing import Any

import openmm

from openmm_sier.engines.native import installation
from openmm_sier.integrators import settings
from openmm_sier.integrators.impl import IntegratorImpl
from openmm_sier.integrators.persistence import store


def written(integrator: Any) -> openmm.CustomIntegrator:
    """Return a plain CustomIntegrator with the settings and variables of a SIER integrator."""
    store(integrator.impl)
    copied = installation.without_program(integrator)
    installation.add_failure(copied)
    return copied


def pickled(integrator: Any) -> str:
    """Return the XML for `unpickled`."""
    return inspect.unwrap(openmm.XmlSerializer._serializeIntegrator)(written(integrator))


def revived(integrator: openmm.Integrator, base: type) -> openmm.Integrator:
    """Turn a plain CustomIntegrator from XML into its SIER class; return others unchanged.

    Args:
        integrator: openmm.Integrator, whose class changes.
        base: the class of all SIER integrators, of which the stored class must be a subclass.

    Raises:
        SettingsError: stored settings cannot be used.
    """
    if type(integrator) is openmm.CustomIntegrator and settings.is_stored(integrator):
        values = settings.stored(integrator)
        _give_class(integrator, settings.class_at(values.kind, base), values)
    return integrator


def unpickled(xml: str, cls: type, values: settings.Settings, attributes: dict[str, Any]) -> Any:
    """Return an integrator from its XML and its settings, of which XML does not contain all.

    Args:
        xml: result of `pickled`.
        cls: class of the integrator.
        values: its settings.
        attributes: further attributes of a subclass, by name.
    """
    plain = inspect.unwrap(openmm.XmlSerializer._deserializeIntegrator)(xml)
    _give_class(plain, cls, values)
    vars(plain).update(copy.deepcopy(attributes))
    return plain


def _give_class(plain: Any, cls: type, values: settings.Settings) -> None:
    """Turn a CustomIntegrator into a SIER integrator with settings and without a program."""
    variables = {plain.getGlobalVariableName(i) for i in range(plain.getNumGlobalVariables())}
    required = {*installation.variables(bool(values.method().trial_steps)), *values.ensemble.counts}
    if missing := required - variables:
        raise settings.SettingsError(
            f"A stored SIER integrator lacks the variable {min(missing)}, as one of an earlier version may: create a "
            "new integrator"
        )
    step = installation.step_of(plain)
    installation.uninstall(plain)
    plain.__class__ = cls
    plain.impl = IntegratorImpl(plain, values)
    plain.impl.stored.load()
    # The step may have been set without this package.
    same = math.isclose(step, values.step, rel_tol=1e-12)
    plain.impl.change(step=values.step if same else step)
