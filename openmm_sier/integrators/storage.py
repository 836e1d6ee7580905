"""Serialization and copies of integrators.

For OpenMM an integrator is a CustomIntegrator with settings, variables and a program. Its XML is complete, so that
OpenMM can execute it without this package. When it is read, it becomes the SIER integrator again.
"""

import copy
import inspect
import math
from typing import Any

import openmm
from openmm import unit

from openmm_sier.engines.native import installation, trials
from openmm_sier.engines.native.refusals import why_not
from openmm_sier.engines.program import Program
from openmm_sier.integrators import settings
from openmm_sier.integrators.impl import IntegratorImpl
from openmm_sier.integrators.persistence import store


def written(integrator: Any) -> openmm.CustomIntegrator:
    """Return a plain CustomIntegrator with the steps and the settings of a SIER integrator.

    Its program is right for any System, while that of a Context is for its System only.
    """
    impl = integrator.impl
    store(impl)
    copied, program = installation.without_program(integrator), impl.general_program()
    installation.install(program, copied, is_guarded=_does_less(impl, program))
    installation.set_trial(copied, impl.ensemble.trial(impl.method()))
    copied.setStepSize(impl.settings.step / (program.native_steps or 1))
    return copied


def _does_less(impl: IntegratorImpl, program: Program) -> bool:
    """Return whether a program without this package would do less than what was asked for."""
    needs_package = impl.ensemble.needs_package or impl.settings.bodies is not None or impl.needs_sites
    return needs_package or why_not(impl.method(), program) is not None


def pickled(integrator: Any) -> str:
    """Return the XML for `unpickled`, without a program, which the integrator gets with a Context."""
    store(integrator.impl)
    return openmm.XmlSerializer.serialize(installation.without_program(integrator))


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
    required = {installation.PARTS, *values.ensemble.counts}
    if values.method().trial_steps:
        required |= set(trials.GLOBALS)
    if missing := required - variables:
        raise settings.SettingsError(
            f"A stored SIER integrator lacks the variable {min(missing)}, as one of an earlier version may: create a "
            "new integrator"
        )
    native_steps = plain.getGlobalVariableByName(installation.PARTS) or 1
    step = plain.getStepSize().value_in_unit(unit.picosecond) * native_steps
    installation.uninstall(plain)
    plain.__class__ = cls
    plain.impl = IntegratorImpl(plain, values)
    plain.impl.stored.load()
    # The step may have been set without this package.
    same = math.isclose(step, values.step, rel_tol=1e-12)
    plain.impl.change(step=values.step if same else step)
