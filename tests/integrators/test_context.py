"""Contexts of SIER integrators have methods of their own, and those of other integrators OpenMM's."""

import inspect

import openmm
import pytest

from openmm_sier import SIER2, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator, hooks
from openmm_sier.integrators.context import SIERContext
from tests.support.waters import context_at, platform

OVERRIDDEN = [name for name in vars(SIERContext) if hasattr(openmm.Context, name) and not name.startswith("__")]


def replaced_methods():
    """All methods of OpenMM that `hooks` has replaced, with their classes."""
    classes = [member for member in vars(openmm).values() if isinstance(member, type)]
    return [(cls, name) for cls in classes for name in vars(cls) if hooks.is_replaced(getattr(cls, name))]


def arguments(function):
    """Names, kinds and defaults of the arguments of a function."""
    return [(one.name, one.kind, one.default) for one in inspect.signature(function).parameters.values()]


def test_contexts_of_other_integrators_are_openmms(cluster):
    _, system, point = cluster
    ours = context_at(system, SIERIntegrator(0.002, SIER2), point)
    theirs = context_at(system, openmm.VerletIntegrator(0.002), point)
    assert type(ours) is SIERContext
    assert type(theirs) is openmm.Context
    assert [name for cls, name in replaced_methods() if cls is openmm.Context] == ["__init__"]


def test_a_subclass_of_context_is_refused(cluster):
    class Context(openmm.Context):
        pass

    with pytest.raises(openmm.OpenMMException, match="of a subclass"):
        Context(cluster[1], SIERIntegrator(0.002, SIER2), platform())
    Context(cluster[1], openmm.VerletIntegrator(0.002), platform())


@pytest.mark.parametrize("engine", ["exact", "native"])
@pytest.mark.parametrize("make", [SIERLangevinIntegrator, SIERHMCIntegrator], ids=["bath", "trials"])
def test_engines_call_openmms_own_methods(box, engine, make, monkeypatch):
    """An engine's own changes must not trigger the hooks, which would make it read all atoms."""
    _, system, point = box
    called = []

    def noted(name):
        method = getattr(SIERContext, name)

        def wrapper(*args, **kwargs):
            called.append(name)
            return method(*args, **kwargs)

        return wrapper

    if make is SIERHMCIntegrator:
        integrator, steps = SIERHMCIntegrator(300.0, 0.002, stepsPerTrial=2, pressure=1.0, engine=engine), 2
    else:
        integrator, steps = SIERLangevinIntegrator(300.0, 1.0, 0.002, pressure=1.0, engine=engine), 50
    context = context_at(system, integrator, point)
    for name in OVERRIDDEN:
        monkeypatch.setattr(SIERContext, name, noted(name))
    # Two moves of the volume.
    integrator.step(steps)
    integrator.getWholeStepState()
    integrator.computeTemperatures()
    openmm.LocalEnergyMinimizer.minimize(context, maxIterations=1)
    assert called == []
    context.setVelocitiesToTemperature(300.0, 1)
    context.applyConstraints(1e-6)
    context.applyVelocityConstraints(1e-6)
    integrator.step(2)
    context.createCheckpoint()
    assert called == ["setVelocitiesToTemperature", "applyConstraints", "applyVelocityConstraints", "createCheckpoint"]


@pytest.mark.parametrize("name", OVERRIDDEN)
def test_overridden_methods_have_the_signatures_of_openmm(name):
    assert arguments(getattr(SIERContext, name)) == arguments(getattr(openmm.Context, name))


@pytest.mark.parametrize(("cls", "name"), replaced_methods(), ids=lambda value: getattr(value, "__name__", value))
def test_replaced_methods_have_the_arguments_of_openmm(cls, name):
    """As far as the function that replaces a method reads them: others are passed on as they are."""
    method = getattr(cls, name)
    function = inspect.getclosurevars(method).nonlocals["instead"]
    passed = ["method"] if isinstance(vars(cls)[name], staticmethod) else ["method", "self"]
    parameters = inspect.signature(method.__wrapped__).parameters.values()
    named = [one for one in list(parameters)[len(passed) - 1 :] if one.kind is not one.VAR_POSITIONAL]
    inspect.signature(function).bind(*passed, **{one.name: one.default for one in named})
    defaults = {one.name: one.default for one in inspect.signature(function).parameters.values()}
    for one in named:
        assert defaults.get(one.name, one.default) == one.default
