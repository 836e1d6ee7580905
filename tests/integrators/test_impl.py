"""What joins an integrator to its Context stands behind one name, and belongs to one Context."""

import pathlib
import sys

import openmm
import pytest

import openmm_sier
from openmm_sier import SIERIntegrator, SIERLangevinIntegrator
from tests.support.samplers import states_asked
from tests.support.seeded import seeded
from tests.support.waters import cluster_system, context_at, phase_point

PACKAGE = pathlib.Path(openmm_sier.__file__).parent


def test_an_integrator_whose_context_was_refused_says_so():
    _, _positions, system = cluster_system(2)
    integrator = SIERLangevinIntegrator(300, 5, 0.002, pressure=1)
    with pytest.raises(openmm.OpenMMException, match="periodic"):
        openmm.Context(system, integrator)
    with pytest.raises(openmm.OpenMMException, match="no longer exists, or was refused"):
        openmm.Context(system, integrator)


def test_computations_of_others_are_refused():
    _, _, system = cluster_system(2)
    integrator = SIERLangevinIntegrator(300, 5, 0.002)
    integrator.addComputePerDof("v", "0.5*v")
    with pytest.raises(openmm.OpenMMException, match=r"has \d+ now"):
        openmm.Context(system, integrator)


@pytest.mark.parametrize(("engine", "written"), [("exact", 1), ("native", 0)])
def test_a_call_of_step_reads_no_atoms_and_writes_them_once(cluster, engine, written, monkeypatch):
    """Nor does it touch a variable of the integrator: those are written for checkpoints, States and XML."""
    _, system, point = cluster
    integrator = SIERIntegrator(0.002, "SIER2", engine=engine)
    context = context_at(system, integrator, point, steps=10)
    requests, called = states_asked(monkeypatch), []

    def noted(name):
        function = getattr(openmm.openmm._openmm, name)

        def wrapper(*args):
            called.append(name)
            return function(*args)

        return wrapper

    for name in dir(openmm.openmm._openmm):
        if name.startswith("Context_set") or (name.startswith("CustomIntegrator_") and "Variable" in name):
            monkeypatch.setattr(openmm.openmm._openmm, name, noted(name))
    # The watch for runaways reads velocities now and then.
    monkeypatch.setattr(integrator.impl.session.watch, "look", lambda *_: None)
    integrator.step(10)
    assert not any(kinds & (openmm.State.Positions | openmm.State.Velocities) for kinds in requests)
    assert called.count("Context_setVelocities") == written
    assert called.count("Context_setPositions") == 10 * written
    assert not [name for name in called if "Variable" in name]
    context.createCheckpoint()
    assert "CustomIntegrator_setGlobalVariableByName" in called


@pytest.mark.parametrize(("engine", "most"), [("exact", 14), ("native", 8)])
def test_a_call_of_step_goes_through_few_functions(cluster, engine, most):
    """So that one can read all of it; compiled loops over bodies are not counted."""
    _, system, point = cluster
    integrator = SIERIntegrator(0.002, engine=engine)
    context = context_at(system, integrator, point, steps=10)
    # The watch for runaways looks now and then.
    integrator.impl.session.watch.pause = 1000
    functions = set()

    def note(frame, event, _argument):
        path = pathlib.Path(frame.f_code.co_filename)
        if event == "call" and PACKAGE in path.parents and path.parent.name != "kernels":
            functions.add((path.name, frame.f_code.co_name, frame.f_code.co_firstlineno))

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        integrator.step(10)
    finally:
        sys.setprofile(before)
    assert context.getStepCount() == 20
    assert 0 < len(functions) <= most, sorted(functions)


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_an_integrator_that_is_offered_to_a_second_context_stays_that_of_the_first(cluster, engine):
    """The native engine's heat was lost then."""
    _, system, point = cluster
    ends = []
    for is_offered in (False, True):
        integrator = seeded(SIERLangevinIntegrator(300, 5, 0.002, engine=engine))
        context = context_at(system, integrator, point, steps=3)
        if is_offered:
            with pytest.raises(openmm.OpenMMException, match="already bound"):
                openmm.Context(system, integrator)
        integrator.step(3)
        ends.append((integrator.getHeat(), *phase_point(context)[0].tolist()))
    assert ends[0] == ends[1]
