"""All methods that are replaced in OpenMM's own classes.

OpenMM tells a Python integrator nothing about its Context. So a Context with a SIER integrator becomes a `SIERContext`
(`integrators/context.py`), whose methods do more than OpenMM's; others stay as they are. The methods below belong to no
Context. They do exactly what OpenMM's do unless they get a SIER integrator or its Context. Each stands beside what goes
wrong without it:

- `Context.__init__`: writes the integrator's program for the System, and makes the engine and the `SIERContext`.
  *Without*: there is no engine, and a System that it cannot move is refused by nobody.
- `updateParametersInContext` of every Force: tells the integrator. *Without*: kicks use the forces of before.
- `LocalEnergyMinimizer.minimize`: keeps bodies rigid where no constraint holds them, or OpenMM's solvers cannot, and
  warns of overlaps that it leaves. *Without*: it tears them apart.
- `XmlSerializer._serializeIntegrator`, `_deserializeIntegrator` and `_cloneIntegrator`, of which `serialize`,
  `deserialize` and `clone` of an integrator consist: write one that OpenMM can execute without this package, and give
  back the SIER integrator that was stored. *Without*: they write one without a program, and give a CustomIntegrator
  whose steps are not those of the scheme.
"""

import functools
from collections.abc import Callable
from typing import Any

import openmm

from openmm_sier.engines.protocol import Change
from openmm_sier.integrators.context import SIERContext
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.settings import is_stored
from openmm_sier.integrators.storage import revived, written
from openmm_sier.system import tables


def install() -> None:
    """Replace the methods above. Calling it again changes nothing."""
    _replace(openmm.Context, "__init__", _bind)
    _replace(openmm.LocalEnergyMinimizer, "minimize", _keep_bodies)
    for cls in [member for member in vars(openmm).values() if isinstance(member, type)]:
        if "updateParametersInContext" in vars(cls):
            _replace(cls, "updateParametersInContext", _tell_of_new_forces)
    _replace(openmm.XmlSerializer, "_serializeIntegrator", _write_integrator)
    for name in ("_deserializeIntegrator", "_cloneIntegrator"):
        _replace(openmm.XmlSerializer, name, _revive)


def is_replaced(function: Callable[..., Any]) -> bool:
    """Return whether `install` has put a function in the place of a method, its `__wrapped__`."""
    return hasattr(function, "_of_openmm_sier")


def _replace(cls: type, name: str, instead: Callable[..., Any]) -> None:
    """Replace a method by a function; one that replaced it earlier is removed.

    The function gets OpenMM's method, and then the arguments of each call. Where it reads an argument, that has
    OpenMM's name and default, `object` too, so that calls by keyword work.
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
        _refuse_parts(integrator)
        revived(integrator, SIERIntegrator)
    if not isinstance(integrator, SIERIntegrator):
        method(context, *args, **kwargs)
        return
    if type(context) is not openmm.Context:
        raise openmm.OpenMMException("A SIER integrator needs an openmm.Context itself, and this is of a subclass")
    with tables.read_once():
        integrator.binding.prepare(system, platform)
        method(context, *args, **kwargs)
        context.__class__ = SIERContext
        integrator.binding.bind(context)


def _refuse_parts(integrator: openmm.Integrator) -> None:
    """Refuse a CompoundIntegrator that contains a SIER integrator, since it would not call its Python part."""
    if not isinstance(integrator, openmm.CompoundIntegrator):
        return
    for i in range(integrator.getNumIntegrators()):
        part = integrator.getIntegrator(i)
        if isinstance(part, openmm.CustomIntegrator) and is_stored(part):
            raise openmm.OpenMMException("A SIER integrator cannot be part of a CompoundIntegrator")


def _tell_of_new_forces(method: Callable, force: Any, context: openmm.Context, *args: Any, **kwargs: Any) -> None:
    method(force, context, *args, **kwargs)
    if isinstance(context, SIERContext):
        context.binding.changed(Change.FORCES)


def _keep_bodies(
    method: Callable, context: openmm.Context, tolerance: Any = 10.0, maxIterations: int = 0, reporter: Any = None
) -> None:
    by_openmm = functools.partial(method, context, tolerance, maxIterations, reporter)
    if isinstance(context, SIERContext):
        context.binding.minimize(by_openmm, tolerance, maxIterations, reporter)
    else:
        by_openmm()


# --- integrators as XML ---


def _write_integrator(method: Callable, object: openmm.Integrator) -> str:
    return method(written(object) if isinstance(object, SIERIntegrator) else object)


def _revive(method: Callable, *args: Any, **kwargs: Any) -> openmm.Integrator:
    return revived(method(*args, **kwargs), SIERIntegrator)
