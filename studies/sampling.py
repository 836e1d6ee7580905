"""Time series of runs of compared integrators."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, NamedTuple

import numpy as np
import openmm
import pandas as pd

from openmm_sier.analysis.observables import energy_error
from openmm_sier.analysis.statistics import slope_and_error
from openmm_sier.dynamics.bodies import BodySet, BodyState, NotFiniteError, RigidityError
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.vectors import body_frame
from openmm_sier.inputs.equilibration import make_context, prepare
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.observe import openmm_integrators
from openmm_sier.system import find_bodies
from openmm_sier.system.temperature import MomentumConservation, degrees_of_freedom, temperatures
from studies import boxes
from studies.command import BoxSettings, RunsSettings
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


class Unstable(RuntimeError):
    """The simulation has left the range of sensible energies."""


@dataclass(frozen=True)
class Energies:
    """Energies at whole steps of one run, one-dimensional arrays of equal length.

    Attributes:
        time: ps.
        potential, kinetic: kJ/mol.
    """

    time: np.ndarray
    potential: np.ndarray
    kinetic: np.ndarray

    @property
    def total(self) -> np.ndarray:
        return self.potential + self.kinetic


@dataclass(frozen=True)
class Series(Energies):
    """Samples of one run.

    Attributes:
        translation, rotation: temperatures in K.
        volume: nm^3.
    """

    translation: np.ndarray
    rotation: np.ndarray
    volume: np.ndarray


@dataclass(frozen=True)
class Liquid:
    """A System with its rigid bodies and a phase point from which runs start.

    Attributes:
        platform: of OpenMM, and after a colon its precision; None takes the fastest.
    """

    system: openmm.System
    bodies: BodySet
    start: openmm.State
    platform: str | None = None


def equilibrated_liquid(
    settings: BoxSettings,
    time: float,
    report: Report = SILENT,
    tolerance: float = boxes.TOLERANCE,
    state_file: Path | None = None,
) -> Liquid:
    """A box at its temperature.

    Args:
        settings: of the box.
        time: of the equilibration, ps.
        report: gets notes and progress.
        tolerance: of PME.
        state_file: see `equilibrated`.
    """
    box = boxes.read(settings, tolerance=tolerance)
    context = make_context(box.system, SIERIntegrator(0.001, "SIER2"), settings.platform)
    start = equilibrated(context, box.positions, settings.temperature, settings.seed, time, state_file, report)
    return Liquid(box.system, find_bodies.RigidBodies.from_system(box.system, box.topology), start, settings.platform)


@dataclass(frozen=True, kw_only=True)
class GridSettings(BoxSettings, RunsSettings):
    """Settings of studies with runs of a box from several starts.

    Attributes:
        starts: equilibrated phase points, from which all runs start; their seeds follow `seed`.
        time: of each run, ps.
        equilibrate: before them, ps.
    """

    starts: int = 4
    time: float = 1.0
    equilibrate: float = 3.0

    @property
    def seeds(self) -> range:
        return range(self.seed, self.seed + self.starts)

    @property
    def liquid(self) -> str:
        """Name of the box, and of the force field if it is not that of the box."""
        return ", ".join([self.box.stem, *(Path(file).stem for file in self.forcefield)])

    def start(self, seed: int, tolerance: float = boxes.TOLERANCE) -> Liquid:
        """The equilibrated phase point of a seed, which is kept in `out` for other runs."""
        path = self.out / f"start of {self.liquid}, seed {seed}.xml"
        return equilibrated_liquid(replace(self, seed=seed), self.equilibrate, tolerance=tolerance, state_file=path)


def equilibrated(
    context: openmm.Context,
    positions: Any,
    temperature: float,
    seed: int,
    time: float,
    state_file: Path | None = None,
    report: Report = SILENT,
) -> openmm.State:
    """Positions and velocities after an equilibration, see `openmm_sier.inputs.equilibration.prepare`.

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


def warmed(system: openmm.System, positions: Any, settings: BoxSettings, time: float) -> openmm.State:
    """Positions, velocities and box after some ps of LangevinMiddle in steps of 2 fs."""
    integrator = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.002)
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(system, integrator, settings.platform)
    context.setPositions(positions)
    context.applyConstraints(1e-6)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    integrator.step(round(time / 0.002))
    return context.getState(positions=True, velocities=True)


class Followed(NamedTuple):
    """A run: its samples, and the simulated time in fs per second of wall and of processor time."""

    series: Series
    fs_per_second: float
    fs_per_processor_second: float


def follow(
    liquid: Liquid,
    method: Method,
    dt: float,
    time: float,
    settle: float = 0.0,
    report: Report = SILENT,
    interval: float = INTERVAL,
) -> Followed:
    """Run a method from the start of a liquid, with a sample every so often.

    Args:
        liquid: what is run.
        method: that runs it.
        dt: simulated time per force evaluation, fs.
        time: of the run, ps.
        settle: ps before it.
        report: gets progress.
        interval: between samples, fs.

    Raises:
        Unstable: the run broke down.
    """
    step = dt * method.forces
    integrator = method.make(1e-3 * step)
    integrator.setConstraintTolerance(openmm_integrators.CONSTRAINT_TOLERANCE)
    context = _context(liquid, integrator)
    steps = max(1, round(1e3 * time / step))
    every = min(steps, max(1, round(interval / step)))
    try:
        # Lists and meshes are set up before the time is taken.
        context.setState(liquid.start)
        integrator.step(WARM_UP)
        context.setState(liquid.start)
        with report.progress(f"{method.name}, {dt:g} fs per force", steps, 1e-3 * step) as show:
            integrator.step(round(1e3 * settle / step))
            begun, processor = perf_counter(), process_time()
            series = sample(context, liquid.bodies, steps, every, show)
            simulated = len(series.time) * every * step
            wall, processor = perf_counter() - begun, max(process_time() - processor, 1e-9)
            return Followed(series, simulated / wall, simulated / processor)
    except openmm.OpenMMException as error:
        raise Unstable(" ".join(str(error).split())) from error


def _context(liquid: Liquid, integrator: openmm.Integrator) -> openmm.Context:
    platform, _, precision = (liquid.platform or "").partition(":")
    if not precision:
        return make_context(liquid.system, integrator, liquid.platform)
    named = openmm.Platform.getPlatformByName(platform)
    return openmm.Context(liquid.system, integrator, named, {"Precision": precision})


def conserved(
    liquid: Liquid, method: Method, dt: float, time: float, interval: float = INTERVAL
) -> tuple[dict[str, Any], Series | None]:
    """Return how well a run conserves energy, and its samples; see `follow` for the arguments.

    Returns:
        `percent` for rms(H)/rms(V) in per cent (see `openmm_sier.analysis.observables.energy_error`), the `drift` of
        the energy of the whole box in kJ/mol/ps with `its_error` as that of a slope, NaN where the run broke down, and
        why it did: `broken`.
    """
    with warnings.catch_warnings():
        # What a step or a System does to the energy is what is measured here.
        warnings.simplefilter("ignore")
        try:
            series = follow(liquid, method, dt, time, interval=interval).series
        except Unstable as error:
            return dict.fromkeys(("percent", "drift", "its_error"), math.nan) | {"broken": str(error)}, None
    drift, uncertainty, _ = slope_and_error(series.time, series.total)
    percent = 100 * energy_error(series.total, series.potential)
    return {"percent": percent, "drift": drift, "its_error": uncertainty, "broken": ""}, series


def over_starts(runs: pd.DataFrame, names: Sequence[str]) -> dict[str, Any]:
    """Means over runs that differ in their seeds alone, with standard errors; NaN where one is `broken`."""
    row: dict[str, Any] = {"starts": len(runs), "broken": next((reason for reason in runs["broken"] if reason), "")}
    for name in names:
        row[name] = runs[name].mean(skipna=False)
        row[f"{name}_error"] = runs[name].std(skipna=False) / math.sqrt(len(runs))
    return row


def sample(
    context: openmm.Context, bodies: BodySet, steps: int, every: int, progress: Callable[[int], None] | None = None
) -> Series:
    """Run a Context and record energies and temperatures at whole steps.

    OpenMM's leapfrog keeps velocities half a step behind. Its temperatures are taken at the whole step, from velocities
    that the forces have advanced by half a step, as OpenMM's own kinetic energy is.

    Args:
        context: with positions and velocities.
        bodies: its rigid bodies.
        steps: number of steps.
        every: steps between two samples.
        progress: called with the number of steps done.

    Raises:
        Unstable: an energy is not finite, a temperature is above `HIGHEST_TEMPERATURE`, or molecules are torn apart.
    """
    integrator = context.getIntegrator()
    conserved = _conserves_momentum(context, bodies)
    rows = []
    for step_count in range(every, steps + 1, every):
        integrator.step(every)
        try:
            rows.append(observe(context, bodies, conserved))
        except (RigidityError, NotFiniteError) as error:
            raise Unstable(f"after {step_count} steps {error}") from error
        if not rows[-1].sane:
            raise Unstable(f"{rows[-1]} after {step_count} steps")
        if progress is not None:
            progress(step_count)
    return Series(*np.array(rows).T)


def _conserves_momentum(context: openmm.Context, bodies: BodySet) -> bool:
    """Return whether a Context with one of `studies.methods` conserves the total momentum."""
    integrator = context.getIntegrator()
    if isinstance(integrator, SIERIntegrator):
        return integrator.conservesMomentum
    has_friction = isinstance(integrator, openmm.LangevinMiddleIntegrator)
    return MomentumConservation(context.getSystem(), bodies).holds(integrator.getIntegrationForceGroups(), has_friction)


class Sample(NamedTuple):
    """The values of `Series` at one step."""

    time: float
    potential: float
    kinetic: float
    translation: float
    rotation: float
    volume: float

    @property
    def sane(self) -> bool:
        # A temperature is NaN where there is no such motion.
        hot = self.translation > HIGHEST_TEMPERATURE or self.rotation > HIGHEST_TEMPERATURE
        return math.isfinite(self.potential) and math.isfinite(self.kinetic) and not hot

    def __str__(self) -> str:
        return f"temperatures of {self.translation:.0f} K and {self.rotation:.0f} K, V = {self.potential:.4g} kJ/mol"


def observe(context: openmm.Context, bodies: BodySet, conserved: bool) -> Sample:
    """Energies and temperatures of a Context at a whole step.

    Args:
        context: with positions and velocities.
        bodies: its rigid bodies.
        conserved: whether the total momentum is conserved, see `MomentumConservation`.
    """
    state = context.getState(energy=True)
    kelvins = temperatures(bodies, body_state(context, bodies), conserved)
    time, potential, kinetic = map(md, (state.getTime(), state.getPotentialEnergy(), state.getKineticEnergy()))
    return Sample(time, potential, kinetic, kelvins.translation, kelvins.rotation, md(state.getPeriodicBoxVolume()))


def body_state(context: openmm.Context, bodies: BodySet) -> BodyState:
    """The state of the bodies at a whole step, for any integrator; see `sample`."""
    integrator = context.getIntegrator()
    if isinstance(integrator, SIERIntegrator):
        return integrator.getBodyState()
    return openmm_integrators.body_state(context, bodies)


def steepness(context: openmm.Context, bodies: BodySet, samples: int, every: int) -> tuple[float, float]:
    """Temperature times the mean squared frequency of translation and of rotation, K/ps^2.

    In equilibrium <F M^-1 F> = kT <tr M^-1 V''>, and likewise with torques and moments, so it follows from forces.

    Args:
        context: of a SIERIntegrator, with positions and velocities in equilibrium.
        bodies: its rigid bodies.
        samples: how many are taken.
        every: steps before each.
    """
    sums = np.zeros(2)
    for _ in range(samples):
        context.getIntegrator().step(every)
        forces = md(context.getState(forces=True).getForces(asNumpy=True))
        A = context.getIntegrator().getBodyState().A
        F, tau = bodies.forces_and_torques(forces, A)
        sums += (F * F / bodies.masses).sum(), (body_frame(A, tau) ** 2 * bodies.inverse_moments).sum()
    # Forces do not know whether the total momentum is conserved.
    dof = np.array(degrees_of_freedom(bodies, conserved=False)[:2])
    translation, rotation = np.divide(sums / (samples * GAS_CONSTANT), dof, out=np.zeros(2), where=dof > 0)
    return float(translation), float(rotation)
