"""What checkpoints, States, XML and copies carry of an integrator.

For OpenMM an integrator is a CustomIntegrator with settings, variables and a program. Checkpoints and States have the
variables: they are written before one is made and read after one was loaded. XML has settings and variables. When it is
read, it becomes the SIER integrator again, which gets a program with a Context. Where this package is not imported it
fails at the first step.
"""

import copy
import inspect
import math
from collections.abc import Callable
from typing import Any

import openmm

from openmm_sier.dynamics.stages import BATH
from openmm_sier.engines.native import installation
from openmm_sier.engines.records import Changes
from openmm_sier.engines.variables import load_tally, write_tally
from openmm_sier.integrators import settings
from openmm_sier.integrators.impl import IntegratorImpl
from openmm_sier.system.user_warnings import warn

# --- checkpoints and States ---


def store(impl: IntegratorImpl) -> None:
    """Write all that checkpoints, States and XML carry to the variables of the integrator.

    Raises:
        openmm.OpenMMException: a thread is making a step.
    """
    impl.session.refuse_between_steps()
    engine = impl.session.engine_or_none
    if engine is not None:
        engine.store()
    write_tally(impl.integrator, impl.tally)
    impl.set_program_variables()


def take_over(context: openmm.Context, impl: IntegratorImpl) -> None:
    """Take over a State or checkpoint that was loaded, of either engine.

    The program counts heat for each degree of freedom. Its sum is added to the total that both engines use.
    """
    load_tally(impl.integrator, impl.tally)
    impl.tally.heat += installation.take_heat(context)
    impl.set_program_variables()
    impl.session.changed(Changes.VARIABLES | Changes.ATOMS | Changes.HISTORY)


def load_checkpoint(context: openmm.Context, impl: IntegratorImpl, load: Callable[[], None]) -> None:
    """Call a function that loads a checkpoint, and take over what it holds."""
    # OpenMM loads a checkpoint in parts, of which the last may be damaged.
    with impl.session.changing(Changes.ATOMS):
        load()
    take_over(context, impl)


def set_state(
    context: openmm.Context, impl: IntegratorImpl, set_in_context: Callable[[], None], has_parameters: bool
) -> None:
    """Call a function that sets a State, and take over what the State holds, except its seed and its used noise.

    Runs with different seeds from one State differ, and so do replicas that share a Context.

    Args:
        context: the Context.
        impl: the Python part of its integrator.
        set_in_context: sets the State in the Context.
        has_parameters: whether the State has those of an integrator. If so, warn once where the noise goes on
            differently than in the run that wrote the State.
    """
    tally = impl.tally
    seed, draws = tally.seed, tally.draws
    if has_parameters:
        # A State of another version may lack some.
        store(impl)
    # OpenMM sets a State in parts.
    with impl.session.changing(Changes.BOX | Changes.ATOMS):
        set_in_context()
    if not has_parameters:
        return
    take_over(context, impl)
    tally.seed = seed
    tally.draws = max(draws, tally.draws)
    if not impl.has_warned_of_noise:
        impl.has_warned_of_noise = _warn_about_noise(impl)


def _warn_about_noise(impl: IntegratorImpl) -> bool:
    """Warn if a State does not hold the noise of a run; return whether a warning was given."""
    engine = impl.session.engine_or_none
    if engine is None or engine.repeats_noise:
        return False
    if not (engine.makes_trials or BATH in impl.method().scheme.operators):
        return False
    warn(
        f"With the {engine.name} engine a State does not hold the noise of Langevin dynamics and of trials, which is "
        "OpenMM's: the run continues in the same ensemble, but on another trajectory. To continue the same trajectory, "
        "load a checkpoint"
    )
    return True


# --- XML and copies ---


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
    load_tally(plain, plain.impl.tally)
    # The step may have been set without this package.
    same = math.isclose(step, values.step, rel_tol=1e-12)
    plain.impl.change(step=values.step if same else step)
