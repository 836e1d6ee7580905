"""All methods that are replaced in OpenMM's own classes.

OpenMM tells a Python integrator nothing about its Context. So a Context with a SIER integrator becomes a `SIERContext`
(`integrators/context.py`), whose methods extend OpenMM's; other Contexts do not change. The methods below do not belong
to a Context. They do what OpenMM's do unless they get a SIER integrator or its Context. Their purposes, and the
consequences without them:

- `Context.__init__`: writes the integrator's program for the System, and makes the engine and the `SIERContext`.
  *Without*: there is no engine, and a System that it cannot move is not refused. Registers each Context, with any
  integrator, in `system/bound_systems.py`. *Without*: a System is prepared too late, and nothing follows.
- `updateParametersInContext` of every Force: notifies the integrator. *Without*: kicks use cached forces of the old
  parameters.
- `LocalEnergyMinimizer.minimize`: keeps bodies rigid that have no constraints, or constraints that OpenMM's solvers
  cannot satisfy. *Without*: it tears these bodies apart.
- `XmlSerializer._serializeIntegrator`, `_deserializeIntegrator` and `_cloneIntegrator`, which `serialize`,
  `deserialize` and `clone` call for integrators: write an integrator that fails where this package is not imported, and
  return the SIER integrator that was stored. *Without*: they write one without a program, and return a CustomIntegrator
  whose steps are not those of the scheme.
"""

import functools
from collections.abc import Callable
from typing import Any

import openmm

from openmm_sier.integrators.context import SIERContext
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.settings import is_stored
from openmm_sier.integrators.storage import revived, written
from openmm_sier.system import bound_systems, tables


def install() -> None:
    """Replace the methods above. A second call changes nothing."""
    _replace(openmm.Context, "__init__", _bind)
    _replace(openmm.LocalEnergyMinimizer, "minimize", _keep_bodies)
    for cls in [member for member in vars(openmm).values() if isinstance(member, type)]:
        if "updateParametersInContext" in vars(cls):
            _replace(cls, "updateParametersInContext", _notify_integrator)
    _replace(openmm.XmlSerializer, "_serializeIntegrator", _write_integrator)
    for name in ("_deserializeIntegrator", "_cloneIntegrator"):
        _replace(openmm.XmlSerializer, name, _revive)


def is_replaced(function: Callable[..., Any]) -> bool:
    """Return whether a function replaces a method of OpenMM, its `__wrapped__`, by `install`."""
    return hasattr(function, "_of_openmm_sier")


def _replace(cls: type, name: str, instead: Callable[..., Any]) -> None:
    """Replace a method by a function; an earlier replacement is removed.

    The function gets OpenMM's method, followed by the arguments of each call. Arguments that it reads have OpenMM's
    names and defaults, even `object`, so that calls by keyword work.
    """
    is_static = isinstance(vars(cls)[name], staticmethod)
    method = getattr(cls, name)
    if is_replaced(method):
        method = method.__wrapped__

    @functools.wraps(method)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        return instead(method, *args, **kwargs)

    wrapper._of_openmm_sier = True  # type: ignore[attr-defined]
    setattr(cls, name, staticmethod(wrapper) if is_static else wrapper)


# --- a Context and its integrator ---


def _bind(method: Callable, context: openmm.Context, *args: Any, **kwargs: Any) -> None:
    # OpenMM's constructor takes its arguments by position.
    system, integrator, platform = (*args, None, None, None)[:3]
    if integrator is not None:
        _refuse_compound(integrator)
        revived(integrator, SIERIntegrator)
    if not isinstance(integrator, SIERIntegrator):
        method(context, *args, **kwargs)
        bound_systems.add(context)
        return
    if type(context) is not openmm.Context:
        raise openmm.OpenMMException("A SIER integrator needs an openmm.Context itself, and this is of a subclass")
    with tables.read_once():
        integrator.impl.prepare(system, platform)
        method(context, *args, **kwargs)
        context.__class__ = SIERContext
        integrator.impl.bind(context)
    bound_systems.add(context)


def _refuse_compound(integrator: openmm.Integrator) -> None:
    """Refuse a CompoundIntegrator with a SIER integrator, whose Python part it would not call."""
    if not isinstance(integrator, openmm.CompoundIntegrator):
        return
    for i in range(integrator.getNumIntegrators()):
        member = integrator.getIntegrator(i)
        if isinstance(member, openmm.CustomIntegrator) and is_stored(member):
            raise openmm.OpenMMException("A SIER integrator cannot be part of a CompoundIntegrator")


def _notify_integrator(method: Callable, force: Any, context: openmm.Context, *args: Any, **kwargs: Any) -> None:
    if isinstance(context, SIERContext):
        with context.session.changing_force(force):
            method(force, context, *args, **kwargs)
    else:
        method(force, context, *args, **kwargs)


def _keep_bodies(
    method: Callable, context: openmm.Context, tolerance: Any = 10.0, maxIterations: int = 0, reporter: Any = None
) -> None:
    by_openmm = functools.partial(method, context, tolerance, maxIterations, reporter)
    if isinstance(context, SIERContext):
        context.session.act("minimize", by_openmm, tolerance, maxIterations, reporter)
    else:
        by_openmm()


# --- integrators as XML ---


def _write_integrator(method: Callable, object: openmm.Integrator) -> str:
    return method(written(object) if isinstance(object, SIERIntegrator) else object)


def _revive(method: Callable, *args: Any, **kwargs: Any) -> openmm.Integrator:
    return revived(method(*args, **kwargs), SIERIntegrator)
