"""Integrators as OpenMM serializes and copies them.

OpenMM knows a CustomIntegrator with settings, variables and a program, and nothing of Python. What is written is
complete, so that OpenMM can execute it where this package is not imported. What is read becomes the SIER integrator
that it was.
"""

import copy
import inspect
import math
from typing import Any

import openmm
from openmm import unit

from openmm_sier.engines.native import installation, trials
from openmm_sier.integrators import settings
from openmm_sier.integrators.binding import Binding


def written(integrator: Any) -> openmm.CustomIntegrator:
    """Return a plain CustomIntegrator that makes the steps of a SIER integrator and holds its settings.

    Its program is right in any System, unlike that of a Context, which is written for one.
    """
    binding = integrator.binding
    binding.store()
    copied, program = installation.without_program(integrator), binding.general_program()
    installation.install(program, copied)
    installation.set_trial(copied, binding.ensemble.trial(binding.flow()))
    copied.setStepSize(binding.settings.step / (program.native_steps or 1))
    return copied


def pickled(integrator: Any) -> str:
    """Return the XML of what `unpickled` needs from OpenMM, which gets its program with a Context."""
    integrator.binding.store()
    return openmm.XmlSerializer.serialize(installation.without_program(integrator))


def revived(integrator: openmm.Integrator, base: type) -> openmm.Integrator:
    """Return the SIER integrator that a plain CustomIntegrator from XML was, and others as they are.

    Args:
        integrator: becomes the SIER integrator itself.
        base: the class of all SIER integrators, of which its class must be a subclass.

    Raises:
        SettingsError: what is stored cannot be used here, as the message says.
    """
    if type(integrator) is openmm.CustomIntegrator and settings.is_stored(integrator):
        found = settings.stored(integrator)
        _give_class(integrator, settings.class_at(found.kind, base), found)
    return integrator


def unpickled(xml: str, cls: type, given: settings.Settings, attributes: dict[str, Any]) -> Any:
    """Return an integrator from its XML, with the settings, which XML does not hold in full.

    Args:
        xml: what `pickled` returned.
        cls: its class.
        given: its settings.
        attributes: others of a subclass, by name.
    """
    plain = inspect.unwrap(openmm.XmlSerializer._deserializeIntegrator)(xml)
    _give_class(plain, cls, given)
    vars(plain).update(copy.deepcopy(attributes))
    return plain


def _give_class(plain: Any, cls: type, found: settings.Settings) -> None:
    """Turn a CustomIntegrator into one of a class of this package, with settings and without a program."""
    variables = {plain.getGlobalVariableName(i) for i in range(plain.getNumGlobalVariables())}
    required = {installation.PARTS, *found.ensemble.counts}
    if found.flow().trial_steps:
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
    plain.binding = Binding(plain, found)
    plain.binding.stored.load()
    # The step may have been set where this package was not imported.
    same = math.isclose(step, found.step, rel_tol=1e-12)
    plain.binding.change(step=found.step if same else step)
