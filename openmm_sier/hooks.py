"""All changes to OpenMM's own classes.

OpenMM tells a Python integrator nothing about its Context. These methods therefore do more than OpenMM's if the Context
has a SIER integrator, and exactly what OpenMM's do if it has another:

- `Context.__init__` and `Context.reinitialize` bind the integrator to the Context and refuse a System that it cannot
  move. `reinitialize` without the state also clears the heat and the count of random numbers.
- `Context.setState` accepts a State of any other integrator, and does not let a State bring back noise that was used.
- `Context.setPositions`, `setVelocities`, `setVelocitiesToTemperature` and `loadCheckpoint` tell the integrator that
  atoms were moved, which the native engine would not notice by itself.
- `Context.createCheckpoint`, and `XmlSerializer.serialize` of a State with the integrator's parameters, make the run
  continue exactly as a restart from their result would. `Context.getState` marks such a State and changes nothing.
- `updateParametersInContext` of every Force tells the integrator that forces have changed.
- `System.removeForce`, `Force.setForceGroup` and `NonbondedForce.setPMEParameters` are counted, so that an integrator
  looks for changes of its System only after one of them.
- `LocalEnergyMinimizer.minimize` keeps bodies rigid where no constraint holds them.
- `XmlSerializer.deserialize` and `XmlSerializer.clone` give back the SIER integrator that was stored.
"""

from __future__ import annotations

import functools
import inspect
import weakref
from collections.abc import Callable
from typing import Any, TypeAlias

import openmm

from openmm_sier.dynamics.stages import BATH
from openmm_sier.engines.variables import DRAWS, SEED
from openmm_sier.integrators.copies import revived
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.settings import is_stored
from openmm_sier.system.notices import tell
from openmm_sier.system.unchanged import UnchangedSystem

#: A method of OpenMM, or its wrapper, which an attribute marks as such.
Method: TypeAlias = Any


#: Methods that change a System without changing the number of its particles, constraints or Forces.
_CHANGES_OF_SYSTEMS = (
    (openmm.System, "removeForce"),
    (openmm.Force, "setForceGroup"),
    (openmm.NonbondedForce, "setPMEParameters"),
)


def install() -> None:
    """Replace the methods above. Calling it again changes nothing."""
    _replace(openmm.Context, "__init__", _binding_new_context)
    _replace(openmm.Context, "reinitialize", _binding_again)
    _replace(openmm.Context, "setState", _accepting)
    for name in ("setPositions", "setVelocities", "setVelocitiesToTemperature"):
        _replace(openmm.Context, name, _telling_of_moved_atoms)
    _replace(openmm.Context, "loadCheckpoint", _loading)
    _replace(openmm.Context, "createCheckpoint", _going_on_as_a_restart)
    _replace(openmm.Context, "getState", _marking_states)
    _replace(openmm.XmlSerializer, "serialize", _writing_restart_points)
    for owner, name in _CHANGES_OF_SYSTEMS:
        _replace(owner, name, _counting_changes)
    _replace(openmm.LocalEnergyMinimizer, "minimize", _keeping_bodies)
    for cls in [member for member in vars(openmm).values() if isinstance(member, type)]:
        _replace(cls, "updateParametersInContext", _telling_of_new_forces)
    for name in ("_deserializeIntegrator", "_cloneIntegrator"):
        _replace(openmm.XmlSerializer, name, _reviving)


def _replace(cls: type, name: str, wrap: Callable[[Method], Method]) -> None:
    """Replace a method by its wrapper. An earlier wrapper of this package is removed first."""
    if name not in vars(cls):
        return
    found = vars(cls)[name]
    static = isinstance(found, staticmethod)
    method = found.__func__ if static else found
    if getattr(method, "_of_openmm_sier", False):
        method = inspect.unwrap(method, stop=lambda f: not getattr(f, "_of_openmm_sier", False))
    wrapper = wrap(method)
    wrapper._of_openmm_sier = True
    setattr(cls, name, staticmethod(wrapper) if static else wrapper)


def _binding_new_context(method: Method) -> Method:
    """`Context.__init__`: bind the integrator too."""

    @functools.wraps(method)
    def wrapper(self: Any, *args: Any, **kwargs: Any) -> Any:
        # OpenMM's constructor takes its arguments by position.
        if len(args) > 1:
            _refuse_parts(args[1])
            if isinstance(revived(args[1], SIERIntegrator), SIERIntegrator):
                args[1]._prepare_for(args[0])
        method(self, *args, **kwargs)
        if (integrator := _integrator_of(self)) is not None:
            integrator._bind(self)

    return wrapper


def _binding_again(method: Method) -> Method:
    """`Context.reinitialize`: bind the integrator again, since the System may have changed."""

    @functools.wraps(method)
    def wrapper(self: Any, preserveState: bool = False) -> Any:
        result = method(self, preserveState)
        if (integrator := _integrator_of(self)) is not None:
            # OpenMM clears the per-atom variables without the state, but not the global ones.
            if not preserveState:
                integrator._record.clear()
            integrator._bind(self)
        return result

    return wrapper


def _going_on_as_a_restart(method: Method) -> Method:
    """`Context.createCheckpoint`: afterwards the run goes on from the same values as a restart would."""

    @functools.wraps(method)
    def wrapper(self: Any) -> bytes:
        found = method(self)
        integrator = _integrator_of(self)
        if integrator is not None and integrator._engine is not None:
            integrator._engine.start_anew()
        return found

    return wrapper


def _marking_states(method: Method) -> Method:
    """`Context.getState` changes nothing; but a State that is written as XML later is a restart point."""

    @functools.wraps(method)
    def wrapper(self: Any, *args: Any, **kwargs: Any) -> openmm.State:
        state = method(self, *args, **kwargs)
        integrator = _integrator_of(self)
        if integrator is not None and state.getDataTypes() & openmm.State.IntegratorParameters:
            state._sier_origin = weakref.ref(self)
        return state

    return wrapper


def _writing_restart_points(method: Method) -> Method:
    """`XmlSerializer.serialize` of a State with the integrator's parameters, such as `Simulation.saveState` writes."""

    @functools.wraps(method)
    def wrapper(thing: Any) -> str:
        context = getattr(thing, "_sier_origin", lambda: None)()
        if context is not None and context.getStepCount() == thing.getStepCount():
            integrator = _integrator_of(context)
            if integrator is not None and integrator._engine is not None:
                integrator._engine.start_anew()
        return method(thing)

    return wrapper


def _telling_of_new_forces(method: Method) -> Method:
    """`updateParametersInContext` of a Force: forces computed earlier are no longer valid."""

    @functools.wraps(method)
    def wrapper(self: Any, context: openmm.Context, *args: Any, **kwargs: Any) -> Any:
        result = method(self, context, *args, **kwargs)
        integrator = _integrator_of(context)
        if integrator is not None and integrator._engine is not None:
            integrator.forcesChanged()
        return result

    return wrapper


def _counting_changes(method: Method) -> Method:
    """Methods that change a System, maybe one that has a Context."""

    @functools.wraps(method)
    def wrapper(self: Any, *args: Any, **kwargs: Any) -> Any:
        UnchangedSystem.changes += 1
        return method(self, *args, **kwargs)

    return wrapper


def _keeping_bodies(method: Method) -> Method:
    """`LocalEnergyMinimizer.minimize`, which would deform bodies that are rigid without constraints."""

    @functools.wraps(method)
    def wrapper(context: openmm.Context, tolerance: Any = 10.0, maxIterations: int = 0, reporter: Any = None) -> Any:
        integrator = _integrator_of(context)
        if integrator is None:
            return method(context, tolerance, maxIterations, reporter)
        by_openmm = functools.partial(method, context, tolerance, maxIterations, reporter)
        return integrator._bound().minimize(by_openmm, tolerance, maxIterations, reporter)

    return wrapper


def _accepting(method: Method) -> Method:
    """`Context.setState` as users of OpenMM's integrators know it.

    A State saved by another kind of integrator, for example after an equilibration, is accepted. OpenMM would set all
    of it and then fail on the parameters of that integrator. As with OpenMM's integrators, a State does not bring back
    noise that was already used: runs with different seeds from one State differ, and so do replicas that share a
    Context.
    """

    @functools.wraps(method)
    def wrapper(self: Any, state: openmm.State) -> Any:
        integrator = _integrator_of(self)
        if integrator is None:
            return method(self, state)
        seed, draws = map(integrator.getGlobalVariableByName, (SEED, DRAWS))
        try:
            method(self, state)
        except openmm.OpenMMException:
            if not state.getDataTypes() & openmm.State.IntegratorParameters:
                raise
            _set_all_but_integrator(self, state)
        integrator.setGlobalVariableByName(SEED, seed)
        integrator.setGlobalVariableByName(DRAWS, max(draws, integrator.getGlobalVariableByName(DRAWS)))
        integrator._take_over()
        if state.getDataTypes() & openmm.State.IntegratorParameters:
            _tell_of_lost_noise(integrator)
        return None

    return wrapper


def _tell_of_lost_noise(integrator: SIERIntegrator) -> None:
    """After a State was loaded, say once where noise goes on differently than in the run that wrote the State."""
    if integrator._engine is None or integrator._engine.repeats_noise or integrator._told_of_noise:
        return
    if BATH in integrator._flow().scheme.operators:
        integrator._told_of_noise = True
        tell(
            "With the native engine the noise of Langevin dynamics is OpenMM's, which no State holds: the run goes on "
            "in the same ensemble, but not on the same trajectory. A checkpoint repeats it bit for bit"
        )


def _telling_of_moved_atoms(method: Method) -> Method:
    """A method of the Context that sets positions or velocities."""

    @functools.wraps(method)
    def wrapper(self: Any, *args: Any, **kwargs: Any) -> Any:
        result = method(self, *args, **kwargs)
        integrator = _integrator_of(self)
        if integrator is not None and integrator._engine is not None:
            integrator._watch.forget()
            integrator._engine.atoms_moved()
        return result

    return wrapper


def _loading(method: Method) -> Method:
    """`Context.loadCheckpoint`: the checkpoint may come from the other engine."""

    @functools.wraps(method)
    def wrapper(self: Any, checkpoint: bytes) -> Any:
        method(self, checkpoint)
        if (integrator := _integrator_of(self)) is not None:
            integrator._take_over()

    return wrapper


def _set_all_but_integrator(context: openmm.Context, state: openmm.State) -> None:
    """Do what `Context.setState` does, errors included, except for the parameters of the integrator."""
    context.setTime(state.getTime())
    context.setStepCount(state.getStepCount())
    context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    kinds = state.getDataTypes()
    if kinds & openmm.State.Parameters:
        for name, value in state.getParameters().items():
            context.setParameter(name, value)
    if kinds & openmm.State.Positions:
        context.setPositions(state.getPositions(asNumpy=True))
    if kinds & openmm.State.Velocities:
        context.setVelocities(state.getVelocities(asNumpy=True))


def _reviving(method: Method) -> Method:
    """Functions that read or clone an integrator from its serialized form."""

    @functools.wraps(method)
    def wrapper(source: str) -> Any:
        return revived(method(source), SIERIntegrator)

    return wrapper


def _integrator_of(context: openmm.Context) -> SIERIntegrator | None:
    integrator = getattr(context, "_integrator", None)
    return integrator if isinstance(integrator, SIERIntegrator) else None


def _refuse_parts(integrator: openmm.Integrator) -> None:
    """Refuse a CompoundIntegrator that contains a SIER integrator, since it would not call its Python part."""
    if not isinstance(integrator, openmm.CompoundIntegrator):
        return
    for i in range(integrator.getNumIntegrators()):
        part = integrator.getIntegrator(i)
        if isinstance(part, openmm.CustomIntegrator) and is_stored(part):
            raise openmm.OpenMMException("A SIER integrator cannot be part of a CompoundIntegrator")
