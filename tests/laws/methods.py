"""Integrators of all classes with their arguments, as data that Hypothesis draws and shrinks."""

import dataclasses
import functools
from dataclasses import dataclass

from hypothesis import strategies as st

import openmm_sier
from openmm_sier.ensembles import VelocityRescaling

#: The seed of the noise.
SEED = 11

#: The arguments of thermostats, by the names that integrators have for them.
OF_THERMOSTATS = {"temperature": "temperature", "pressure": "pressure", "barostatInterval": "interval"}


@dataclass(frozen=True)
class Method:
    """An integrator that is not made yet.

    Attributes:
        kind: name of its class.
        engine: "exact", "native" or "kernels", which need a platform for GPUs.
        arguments: names and values of the other arguments of the constructor, sorted.
    """

    kind: str
    engine: str
    arguments: tuple

    @property
    def cls(self):
        return getattr(openmm_sier, self.kind)

    @property
    def is_random(self):
        """Whether the integrator draws random numbers."""
        return self.kind != "SIERIntegrator"

    @property
    def draws_from_openmm(self):
        """Whether OpenMM draws random numbers within steps."""
        return self.engine != "exact" and self.kind in ("SIERLangevinIntegrator", "SIERHMCIntegrator")

    def get(self, name):
        return dict(self.arguments).get(name)

    def having(self, **arguments):
        """Return the method with other arguments; None takes an argument away."""
        values = dict(self.arguments) | arguments
        kept = {name: value for name, value in values.items() if value is not None}
        return dataclasses.replace(self, arguments=tuple(sorted(kept.items())))

    def alternatives(self):
        """Yield this method and simpler ones, for Systems that refuse it."""
        constant = self.having(pressure=None, barostatInterval=None)
        # What kernels refuse says nothing about them.
        others = () if self.engine == "kernels" else (dataclasses.replace(constant, engine="exact"),)
        yield from dict.fromkeys((self, constant, *others))

    def make(self, bodies=None, before=()):
        """Return the integrator, after calls of setters, which have a name and a value."""
        arguments = dict(self.arguments)
        if self.kind == "SIERThermostatIntegrator":
            of_thermostat = {
                OF_THERMOSTATS.get(name, name): arguments.pop(name)
                for name in ("temperature", "rate", "every", "pressure", "barostatInterval")
                if name in arguments
            }
            arguments["thermostat"] = VelocityRescaling(**of_thermostat)
        integrator = self.cls(**arguments, bodies=bodies, engine=self.engine)
        integrator.setRandomNumberSeed(SEED)
        for setting in before:
            getattr(integrator, setting.name)(setting.value)
        return integrator


def method(kind, engine="exact", **arguments):
    """Return a method."""
    return Method(getattr(kind, "__name__", kind), engine, tuple(sorted(arguments.items())))


# Every scheme and argument is drawn with steps that are short for the stiffest molecule of a mixture.
_engines = st.sampled_from(["exact", "native"])
_schemes = st.sampled_from(["SIER2", "SIER2V2", "SIER4", "SIER4V", "SIER4G"])
_steps = st.sampled_from([0.0005, 0.001])
#: bar; at the larger one moves to a larger volume are refused.
_pressures = st.sampled_from([None, 1e3, 3e4])
_intervals = st.sampled_from([2, 1, 3])
_substeps = st.sampled_from([None, 1, 3])


def _methods_of(kind, arguments):
    """Return a strategy of methods of a kind; arguments that are None are left out."""

    def made(engine, values):
        return method(kind, engine).having(**values)

    return st.builds(made, _engines, st.fixed_dictionaries(arguments))


@functools.cache
def methods(kinds=None):
    """Return a strategy of integrators of all classes, or of those of which the names are given."""
    at_temperature = {"temperature": st.just(300.0), "pressure": _pressures, "barostatInterval": _intervals}
    strategies = {
        "SIERIntegrator": {"scheme": _schemes, "stepSize": _steps, "substeps": _substeps},
        "SIERLangevinIntegrator": {
            **at_temperature,
            "frictionCoeff": st.sampled_from([5.0, 0.0]),
            "rotationalFriction": st.sampled_from([None, 20.0]),
            "scheme": st.sampled_from(["SIER2", "SIER4G"]),
            "stepSize": _steps,
            "substeps": _substeps,
        },
        "SIERHMCIntegrator": {
            **at_temperature,
            "extraChances": st.sampled_from([None, 0]),
            "frictionCoeff": st.sampled_from([5.0, None]),
            "scheme": st.sampled_from(["SIER2", "SIER2V2", "SIER4G"]),
            "schemeStepSize": _steps,
            "stepsPerTrial": st.sampled_from([2, 1, 3]),
        },
        "SIERThermostatIntegrator": {
            **at_temperature,
            "rate": st.sampled_from([50.0, 0.0]),
            "every": st.sampled_from([1, 2, 3]),
            "scheme": st.sampled_from(["SIER2", "SIER4G"]),
            "stepSize": _steps,
        },
    }
    return st.one_of([_methods_of(kind, strategies[kind]) for kind in kinds or strategies])
