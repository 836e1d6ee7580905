"""The frame of all experiments: a contestant is started in a box, and followed with an observer.

An observer is a function of a Context that returns values by name. Runs of a study are tasks (`studies.records`), which
are kept one by one, so that an interrupted study continues; speeds are measured by turns (`studies.timing`).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, NamedTuple

import openmm
import pandas as pd

from openmm_sier.analysis.observables import energy_error, energy_walk
from openmm_sier.analysis.statistics import mean_and_error, rms, slope_and_error
from openmm_sier.dynamics.bodies import BodySet, NotFiniteError, RigidityError
from openmm_sier.inputs.equilibration import make_context, prepare
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.observe import openmm_integrators
from openmm_sier.system.temperature import MomentumConservation, temperatures
from studies.methods import Method
from studies.records import replace_file
from studies.report import SILENT, Report
from studies.units import md

#: Temperature in K above which a run counts as broken.
HIGHEST_TEMPERATURE = 3000.0

#: Time in fs between two samples: a fifth to a half of the periods of librations in water, 35 to 80 fs. Angular
#: velocities decorrelate in some 20 fs.
INTERVAL = 12.0

#: Number of steps before a measured run.
WARM_UP = 10

#: Steps in one call of `step`, as `Simulation` makes them where times are taken.
CALL = 10

Observer = Callable[[openmm.Context], dict[str, float]]


class Unstable(RuntimeError):
    """The simulation has left the range of sensible energies."""


# --- starts ---


@dataclass(frozen=True)
class Liquid:
    """A System with its rigid bodies and a phase point from which runs start.

    Attributes:
        platform: of OpenMM; None takes the fastest.
    """

    system: openmm.System
    bodies: BodySet
    start: openmm.State
    platform: str | None = None


def equilibrated(
    context: openmm.Context,
    positions: Any,
    temperature: float,
    seed: int,
    time: float,
    state_file: Path | None = None,
    report: Report = SILENT,
) -> openmm.State:
    """Return positions and velocities after an equilibration, see `openmm_sier.inputs.equilibration.prepare`.

    Args:
        state_file: XML file of the State of an earlier equilibration, which is created if it does not exist; None: no
            file.
    """
    if state_file is not None and state_file.exists():
        return openmm.XmlSerializer.deserialize(state_file.read_text())
    prepare(context, positions, temperature, seed, time, report=report)
    state = context.getState(positions=True, velocities=True)
    if state_file is not None:
        replace_file(state_file, openmm.XmlSerializer.serialize(state))
    return state


def warmed(
    system: openmm.System,
    positions: Any,
    temperature: float,
    seed: int,
    time: float,
    platform: str | None,
    iterations: int = 0,
) -> openmm.State:
    """Return positions, velocities and box after some ps of LangevinMiddle in steps of 2 fs.

    Args:
        iterations: of the minimization before it; 0: none.
    """
    integrator = openmm.LangevinMiddleIntegrator(temperature, 5.0, 0.002)
    integrator.setRandomNumberSeed(seed)
    context = make_context(system, integrator, platform)
    context.setPositions(positions)
    context.applyConstraints(1e-6)
    if iterations:
        openmm.LocalEnergyMinimizer.minimize(context, 10, iterations)
    context.setVelocitiesToTemperature(temperature, seed)
    integrator.step(round(time / 0.002))
    return context.getState(positions=True, velocities=True)


# --- runs ---


class Samples(NamedTuple):
    """A run: a row for each sample, and the simulated time in fs per second of wall and of processor time."""

    table: pd.DataFrame
    fs_per_second: float
    fs_per_processor_second: float


def sampled(context: openmm.Context, observe: Observer, duration: float, time: float, interval: float) -> Samples:
    """Run a Context, with a sample every so often; the `time` of a sample is that since the start, ps.

    Args:
        context: with positions and velocities.
        observe: returns the values of a sample; it may raise `Unstable`.
        duration: simulated time of one call of `step(1)`, fs.
        time: of the run, ps.
        interval: between samples, fs; a step if that is longer.

    Raises:
        Unstable: a value of `temperature`, if samples have it, is above `HIGHEST_TEMPERATURE` or not a number.
        openmm.OpenMMException: as its message says.
    """
    integrator = context.getIntegrator()
    every = max(1, round(interval / duration))
    count = max(1, round(1e3 * time / (every * duration)))
    rows, wall, processor = [], 0.0, 0.0
    for number in range(1, count + 1):
        begun, its_begin = perf_counter(), process_time()
        advance(integrator, every)
        wall += perf_counter() - begun
        processor += process_time() - its_begin
        row = observe(context)
        if not row.get("temperature", 0.0) < HIGHEST_TEMPERATURE:
            raise Unstable(f"a temperature of {row['temperature']:.0f} K after {number * every} steps")
        rows.append({"time": 1e-3 * number * every * duration} | row)
    simulated = count * every * duration
    return Samples(pd.DataFrame(rows), simulated / max(wall, 1e-9), simulated / max(processor, 1e-9))


def advance(integrator: openmm.Integrator, steps: int) -> None:
    """Make steps in calls of ten, and the remaining ones."""
    for start in range(0, steps, CALL):
        integrator.step(min(CALL, steps - start))


def means(table: pd.DataFrame) -> dict[str, float]:
    """Return the mean of each column of samples and its standard error, `NAME_error`."""
    found: dict[str, float] = {}
    for name, series in table.drop(columns="time").items():
        found[str(name)], found[f"{name}_error"], _ = mean_and_error(series.to_numpy(dtype=float))
    return found


def over_starts(runs: pd.DataFrame, names: Sequence[str]) -> dict[str, Any]:
    """Return means over runs that differ in their seeds alone, with standard errors; NaN where one is `broken`."""
    row: dict[str, Any] = {"starts": len(runs), "broken": next((reason for reason in runs["broken"] if reason), "")}
    for name in names:
        row[name] = runs[name].mean(skipna=False)
        row[f"{name}_error"] = runs[name].std(skipna=False) / math.sqrt(len(runs))
    return row


# --- energies ---


def energies(context: openmm.Context) -> dict[str, float]:
    """Return potential and kinetic energy at the end of a step, kJ/mol."""
    state = context.getState(energy=True)
    return {"potential": md(state.getPotentialEnergy()), "kinetic": md(state.getKineticEnergy())}


def conservation(table: pd.DataFrame) -> dict[str, float]:
    """Return how well a run conserves its energy H, from its `energies`.

    Returns:
        `percent` for rms(H)/rms(V) in per cent (see `openmm_sier.analysis.observables.energy_error`), the `walk` of H
        likewise, `rms` of H in kJ/mol, and the `drift` of the energy of the whole box in kJ/mol/ps with `its_error` as
        that of a slope.
    """
    time, V = table["time"].to_numpy(), table["potential"].to_numpy()
    H = V + table["kinetic"].to_numpy()
    drift, error, _ = slope_and_error(time, H)
    return {
        "percent": 100 * energy_error(H, V),
        "walk": 100 * energy_walk(time, H, V),
        "rms": rms(H),
        "drift": drift,
        "its_error": error,
    }


class OfBodies:
    """Observes energies and temperatures of rigid bodies at whole steps.

    OpenMM's leapfrog keeps velocities half a step behind. Its temperatures are taken at the whole step, from velocities
    that the forces have advanced by half a step, as OpenMM's own kinetic energy is.
    """

    def __init__(self, context: openmm.Context, bodies: BodySet):
        self._bodies = bodies
        integrator = context.getIntegrator()
        if isinstance(integrator, SIERIntegrator):
            self._conserved = integrator.conservesMomentum
            return
        groups = integrator.getIntegrationForceGroups()
        has_friction = isinstance(integrator, openmm.LangevinMiddleIntegrator)
        self._conserved = MomentumConservation(context.getSystem(), bodies).holds(groups, has_friction)

    def __call__(self, context: openmm.Context) -> dict[str, float]:
        """Return `energies`, and the temperatures of translation and rotation in K, NaN without such motion.

        Raises:
            Unstable: an energy is not finite, bodies are too hot, or molecules are torn apart.
        """
        integrator = context.getIntegrator()
        try:
            if isinstance(integrator, SIERIntegrator):
                state = integrator.getBodyState()
            else:
                state = openmm_integrators.body_state(context, self._bodies)
        except (RigidityError, NotFiniteError) as error:
            raise Unstable(str(error)) from error
        kelvins = temperatures(self._bodies, state, self._conserved)
        row = energies(context) | {"translation": kelvins.translation, "rotation": kelvins.rotation}
        is_hot = row["translation"] > HIGHEST_TEMPERATURE or row["rotation"] > HIGHEST_TEMPERATURE
        if is_hot or not math.isfinite(row["potential"] + row["kinetic"]):
            raise Unstable(f"temperatures of {row['translation']:.0f} K and {row['rotation']:.0f} K")
        return row


def follow(liquid: Liquid, method: Method, dt: float, time: float, interval: float = INTERVAL) -> Samples:
    """Run a method from the start of a liquid with samples `OfBodies`.

    Args:
        liquid: what is run.
        method: that runs it.
        dt: simulated time per force evaluation, fs.
        time: of the run, ps.
        interval: between samples, fs.

    Raises:
        Unstable: the run broke down.
    """
    step = dt * method.forces
    integrator = method.make(1e-3 * step)
    integrator.setConstraintTolerance(openmm_integrators.CONSTRAINT_TOLERANCE)
    context = make_context(liquid.system, integrator, liquid.platform)
    try:
        # Lists and meshes are set up before the time is taken.
        context.setState(liquid.start)
        integrator.step(WARM_UP)
        context.setState(liquid.start)
        return sampled(context, OfBodies(context, liquid.bodies), step, time, min(interval, 1e3 * time))
    except openmm.OpenMMException as error:
        raise Unstable(" ".join(str(error).split())) from error


def conserved(
    liquid: Liquid, method: Method, dt: float, time: float, interval: float = INTERVAL
) -> tuple[dict[str, Any], pd.DataFrame | None]:
    """Return the `conservation` of a run and its samples; see `follow` for the arguments.

    `fs_per_second` is simulated time over processor time. The numbers of a run that broke down are NaN, and `broken`
    says why it did.
    """
    with warnings.catch_warnings():
        # What a step or a System does to the energy is what is measured here.
        warnings.simplefilter("ignore")
        try:
            samples = follow(liquid, method, dt, time, interval)
        except Unstable as error:
            unknown = dict.fromkeys(("percent", "walk", "rms", "drift", "its_error", "fs_per_second"), math.nan)
            return unknown | {"broken": str(error)}, None
    found = conservation(samples.table) | {"fs_per_second": samples.fs_per_processor_second, "broken": ""}
    return found, samples.table
