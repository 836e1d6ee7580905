"""Laws 3 and 4: what is asked for is there, and the future depends on what is visible."""

import copy
import inspect

import numpy as np
import openmm

from tests.laws.actions import Step
from tests.laws.runs import REFUSALS, Run, started
from tests.support.restarts import assert_same

#: nm and nm/ps: two Contexts at the same view differ by rounding, which three steps and what is asked between them
#: magnify little. The exact engine reads its bodies from the atoms, to 1e-15 nm; OpenMM's solvers stop at a relative
#: tolerance of 1e-9 of lengths, which is divided by the step for velocities. A change that was missed displaces atoms by
#: 1e-6 nm or more.
ROUNDING = {"exact": (1e-10, 1e-7), "native": (1e-8, 1e-5)}


def tried(run, action):
    """Do an action and assert that it shows; return whether it was done, and not refused."""
    if not action.applies(run):
        return False
    before = run.view()
    try:
        action.act(run)
    except REFUSALS:
        # A step that fails leaves the last completed one, which law 5 judges.
        if not isinstance(action, Step):
            run.view().assert_near(before, 0)
        return False
    action.shows(run, before, run.view())
    return True


def end(run, steps=2):
    """Make steps; return the error, if there is one."""
    try:
        run.integrator.step(steps)
    except REFUSALS as error:
        return f"{type(error).__name__}: {error}"
    return None


def what_is_asked_for_is_there(mixture, method, asked, name="Reference"):
    """Law 3. Questions and what is refused change nothing, now and later."""
    run = started(mixture, method, name)
    done = [action for action in asked if tried(run, action)]
    error = end(run)
    twin = Run(mixture, run.method, name)
    twin.integrator.step(0)
    for action in done:
        if action.changes:
            action.act(twin)
    of_twin = end(twin)
    assert of_twin == error, f"{error} in place of {of_twin}, without questions and what was refused"
    assert_same(run.everything(), twin.everything())




# --- settings ---------------------------------------------------------------------------------------------------------


def argument_of(cls, setter):
    """Return the name of the constructor's argument that a setter sets; None if there is none."""
    name = setter[3].lower() + setter[4:]
    return next((argument for argument in inspect.signature(cls).parameters if argument.startswith(name)), None)


def outcome(run, steps=3):
    """Return all that a run is after some steps, or None if they are refused."""
    return None if end(run, steps) else run.everything()


def a_setter_does_what_the_argument_does(mixture, method, setting, aged, name="Reference"):
    """Law 3. A setter of a bound integrator gives the run of one that was set before, or the same refusal."""
    run = started(mixture, method, name)
    if aged:
        start = run.context.createCheckpoint()
        end(run, 2)
        run.context.loadCheckpoint(start)
    if not tried(run, setting):
        return
    found = outcome(run)
    # A seed is for the next Context.
    settings = [] if setting.name == "setRandomNumberSeed" else [(setting.name, setting.value)]
    argument = argument_of(run.method.cls, setting.name)
    makers = [(run.method, settings)]
    if argument is not None and run.method.kind != "SIERThermostatIntegrator":
        makers.append((run.method.having(**{argument: setting.value}), []))
    for of_argument, before in makers:
        try:
            expected = outcome(Run(mixture, of_argument, name, before))
        except REFUSALS:
            expected = None
        assert (found is None) == (expected is None), "a setter is refused where the argument is not, or the reverse"
        if found is not None:
            assert_alike(run.method.engine, found, expected)


def assert_alike(engine, one, two):
    """Compare all of two runs: the same bits, or with programs of OpenMM that may differ to rounding."""
    if engine == "exact":
        assert_same(one, two)
        return
    of_positions, of_velocities = ROUNDING[engine]
    assert np.abs(one[0] - two[0]).max() < of_positions
    assert np.abs(one[1] - two[1]).max() < of_velocities


# --- futures ----------------------------------------------------------------------------------------------------------


def followed(run, action):
    """Do an action; return the kind of refusal, if it is refused."""
    if not action.applies(run):
        return None
    try:
        action.act(run)
    except REFUSALS as error:
        return type(error).__name__
    return None


def the_future_depends_on_what_is_visible(mixture, method, past, future, name="Reference"):
    """Law 4. A new Context at the same view has the same future to rounding; the method has constant energy."""
    run = started(mixture, method, name)
    for action in past:
        followed(run, action)
    other = run.at_same_view()
    other.saved = list(run.saved)
    for action in (*future, Step(2)):
        assert followed(run, action) == followed(other, action)
        run.view().assert_near(other.view(), *ROUNDING[run.method.engine])


def restarted(run, way, by):
    """Return a function that restarts a run from here in a new Context.

    Args:
        run: a Run.
        way: of `Run.save`.
        by: whence the new integrator comes: "settings", "copy" or "XML".
    """
    load, settings = run.save(way), list(run.settings)
    makers = {
        "settings": lambda: run.method.make(run.built.bodies, settings),
        "copy": lambda: copied,
        "XML": lambda: openmm.XmlSerializer.deserialize(written),
    }
    copied, written = copy.deepcopy(run.integrator), openmm.XmlSerializer.serialize(run.integrator)
    saved = list(run.saved)

    def again():
        other = run.continued(makers[by]())
        other.saved = saved
        load(other.context)
        return other

    return again


def a_restart_goes_on_the_same(mixture, method, past, way, by, future, name="Reference"):
    """Law 4. A restart from a checkpoint, a State or its XML has the same bits."""
    run = started(mixture, method, name)
    for action in past:
        followed(run, action)
    # OpenMM's noise is only in checkpoints.
    again = restarted(run, "checkpoint" if run.method.draws_from_openmm else way, by)
    refusals = [followed(run, action) for action in (*future, Step(2))]
    other = again()
    assert refusals == [followed(other, action) for action in (*future, Step(2))]
    assert_same(run.everything(), other.everything())
