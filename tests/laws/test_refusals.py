"""Refusals: what cannot be done is refused by one sentence, before anything is changed, by both engines alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import openmm
import pytest
from hypothesis import strategies as st

from openmm_sier import RigidBodies, SIERIntegrator, prepare_system
from tests.laws.law import Law
from tests.laws.mechanics import masses_of
from tests.laws.mixture_strategies import mixtures
from tests.laws.mixtures import Built, Mixture
from tests.laws.molecules import Body, Water
from tests.support.waters import context_at, platform

Attempt = Callable[[], object]


@dataclass(frozen=True)
class Faulty:
    """A mixture with a fault.

    Attributes:
        mixture: with a named body of three atoms and a molecule of water before all others.
        fault: a name in `FAULTS`.
    """

    mixture: Mixture
    fault: str

    def check(self) -> None:
        built = self.mixture.build()
        system = openmm.XmlSerializer.clone(built.plain)
        attempts = FAULTS[self.fault](built, system)
        before = openmm.XmlSerializer.serialize(system)
        messages = [_message(attempt) for attempt in attempts]
        assert openmm.XmlSerializer.serialize(system) == before, "the System was changed"
        for message in messages:
            assert message is not None, f"not refused, others by {messages}"
            assert "\n" not in message.strip(), message
            assert len(message) > 20, f"no sentence: {message}"
        alike = {message for message in messages if not message.startswith("The native engine")}
        assert len(alike) == 1, f"several sentences: {alike}"


def _message(attempt: Attempt) -> str | None:
    """Return the text by which something is refused; None if it is not."""
    try:
        attempt()
    except (ValueError, TypeError, openmm.OpenMMException) as error:
        return str(error)
    return None


# --- attempts ---------------------------------------------------------------------------------------------------------


def _found(built: Built, system: openmm.System, named) -> list[Attempt]:
    """Bodies are found and a System is prepared."""
    return [
        lambda: RigidBodies.from_system(system, rigid=named, positions=built.positions),
        lambda: prepare_system(system, named),
        lambda: prepare_system(system, named, hydrogenMass=4.0),
    ]


def _bound(built: Built, system: openmm.System, bodies: RigidBodies | None) -> list[Attempt]:
    """Contexts are made and steps are done by each engine."""

    def step(engine: str) -> None:
        integrator = SIERIntegrator(0.001, bodies=bodies, engine=engine)
        context_at(system, integrator, (built.positions, built.velocities), steps=1)

    return [lambda: step("exact"), lambda: step("native")]


# --- faults -----------------------------------------------------------------------------------------------------------

#: First atoms of the named body and of the water in each mixture.
BODY, WATER = 0, 3


def shared_atom(built: Built, system: openmm.System) -> list[Attempt]:
    return _found(built, system, [[BODY, BODY + 1, BODY + 2], [BODY + 2, WATER]])


def atom_without_mass(built: Built, system: openmm.System) -> list[Attempt]:
    system.setParticleMass(BODY + 1, 0.0)
    return _found(built, system, built.named)


def no_such_atom(built: Built, system: openmm.System) -> list[Attempt]:
    return _found(built, system, [[BODY, system.getNumParticles()]])


def empty_body(built: Built, system: openmm.System) -> list[Attempt]:
    return _found(built, system, [[BODY, BODY + 1], []])


def constraint_between_bodies(built: Built, system: openmm.System) -> list[Attempt]:
    bodies = built.bodies
    apart = float(np.linalg.norm(built.positions[BODY] - built.positions[WATER]))
    system.addConstraint(BODY, WATER, apart)
    return [*_found(built, system, built.named), *_bound(built, system, bodies)]


def bodies_of_other_masses(built: Built, system: openmm.System) -> list[Attempt]:
    system.setParticleMass(BODY, 30.0)
    return [lambda: prepare_system(system, built.bodies), *_bound(built, system, built.bodies)]


def bodies_of_another_system(built: Built, system: openmm.System) -> list[Attempt]:
    bodies = built.bodies
    other = openmm.XmlSerializer.clone(system)
    other.addParticle(1.0)
    for force in reversed(range(other.getNumForces())):
        other.removeForce(force)
    return [
        lambda: prepare_system(other, bodies),
        lambda: openmm.Context(other, SIERIntegrator(0.001, bodies=bodies), platform()),
    ]


def prepared_for_bodies_that_are_not_given(built: Built, system: openmm.System) -> list[Attempt]:
    prepare_system(system, built.named)
    return _bound(built, system, None)


def lengths_that_contradict_each_other(built: Built, system: openmm.System) -> list[Attempt]:
    first = next(k for k in range(system.getNumConstraints()) if system.getConstraintParameters(k)[0] >= WATER)
    i, j, _ = system.getConstraintParameters(first)
    system.setConstraintParameters(first, i, j, 0.4)
    return [*_found(built, system, built.named), *_bound(built, system, None)]


def constraint_of_no_particle(built: Built, system: openmm.System) -> list[Attempt]:
    system.addConstraint(WATER, system.getNumParticles(), 0.1)
    return [*_found(built, system, built.named), *_bound(built, system, None)]


def negative_mass(built: Built, system: openmm.System) -> list[Attempt]:
    system.setParticleMass(int(np.flatnonzero(masses_of(system))[-1]), -1.0)
    return _bound(built, system, None)


def drude_particles(built: Built, system: openmm.System) -> list[Attempt]:
    force = openmm.DrudeForce()
    force.addParticle(WATER + 1, WATER, -1, -1, -1, -1.0, 0.001, 1.0, 1.0)
    system.addForce(force)
    return _bound(built, system, None)


def heat_bath_of_single_atoms(built: Built, system: openmm.System) -> list[Attempt]:
    system.addForce(openmm.AndersenThermostat(300, 1))
    return _bound(built, system, built.bodies)


def forces_that_cannot_be_fast(built: Built, system: openmm.System) -> list[Attempt]:
    return [lambda: prepare_system(system, built.named, fastForceGroup=0)]


def impossible_hydrogens(built: Built, system: openmm.System) -> list[Attempt]:
    return [lambda: prepare_system(system, built.named, hydrogenMass=5.0)]


def bound_system(built: Built, system: openmm.System) -> list[Attempt]:
    context = openmm.Context(system, SIERIntegrator(0.001, bodies=built.bodies), platform())
    # The bound System is that of the Context, which lives as long as the attempt.
    return [lambda: (context, prepare_system(context.getSystem(), built.named))]


FAULTS = {
    fault.__name__: fault
    for fault in (
        shared_atom,
        atom_without_mass,
        no_such_atom,
        empty_body,
        constraint_between_bodies,
        bodies_of_other_masses,
        bodies_of_another_system,
        prepared_for_bodies_that_are_not_given,
        lengths_that_contradict_each_other,
        constraint_of_no_particle,
        negative_mass,
        drude_particles,
        heat_bath_of_single_atoms,
        forces_that_cannot_be_fast,
        impossible_hydrogens,
        bound_system,
    )
}


@st.composite
def cases(draw: st.DrawFn, platform: str) -> Faulty:
    """Draw a mixture with a named body and a molecule of water, and a fault."""
    others = draw(mixtures(("vacuum", "cut-off"), ("no",)))
    shape = draw(st.sampled_from(["bent", "line"]))
    form = others.form if others.form != "none" else "plain"
    molecules = (Body(shape), Water(), *others.molecules)
    mixture = Mixture(molecules, others.seed, others.surroundings, form, others.remover)
    return Faulty(mixture, draw(st.sampled_from(list(FAULTS))))


LAW = Law("refusals", cases, few=16)


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_refused(fault):
    Faulty(Mixture((Body("bent"), Water())), fault).check()


@LAW.numbers()
def test_what_cannot_be_done_is_refused_before_anything_is_changed(examples):
    LAW.hold(examples)
