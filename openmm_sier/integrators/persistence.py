"""What checkpoints and States carry of an integrator, written before one is made and read after one was loaded."""

from collections.abc import Callable

import openmm

from openmm_sier.dynamics.stages import BATH
from openmm_sier.engines.native import installation
from openmm_sier.engines.records import Changes
from openmm_sier.integrators.impl import IntegratorImpl
from openmm_sier.system.user_warnings import warn


def store(impl: IntegratorImpl) -> None:
    """Write all that checkpoints, States and XML carry to the variables of the integrator.

    Raises:
        openmm.OpenMMException: a thread is making a step.
    """
    impl.session.refuse_between_steps()
    engine = impl.session.engine_or_none
    if engine is not None:
        engine.store()
    impl.stored.write()
    impl.set_program_variables()


def take_over(context: openmm.Context, impl: IntegratorImpl) -> None:
    """Take over a State or checkpoint that was loaded, of either engine.

    The program counts heat for each degree of freedom. Its sum is added to the total that both engines use.
    """
    impl.stored.load()
    impl.stored.tally.heat += installation.take_heat(context)
    impl.set_program_variables()
    impl.session.changed(Changes.VARIABLES | Changes.ATOMS)


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
    tally = impl.stored.tally
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
