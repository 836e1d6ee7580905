"""Strategies of actions, by the name of the class of the integrator."""

import functools

from hypothesis import strategies as st

import openmm_sier
from tests.laws.actions import (
    ApplyConstraints,
    ApplyVelocityConstraints,
    DrawVelocities,
    HardenBonds,
    InterruptedStep,
    Load,
    Minimize,
    Reinitialize,
    Save,
    SetBoth,
    SetBox,
    SetParameter,
    SetPositions,
    SetVelocities,
    Step,
    UpdateParameters,
)
from tests.laws.integrator_actions import (
    QUESTIONS,
    WRONG,
    WRONG_VALUES,
    Ask,
    Refused,
    Set,
    questions,
    setters,
    values_of,
)

seeds = st.integers(1, 99)
steps = st.builds(Step, st.integers(1, 3))
draws = st.builds(DrawVelocities, st.sampled_from([300.0, 100.0]), seeds)
velocities = st.builds(SetVelocities, seeds)
positions = st.builds(SetPositions, st.integers(0, 5), seeds, st.sampled_from([0.0, 1e-5]))


@functools.cache
def setters_of(kind):
    """Return a strategy of setters of an integrator of a kind."""
    return st.sampled_from(
        [Set(name, value) for name in setters(getattr(openmm_sier, kind)) for value in values_of(name)]
    )


@functools.cache
def changes(kind):
    """Return a strategy of actions that change something in a Context with an integrator of a kind."""
    return st.one_of(
        steps,
        draws,
        steps,
        draws,
        velocities,
        positions,
        st.builds(SetBoth, positions, velocities),
        st.builds(SetBox, st.sampled_from([1.01, 1.02])),
        st.builds(SetParameter, st.just("pull"), st.sampled_from([3.0, -2.0])),
        st.builds(UpdateParameters, st.sampled_from([0.2, -0.3])),
        st.builds(HardenBonds, st.sampled_from([2.0, 30.0])),
        st.builds(Minimize, st.integers(1, 3)),
        st.just(ApplyConstraints()),
        st.just(ApplyVelocityConstraints()),
        st.builds(Save, st.sampled_from(["checkpoint", "State", "XML"])),
        st.builds(Load, st.integers(0, 2)),
        st.builds(Reinitialize, st.booleans()),
        setters_of(kind),
    )


@functools.cache
def several(kind, least=0, most=3):
    """Return a strategy of some changes with an integrator of a kind."""
    return st.lists(changes(kind), min_size=least, max_size=most).map(tuple)


@functools.cache
def pasts(kind):
    """Return a strategy of what was done before, steps that were interrupted among it."""
    interrupted = st.builds(InterruptedStep, st.integers(1, 2), st.integers(1, 200))
    return st.lists(st.one_of(changes(kind), changes(kind), changes(kind), interrupted), max_size=3).map(tuple)


@functools.cache
def asked(kind):
    """Return a strategy of questions about an integrator of a kind."""
    return st.builds(Ask, st.sampled_from([*QUESTIONS, *questions(getattr(openmm_sier, kind))]))


@functools.cache
def refused(kind):
    """Return a strategy of what must be refused."""
    wrong = st.builds(Refused, st.sampled_from(sorted(WRONG)))
    names = setters(getattr(openmm_sier, kind))
    return st.one_of(wrong, st.builds(Set, st.sampled_from(names), st.sampled_from(WRONG_VALUES)))


@functools.cache
def actions(kind):
    """Return a strategy of several actions of all kinds with an integrator of a kind."""
    one = st.one_of(changes(kind), changes(kind), asked(kind), refused(kind))
    return st.lists(one, min_size=2, max_size=8).map(tuple)
