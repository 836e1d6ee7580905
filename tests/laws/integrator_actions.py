"""What users ask of an integrator: setters and questions, found by their names, and what must be refused."""

import copy
import inspect
import math
import pickle
from dataclasses import dataclass

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.engines.snapshot import HOST_PLATFORMS
from tests.laws.actions import Action
from tests.laws.runs import REFUSALS, names
from tests.support.waters import plain_context

#: OpenMM's setters for users; the others change the program, which users of the package do not write.
SETTERS_OF_OPENMM = ("setConstraintTolerance", "setRandomNumberSeed", "setIntegrationForceGroups")

#: Values for setters, and values that they must refuse. Names that are not here get the usual ones.
VALUES = {
    "setStepSize": [0.0005, 0.001],
    "setSchemeStepSize": [0.0005, 0.001],
    "setTemperature": [280.0, 300.0, 320.0],
    "setFriction": [2.0, 5.0, 0.0],
    "setRotationalFriction": [20.0, 5.0, 0.0],
    "setPressure": [1e3, 1.0],
    "setStepsPerTrial": [3, 1, 2],
    "setExtraChances": [0, 1, None],
    "setRandomNumberSeed": [3, 11],
    "setConstraintTolerance": [1e-9, 1e-8],
    "setIntegrationForceGroups": [{0, 30, 31}, 2**32 - 1, -1],
}
USUAL_VALUES = [1, 2, 0.5]
WRONG_VALUES = [-1, math.nan, "none"]


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


def values_of(setter):
    """Values for a setter, the first of which is none that integrators have from the start."""
    return VALUES.get(setter, USUAL_VALUES)


@dataclass(frozen=True)
class Set(Action):
    """Call a setter of the integrator."""

    name: str
    value: object
    refusals = REFUSALS

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
        if self.name == "own values":
            # The native engine brings positions that are set onto the constraints.
            return run.method.engine == "exact" and run.name in HOST_PLATFORMS
        return self.name in QUESTIONS or hasattr(type(run.integrator), self.name)

    def act(self, run):
        if self.name in QUESTIONS:
            QUESTIONS[self.name](run)
        else:
            answer = getattr(run.integrator, self.name)
            answer = answer() if callable(answer) and self.name != "rotation" else answer
            str(answer)
            if self.name in ANSWERS:
                ANSWERS[self.name](run, answer)

    def shows(self, run, before, after):
        after.assert_near(before, 0)


def _temperature_is_right(run, temperature):
    """Compare the temperature with that of the allowed velocities and their number."""
    if run.integrator.scheme.bath_divides_drift:
        # It is that just after the bath.
        return
    view = run.view()
    removed = any(isinstance(force, openmm.CMMotionRemover) for force in run.system.getForces())
    # The force of `Run` pulls at the centre, so that only a remover leaves it without heat.
    freedoms = run.freedoms(view) - 3 * removed
    if freedoms <= 0:
        assert math.isnan(temperature._value), f"{temperature} for no freedoms"
        return
    energy = run.kinetic_energy_of(run.projected(view), removed)
    expected = 2 * energy / (freedoms * GAS_CONSTANT)
    assert math.isclose(temperature._value, expected, rel_tol=TEMPERATURES, abs_tol=1e-6), (
        f"{temperature} in place of {expected}, that of {freedoms} freedoms"
    )


#: Relative error of temperatures: constraints leave velocities known to 1e-5.
TEMPERATURES = 1e-4

#: Answers to questions, by name.
ANSWERS = {
    "computeSystemTemperature": _temperature_is_right,
    "computeTemperatures": lambda run, temperatures: _temperature_is_right(run, temperatures.total),
}


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
    "own values": lambda run: run.view().show_in(run.context),
}


def _rewritten(integrator):
    return openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(integrator))


# --- what is refused --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Refused(Action):
    """Ask for something that must be refused."""

    name: str
    changes = False
    refusals = REFUSALS

    def act(self, run):
        WRONG[self.name](run)
        raise AssertionError(f"{self.name} was accepted")


def _other_state(run):
    system = openmm.System()
    system.addParticle(1.0)
    context = plain_context(system, [openmm.Vec3(1, 2, 3)])
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
    "a group that does not exist": lambda run: run.integrator.setIntegrationForceGroups({40}),
    "a step that is no time": lambda run: run.integrator.setStepSize(300 * unit.kelvin),
}
