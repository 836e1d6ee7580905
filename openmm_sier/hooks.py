"""All changes to OpenMM's own classes.

OpenMM tells a Python integrator nothing about its Context. The methods below therefore do more than OpenMM's if the
Context has a SIER integrator, and exactly what OpenMM's do if it has another. They are for what users call; engines
call OpenMM's own (`system.own_methods`). Each stands beside what goes wrong without it:

- `Context.__init__`, `Context.reinitialize`: bind the integrator to the Context, and write its program for the System.
  *Without*: it has no engine, and a System that it cannot move is refused by nobody.
- `Context.setState`: accepts a State of any other integrator, and brings back no noise that was used. *Without*: OpenMM
  sets half of such a State and fails, and replicas that start from one State repeat each other.
- `Context.setPositions`, `setVelocities`, `setVelocitiesToTemperature`, `setPeriodicBoxVectors`, `loadCheckpoint`: tell
  the integrator. *Without*: the native engine goes on with forces and constraints of before, and a hot start of the
  user's counts as a runaway. A comparison before each call of `step` would read all atoms from a GPU.
- `Context.setVelocitiesToTemperature`, `applyConstraints`, `applyVelocityConstraints`: are this package's where
  OpenMM's solvers cannot satisfy the constraints. *Without*: these give velocities of 1e33 nm/ps, and positions that
  are NaN.
- `Context.createCheckpoint`, `XmlSerializer.serialize` of a State with the integrator's parameters: make the run go on
  exactly as a restart from their result would. `Context.getState` marks such a State. *Without*: restarts on one thread
  of the CPU platform are not bit-identical, since forces there depend on a list of neighbours that no file holds.
- `updateParametersInContext` of every Force: tells the integrator. *Without*: kicks use the forces of before.
- `System.setParticleMass`, `setConstraintParameters`, `removeForce`, `Force.setForceGroup`, `setPMEParameters` of every
  Force: are counted. *Without*: a System that was changed too late goes unnoticed, or all of it is compared at each
  call of `step`, which takes 5 to 10 µs for each Force.
- `LocalEnergyMinimizer.minimize`: keeps bodies rigid where no constraint holds them, or OpenMM's solvers cannot, and
  warns of overlaps that it leaves. *Without*: it tears them apart.
- `XmlSerializer.serialize`, `deserialize` and `clone` of an integrator: write one that OpenMM can execute without this
  package, and give back the SIER integrator that was stored. *Without*: they write one without a program, and give a
  CustomIntegrator whose steps are not those of the scheme.
"""

import functools
import weakref
from collections.abc import Callable
from typing import Any

import openmm

from openmm_sier.integrators.binding import Binding
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.settings import is_stored
from openmm_sier.integrators.storage import revived, written
from openmm_sier.system import tables
from openmm_sier.system.own_methods import mark_as_replaced, own_method
from openmm_sier.system.unchanged import UnchangedSystem


def install() -> None:
    """Replace the methods above. Calling it again changes nothing."""
    _replace(openmm.Context, "__init__", _bind)
    _replace(openmm.Context, "reinitialize", _bind_again)
    _replace(openmm.Context, "setState", _set_state)
    _replace(openmm.Context, "getState", _mark_state)
    for name in ("setPositions", "setVelocities"):
        _replace(openmm.Context, name, functools.partial(_pass_on, Binding.moved))
    _replace(openmm.Context, "setVelocitiesToTemperature", _draw_velocities)
    _replace(openmm.Context, "applyConstraints", functools.partial(_satisfy, False))
    _replace(openmm.Context, "applyVelocityConstraints", functools.partial(_satisfy, True))
    _replace(openmm.Context, "setPeriodicBoxVectors", functools.partial(_pass_on, Binding.box_changed))
    _replace(openmm.Context, "loadCheckpoint", functools.partial(_pass_on, Binding.take_over))
    _replace(openmm.Context, "createCheckpoint", functools.partial(_pass_on, Binding.start_anew))
    _replace(openmm.XmlSerializer, "serialize", _write_restart_point)
    # These change a System without changing the number of its particles, constraints or Forces.
    for name in ("setParticleMass", "setConstraintParameters", "removeForce"):
        _replace(openmm.System, name, _count_change)
    _replace(openmm.Force, "setForceGroup", _count_change)
    _replace(openmm.LocalEnergyMinimizer, "minimize", _keep_bodies)
    for cls in [member for member in vars(openmm).values() if isinstance(member, type)]:
        _replace(cls, "updateParametersInContext", _tell_of_new_forces)
        _replace(cls, "setPMEParameters", _count_change)
    _replace(openmm.XmlSerializer, "_serializeIntegrator", _write_integrator)
    for name in ("_deserializeIntegrator", "_cloneIntegrator"):
        _replace(openmm.XmlSerializer, name, _revive)


def _replace(cls: type, name: str, instead: Callable[..., Any]) -> None:
    """Replace a method by a function; one that replaced it earlier is removed.

    The function gets OpenMM's method, and then the arguments of each call. Where it reads an argument, that has
    OpenMM's name and default, `object` too, so that calls by keyword work.
    """
    if name not in vars(cls):
        return
    static = isinstance(vars(cls)[name], staticmethod)
    method = own_method(cls, name)

    @functools.wraps(method)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        return instead(method, *args, **kwargs)

    mark_as_replaced(wrapper)
    setattr(cls, name, staticmethod(wrapper) if static else wrapper)


def _binding_of(context: openmm.Context) -> Binding | None:
    integrator = getattr(context, "_integrator", None)
    return integrator.binding if isinstance(integrator, SIERIntegrator) else None


# --- a Context and its integrator ---


def _bind(method: Callable, context: openmm.Context, *args: Any, **kwargs: Any) -> None:
    # OpenMM's constructor takes its arguments by position.
    system, integrator, platform = (*args, None, None, None)[:3]
    if integrator is not None:
        _refuse_parts(integrator)
        revived(integrator, SIERIntegrator)
    if not isinstance(integrator, SIERIntegrator):
        method(context, *args, **kwargs)
        return
    with tables.read_once():
        integrator.binding.prepare(system, platform)
        method(context, *args, **kwargs)
        integrator.binding.bind(context)


def _refuse_parts(integrator: openmm.Integrator) -> None:
    """Refuse a CompoundIntegrator that contains a SIER integrator, since it would not call its Python part."""
    if not isinstance(integrator, openmm.CompoundIntegrator):
        return
    for i in range(integrator.getNumIntegrators()):
        part = integrator.getIntegrator(i)
        if isinstance(part, openmm.CustomIntegrator) and is_stored(part):
            raise openmm.OpenMMException("A SIER integrator cannot be part of a CompoundIntegrator")


def _bind_again(method: Callable, context: openmm.Context, preserveState: bool = False) -> None:
    method(context, preserveState)
    if binding := _binding_of(context):
        binding.bind(context, keeps_ledger=preserveState)


def _write_integrator(method: Callable, object: openmm.Integrator) -> str:
    return method(written(object) if isinstance(object, SIERIntegrator) else object)


def _revive(method: Callable, *args: Any, **kwargs: Any) -> openmm.Integrator:
    return revived(method(*args, **kwargs), SIERIntegrator)


# --- saved and loaded states ---


def _mark_state(method: Callable, context: openmm.Context, *args: Any, **kwargs: Any) -> openmm.State:
    """Change nothing; but a State that is written as XML later is a restart point."""
    state = method(context, *args, **kwargs)
    # Engines ask for forces several times a step, so that most calls are told by their arguments alone.
    may_have = args or kwargs.get("integratorParameters") or kwargs.get("getIntegratorParameters")
    if may_have and _binding_of(context) and state.getDataTypes() & openmm.State.IntegratorParameters:
        state._sier_origin = weakref.ref(context)
    return state


def _write_restart_point(method: Callable, object: Any) -> str:
    """Serialize a State with the integrator's parameters, such as `Simulation.saveState` writes, or anything else."""
    context = getattr(object, "_sier_origin", lambda: None)()
    is_current = context is not None and context.getStepCount() == object.getStepCount()
    if is_current and (binding := _binding_of(context)):
        binding.start_anew()
    return method(object)


def _set_state(method: Callable, context: openmm.Context, state: openmm.State) -> None:
    """Set a State as users of OpenMM's integrators know it.

    OpenMM would set all of a State of another kind of integrator and then fail on its parameters.
    """
    has_parameters = bool(state.getDataTypes() & openmm.State.IntegratorParameters)

    def set_state() -> None:
        try:
            method(context, state)
        except openmm.OpenMMException:
            if not has_parameters:
                raise
            _set_all_but_integrator(context, state)

    if binding := _binding_of(context):
        binding.take_over_state(set_state, has_parameters)
    else:
        method(context, state)


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


# --- changes from outside ---


def _pass_on(news: Callable, method: Callable, context: openmm.Context, *args: Any, **kwargs: Any) -> Any:
    """Tell an integrator by a method of `Binding` that a method of its Context was called."""
    found = method(context, *args, **kwargs)
    if binding := _binding_of(context):
        news(binding)
    return found


def _draw_velocities(method: Callable, context: openmm.Context, *args: Any) -> None:
    by_openmm = functools.partial(method, context, *args)
    if args and (binding := _binding_of(context)):
        binding.draw_velocities(by_openmm, *args)
    else:
        by_openmm()


def _satisfy(velocities: bool, method: Callable, context: openmm.Context, tol: float) -> None:
    by_openmm = functools.partial(method, context, tol)
    if binding := _binding_of(context):
        binding.satisfy(by_openmm, velocities)
    else:
        by_openmm()


def _tell_of_new_forces(method: Callable, force: Any, context: openmm.Context, *args: Any, **kwargs: Any) -> None:
    method(force, context, *args, **kwargs)
    if binding := _binding_of(context):
        binding.forces_changed()


def _count_change(method: Callable, *args: Any, **kwargs: Any) -> Any:
    UnchangedSystem.changes += 1
    return method(*args, **kwargs)


def _keep_bodies(
    method: Callable, context: openmm.Context, tolerance: Any = 10.0, maxIterations: int = 0, reporter: Any = None
) -> None:
    by_openmm = functools.partial(method, context, tolerance, maxIterations, reporter)
    if binding := _binding_of(context):
        binding.minimize(by_openmm, tolerance, maxIterations, reporter)
    else:
        by_openmm()
