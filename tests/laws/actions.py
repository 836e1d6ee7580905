"""What users do to a Context and its integrator, as data that Hypothesis draws, orders and shrinks.

Each action is a frozen dataclass with a method `act`, which does it, and `shows`, which asserts that the Context shows
what was asked for. An error of `act` that is one of `REFUSALS` is a refusal, and must have changed nothing.
"""

import copy
import functools
import inspect
import math
import pickle
from dataclasses import dataclass

import numpy as np
import openmm
from hypothesis import strategies as st
from openmm import unit
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

import openmm_sier
from openmm_sier.dynamics.constants import GAS_CONSTANT
from tests.laws.runs import names, update_shares

#: OpenMM's setters for users; the others change the program, which users of the package do not write.
SETTERS_OF_OPENMM = ("setConstraintTolerance", "setRandomNumberSeed", "setIntegrationForceGroups")

#: Values for setters, and values that they must refuse. Names that are not here get the usual ones.
VALUES = {
    "setStepSize": [0.0005, 0.001],
    "setSchemeStepSize": [0.0005, 0.001],
    "setTemperature": [280.0, 300.0, 320.0],
    "setFriction": [1.0, 5.0, 0.0],
    "setRotationalFriction": [20.0, 5.0, 0.0],
    "setPressure": [1e3, 1.0],
    "setStepsPerTrial": [3, 1, 2],
    "setExtraChances": [0, 1, None],
    "setRandomNumberSeed": [3, 11],
    "setConstraintTolerance": [1e-9, 1e-8],
    "setIntegrationForceGroups": [{0, 30, 31}, 2**32 - 1],
}
USUAL_VALUES = [1, 2, 0.5]
WRONG_VALUES = [-1, math.nan, "none"]

#: Chance of a kinetic energy outside of the bounds for a temperature, on either side: that of 6.1 standard errors.
CHANCE = 5e-10

#: nm/ps: velocities that bodies and constraints allow are known to 1e-3 where atoms are off by 1e-5 nm; what is missed
#: is as large as thermal velocities.
ALLOWED = 1e-3


class Action:
    """The base class. What it leaves out holds for questions: `changes` tells whether the Context may differ."""

    changes = True

    def applies(self, run):
        """Return whether a run can be asked for this."""
        return True

    def act(self, run):
        raise NotImplementedError

    def shows(self, run, before, after):
        """Assert that the Context shows what was asked for, by the views before and after."""


# --- steps ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step(Action):
    count: int

    def act(self, run):
        run.integrator.step(self.count)

    def shows(self, run, before, after):
        assert after.steps == before.steps + self.count
        step = run.integrator.getStepSize()._value
        assert abs(after.time - before.time - self.count * step) < 1e-12
        run.assert_rigid(after, 1e-6)
        frozen = run.masses == 0
        frozen[[i for i in range(len(frozen)) if run.system.isVirtualSite(i)]] = False
        assert np.array_equal(after.positions[frozen], before.positions[frozen]), "frozen atoms moved"
        assert after.parameters == before.parameters


# --- atoms ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DrawVelocities(Action):
    temperature: float
    seed: int

    def act(self, run):
        run.context.setVelocitiesToTemperature(self.temperature, self.seed)

    def shows(self, run, before, after):
        assert np.array_equal(after.positions, before.positions)
        # Velocities are those that bodies and constraints allow, and as many of them as there are freedoms.
        projected = run.projected(after)
        massive = run.masses > 0
        kept = (after.velocities == before.velocities).all(axis=1) & massive
        assert not kept.any(), f"velocities of atoms {np.flatnonzero(kept)} are those of before"
        excess = np.abs(projected - after.velocities)[massive].max()
        assert excess < ALLOWED, f"{excess:.1e} nm/ps are not allowed"
        energy = 2 * run.kinetic_energy(after) / (GAS_CONSTANT * self.temperature)
        # Twice the kinetic energy in kT has the chi-square distribution.
        low, high = 2 * gammaincinv(run.freedoms(after) / 2, [CHANCE, 1 - CHANCE])
        assert low <= energy <= high, f"twice the kinetic energy is {energy} kT, not from {low} to {high}"


@dataclass(frozen=True)
class SetVelocities(Action):
    seed: int

    def velocities(self, run):
        spread = np.sqrt(np.divide(1.0, run.masses, out=np.zeros_like(run.masses), where=run.masses > 0))
        return np.random.default_rng(self.seed).normal(size=(len(spread), 3)) * spread[:, None]

    def act(self, run):
        run.context.setVelocities(self.velocities(run))

    def shows(self, run, before, after):
        assert np.array_equal(after.positions, before.positions)
        massive = run.masses > 0
        # GPUs in mixed precision keep doubles.
        assert np.array_equal(after.velocities[massive], self.velocities(run)[massive])


@dataclass(frozen=True)
class SetPositions(Action):
    """Displace and turn a molecule as a whole, and perhaps each atom by a little, which constraints do not allow."""

    molecule: int
    seed: int
    off: float = 0.0

    def positions(self, run, before):
        rng = np.random.default_rng(self.seed)
        molecules = run.context.getMolecules()
        atoms = list(molecules[self.molecule % len(molecules)])
        moved = before.positions.copy()
        centre = moved[atoms].mean(axis=0)
        turn = Rotation.from_rotvec(rng.normal(scale=0.02, size=3))
        moved[atoms] = turn.apply(moved[atoms] - centre) + centre + rng.normal(scale=0.005, size=3)
        return moved + self.off * rng.uniform(-1, 1, moved.shape)

    def act(self, run):
        run.context.setPositions(self.positions(run, run.view()))

    def shows(self, run, before, after):
        assert np.array_equal(after.velocities, before.velocities)
        asked = self.positions(run, before)
        own = [i for i in range(len(asked)) if not run.system.isVirtualSite(i)]
        assert np.array_equal(after.positions[own], asked[own])


@dataclass(frozen=True)
class SetBoth(Action):
    """Positions and then velocities."""

    positions: SetPositions
    velocities: SetVelocities

    def act(self, run):
        self.positions.act(run)
        self.velocities.act(run)

    def shows(self, run, before, after):
        asked = self.positions.positions(run, before)
        own = [i for i in range(len(asked)) if not run.system.isVirtualSite(i)]
        assert np.array_equal(after.positions[own], asked[own])
        massive = run.masses > 0
        assert np.array_equal(after.velocities[massive], self.velocities.velocities(run)[massive])


@dataclass(frozen=True)
class ApplyConstraints(Action):
    def act(self, run):
        run.context.applyConstraints(1e-9)

    def shows(self, run, before, after):
        assert np.array_equal(after.velocities, before.velocities)
        for i, j, length in run.constraints:
            distance = np.linalg.norm(after.positions[i] - after.positions[j])
            assert abs(distance - length) < 1e-6 * length


@dataclass(frozen=True)
class ApplyVelocityConstraints(Action):
    def act(self, run):
        run.context.applyVelocityConstraints(1e-9)

    def shows(self, run, before, after):
        assert np.array_equal(after.positions, before.positions)
        massive = run.masses > 0
        wrong = np.abs(run.projected(before) - after.velocities)[massive].max()
        assert wrong < ALLOWED, f"velocities are {wrong:.1e} nm/ps from the nearest that are allowed"


@dataclass(frozen=True)
class Minimize(Action):
    iterations: int

    def act(self, run):
        run.energy_before = run.potential_energy()
        openmm.LocalEnergyMinimizer.minimize(run.context, 1.0, self.iterations)

    def shows(self, run, before, after):
        assert after.steps == before.steps
        assert np.array_equal(after.box, before.box)
        # Constraints are satisfied at the end, which may cost what rounding of their lengths costs.
        energy = run.potential_energy()
        assert energy <= run.energy_before + 1e-3, f"the energy rose from {run.energy_before} to {energy} kJ/mol"
        run.assert_rigid(after, 1e-4, moves=False)


# --- what forces depend on --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SetBox(Action):
    factor: float

    def applies(self, run):
        return run.is_periodic

    def act(self, run):
        run.context.setPeriodicBoxVectors(*(self.factor * run.view().box))

    def shows(self, run, before, after):
        assert np.array_equal(after.box, self.factor * before.box)
        assert np.array_equal(after.positions, before.positions)


@dataclass(frozen=True)
class SetParameter(Action):
    name: str
    value: float

    def act(self, run):
        run.context.setParameter(self.name, self.value)

    def shows(self, run, before, after):
        assert after.parameters == before.parameters | {self.name: self.value}
        assert run.context.getParameter(self.name) == self.value


@dataclass(frozen=True)
class UpdateParameters(Action):
    """Change a Force in the System and in the Context."""

    share: float

    def act(self, run):
        update_shares(run, [self.share * (1 + k % 2) for k in range(run.pull.getNumParticles())])


# --- saving and loading -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Save(Action):
    """Save a checkpoint or a State. The run goes on as a restart does, so that this is no mere question."""

    way: str

    def act(self, run):
        run.saved.append((run.view(), run.save(self.way)))

    def shows(self, run, before, after):
        after.assert_near(before, 0)


@dataclass(frozen=True)
class Load(Action):
    number: int

    def applies(self, run):
        return bool(run.saved)

    def act(self, run):
        run.saved[self.number % len(run.saved)][1](run.context)

    def shows(self, run, before, after):
        after.assert_near(run.saved[self.number % len(run.saved)][0], 0)


@dataclass(frozen=True)
class Reinitialize(Action):
    preserve: bool

    def act(self, run):
        view = run.view()
        run.context.reinitialize(preserveState=self.preserve)
        if not self.preserve:
            view.show_in(run.context)

    def shows(self, run, before, after):
        after.assert_near(before, 0)


# --- the integrator ---------------------------------------------------------------------------------------------------


def setters(cls):
    """Names of the setters of an integrator that users call."""
    return [
        name
        for name in dir(cls)
        if name.startswith("set")
        and (name in SETTERS_OF_OPENMM or getattr(cls, name).__module__.startswith("openmm_sier"))
    ]


def questions(cls):
    """Names of all that users ask of an integrator: properties, and methods without arguments that return something."""
    names = [name for name in dir(cls) if name.startswith(("get", "compute", "reported"))]
    methods = [name for name in names if len(inspect.signature(getattr(cls, name)).parameters) == 1]
    properties = [name for name in dir(cls) if isinstance(inspect.getattr_static(cls, name), property)]
    return [*methods, *(name for name in properties if name != "thisown")]


def plain(value):
    """A value without its unit, as a setter takes it."""
    return value.value_in_unit_system(unit.md_unit_system) if unit.is_quantity(value) else value


@dataclass(frozen=True)
class Set(Action):
    """Call a setter of the integrator."""

    name: str
    value: object

    def applies(self, run):
        return self.name in setters(type(run.integrator))

    def getter(self, run):
        return getattr(run.integrator, "get" + self.name[3:], None)

    def act(self, run):
        getattr(run.integrator, self.name)(self.value)
        run.settings.append(self)

    def shows(self, run, before, after):
        after.assert_near(before, 0)
        if (getter := self.getter(run)) is not None:
            assert _shown(self.name, getter(), self.value), f"{getter()} is shown, and {self.value} was set"


def _shown(name, shown, value):
    """Whether a getter shows a value."""
    if name == "setPressure":
        return math.isclose(shown.value_in_unit(unit.bar), value)
    if name == "setIntegrationForceGroups" and isinstance(value, set):
        value = sum(1 << group for group in value)
    if name == "setIntegrationForceGroups":
        # OpenMM shows the mask of 32 groups as a number with a sign.
        return (shown - value) % 2**32 == 0
    return plain(shown) == value or math.isclose(plain(shown), value, rel_tol=1e-12)


@dataclass(frozen=True)
class Ask(Action):
    """Ask the integrator or the Context for something, which may have no answer and changes nothing."""

    name: str
    changes = False

    def applies(self, run):
        if self.name == "energies":
            # OpenMM draws random numbers for the kinetic energy of a CustomIntegrator.
            return not run.method.draws_from_openmm
        return self.name in QUESTIONS or hasattr(type(run.integrator), self.name)

    def act(self, run):
        if self.name in QUESTIONS:
            QUESTIONS[self.name](run)
        else:
            answer = getattr(run.integrator, self.name)
            str(answer() if callable(answer) and self.name != "rotation" else answer)

    def shows(self, run, before, after):
        after.assert_near(before, 0)


def _copied(run, copied):
    assert type(copied) is type(run.integrator)
    assert openmm.XmlSerializer.serialize(copied) == openmm.XmlSerializer.serialize(run.integrator)


#: Questions besides those of the integrator, by name.
QUESTIONS = {
    "energies": lambda run: run.context.getState(positions=True, forces=True, energy=True),
    "forces": lambda run: run.context.getState(velocities=True, forces=True, parameters=True),
    "copy": lambda run: _copied(run, copy.deepcopy(run.integrator)),
    "pickle": lambda run: _copied(run, pickle.loads(pickle.dumps(run.integrator))),
    "XML": lambda run: _copied(run, _rewritten(run.integrator)),
    "print": lambda run: (repr(run.integrator), str(run.context.getIntegrator())),
    "parameters": lambda run: [
        run.context.getParameter(name) for force in run.system.getForces() for name in names(force)
    ],
    "molecules": lambda run: run.context.getMolecules(),
    "nothing": lambda run: run.integrator.step(0),
}


def _rewritten(integrator):
    return openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(integrator))


# --- what is refused --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Refused(Action):
    """Ask for something that must be refused."""

    name: str
    changes = False

    def act(self, run):
        WRONG[self.name](run)
        raise AssertionError(f"{self.name} was accepted")


def _other_state(run):
    system = openmm.System()
    system.addParticle(1.0)
    context = openmm.Context(system, openmm.VerletIntegrator(0.5), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([openmm.Vec3(1, 2, 3)])
    context.setTime(7.0)
    return context.getState(positions=True, velocities=True, parameters=True)


#: What must be refused, by name.
WRONG = {
    "steps below zero": lambda run: run.integrator.step(-1),
    "half a step": lambda run: run.integrator.step(0.5),
    "too few positions": lambda run: run.context.setPositions(run.view().positions[1:]),
    "too many velocities": lambda run: run.context.setVelocities(np.zeros((len(run.masses) + 1, 3))),
    "an unknown parameter": lambda run: run.context.setParameter("unknown", 1.0),
    "no checkpoint": lambda run: run.context.loadCheckpoint(b"no checkpoint"),
    "a flat box": lambda run: run.context.setPeriodicBoxVectors((1, 0, 0), (0, 1, 0), (0.9, 0, 0.1)),
    "a step that is no time": lambda run: run.integrator.setStepSize(300 * unit.kelvin),
}


# --- strategies -------------------------------------------------------------------------------------------------------

seeds = st.integers(1, 99)
steps = st.builds(Step, st.integers(1, 3))
draws = st.builds(DrawVelocities, st.sampled_from([300.0, 100.0]), seeds)
velocities = st.builds(SetVelocities, seeds)
positions = st.builds(SetPositions, st.integers(0, 5), seeds, st.sampled_from([0.0, 1e-5]))


def values_of(setter):
    """Values for a setter, the first of which is none that integrators have from the start."""
    return VALUES.get(setter, USUAL_VALUES)


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
        st.builds(Minimize, st.integers(1, 3)),
        st.just(ApplyConstraints()),
        st.just(ApplyVelocityConstraints()),
        st.builds(Save, st.sampled_from(["checkpoint", "State", "XML"])),
        st.builds(Load, st.integers(0, 2)),
        st.builds(Reinitialize, st.booleans()),
        setters_of(kind),
    )


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
    """Return a strategy of all actions with an integrator of a kind."""
    return st.one_of(changes(kind), changes(kind), asked(kind), refused(kind))
