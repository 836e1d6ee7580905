"""Ctrl-C at random moments of every kind of run: the Context must be at a completed step, and the run must continue.

    python -m tests.loops.interrupts [--interrupts 2000] [--engines exact] [--runs langevin]

Another process sends real SIGINTs while a small box of water is run, mostly into calls of `step`. One more step is made
after each KeyboardInterrupt. Time, energies and momenta at all these steps, and positions, velocities and box at the
end, must be those of a run that nothing disturbed, bit for bit.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier import SIER2, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.cli.stopping import interrupt_behind
from openmm_sier.inputs import forcefields
from studies import boxes, text
from studies.command import Settings, chosen, command
from studies.report import SILENT, Report
from studies.units import md

STEP, TEMPERATURE, FRICTION = 0.001, 297.0, 5.0

#: Of the barostats, bar and steps: moves of the volume in every other step.
PRESSURE, INTERVAL = 1.0, 2

#: Steps of the scheme in a trial, and the longer step that has some of them rejected.
TRIAL, TRIAL_STEP = 3, 0.003

#: nm: a cut-off so short that the box may shrink.
CUTOFF = 0.35

#: Steps of a call that is interrupted, and of the run that heats the lattice.
CALL, MELTING = 8, 300

#: Longest time to an interrupt, in steps.
LATEST = 4.0

#: A process that sends SIGINT to its parent after as many seconds as it is told.
SENDER = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
for line in sys.stdin:
    time.sleep(float(line))
    os.kill(os.getppid(), signal.SIGINT)
"""

ENGINES = ("exact", "native")

#: Makes the integrator of a kind of run; `barostat` has OpenMM's in its System.
RUNS: dict[str, Callable[..., SIERIntegrator]] = {
    "constant-energy": partial(SIERIntegrator, STEP, SIER2),
    "langevin": (bath := partial(SIERLangevinIntegrator, TEMPERATURE, FRICTION, STEP, SIER2)),
    "pressure": partial(bath, pressure=PRESSURE, barostatInterval=INTERVAL),
    "barostat": bath,
    "hmc": partial(SIERHMCIntegrator, TEMPERATURE, TRIAL_STEP, SIER2, TRIAL),
}


class Broken(ValueError):
    """An interrupt left something that is not a completed step."""


@dataclass(frozen=True, kw_only=True)
class InterruptSettings(Settings):
    """Runs to interrupt, and the number of interrupts.

    Attributes:
        interrupts: of each run with each engine.
        runs: by name.
        engines: by name.
        molecules: of water.
    """

    interrupts: int = 2000
    runs: tuple[str, ...] = ()
    engines: tuple[str, ...] = ()
    molecules: int = 27


def context_of(run: str, engine: str, settings: InterruptSettings) -> openmm.Context:
    """A run of water, whose positions and velocities are not yet set."""
    topology, _ = boxes.on_lattice(settings.molecules)
    system = forcefields.load(["tip3p.xml"]).createSystem(
        topology,
        nonbondedMethod=app.CutoffPeriodic,
        nonbondedCutoff=CUTOFF,
        switchDistance=0.8 * CUTOFF,
        removeCMMotion=False,
    )
    if run == "barostat":
        barostat = openmm.MonteCarloBarostat(PRESSURE * unit.bar, TEMPERATURE * unit.kelvin, INTERVAL)
        barostat.setRandomNumberSeed(1)
        system.addForce(barostat)
    integrator = RUNS[run](engine=engine)
    integrator.setRandomNumberSeed(settings.seed)
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))


def start_of(settings: InterruptSettings) -> openmm.State:
    """A warm box of water."""
    context = context_of("langevin", "exact", settings)
    context.setPositions(boxes.on_lattice(settings.molecules)[1])
    context.setVelocitiesToTemperature(TEMPERATURE, settings.seed)
    context.getIntegrator().step(MELTING)
    return context.getState(positions=True, velocities=True)


def begun(run: str, engine: str, start: openmm.State, settings: InterruptSettings) -> openmm.Context:
    """A run at its beginning, with the first step made, so that all that is set up once is there."""
    context = context_of(run, engine, settings)
    context.setPeriodicBoxVectors(*start.getPeriodicBoxVectors())
    context.setPositions(start.getPositions())
    context.setVelocities(start.getVelocities())
    context.getIntegrator().step(1)
    return context


def look(context: openmm.Context) -> dict[str, float]:
    """The number of steps, time, energies and momentum."""
    state, integrator = context.getState(energy=True), context.getIntegrator()
    motion, bodies = integrator.getBodyState(), integrator.bodies
    results = {"steps": state.getStepCount(), "time": md(state.getTime()), "potential": md(state.getPotentialEnergy())}
    results |= {"kinetic": sum(bodies.kinetic_energies(motion)), "heat": integrator.countedHeat}
    return results | dict(zip("xyz", bodies.total_momenta(motion)[0], strict=True))


def place(context: openmm.Context) -> np.ndarray:
    """Positions, velocities and box."""
    state = context.getState(positions=True, velocities=True)
    arrays = state.getPositions(asNumpy=True), state.getVelocities(asNumpy=True), state.getPeriodicBoxVectors(True)
    return np.concatenate([md(array) for array in arrays])


@contextmanager
def sender() -> Iterator[Callable[[float], None]]:
    """A process that interrupts this one so many seconds after each call."""
    with subprocess.Popen([sys.executable, "-c", SENDER], stdin=subprocess.PIPE, text=True) as process:
        yield lambda seconds: print(seconds, file=process.stdin, flush=True)


def interrupt(context: openmm.Context, send: Callable[[float], None], seconds: float, lengths: Iterator[int]) -> bool:
    """Run until the interrupt comes.

    Returns:
        Whether Python made a SystemError of it.
    """
    try:
        send(seconds)
        while True:
            context.getIntegrator().step(next(lengths))
    except KeyboardInterrupt:
        return False
    except SystemError as error:
        if interrupt_behind(error) is None:
            raise
        return True


def disturb(context: openmm.Context, settings: InterruptSettings) -> tuple[list[dict[str, float]], int, int]:
    """Interrupt a run again and again, with a step after each interrupt that nothing disturbs.

    Returns:
        What `look` found before and after each interrupt, how many of these came when a step had been completed since
        the one before, and how many were SystemErrors.

    Raises:
        Broken: the run did not go on with the next step.
    """
    rng, after, errors = np.random.default_rng(settings.seed), 0, 0
    lengths = iter(lambda: int(rng.integers(1, CALL + 1)), 0)
    start = perf_counter()
    context.getIntegrator().step(CALL)
    latest = LATEST * (perf_counter() - start) / CALL
    looks = [look(context)]
    with sender() as send:
        for _ in range(settings.interrupts):
            try:
                errors += interrupt(context, send, rng.uniform(0, latest), lengths)
            finally:
                looks.append(look(context))
            steps_done = looks[-1]["steps"]
            after += steps_done > looks[-2]["steps"]
            context.getIntegrator().step(1)
            looks.append(look(context))
            if looks[-1]["steps"] != steps_done + 1:
                raise Broken(f"a step after an interrupt led from step {steps_done} to {looks[-1]['steps']}")
    return looks, after, errors


def compare(tested: openmm.Context, looks: list[dict[str, float]], undisturbed: openmm.Context) -> None:
    """Check that a run is the same as one that was not interrupted.

    The other run is looked at where the first one was: with OpenMM's CustomIntegrator a request for the energy takes
    random numbers. It has to begin only now, since all Contexts on the Reference platform share their generator.

    Raises:
        Broken: they differ.
    """
    for seen in looks:
        undisturbed.getIntegrator().step(int(seen["steps"]) - undisturbed.getStepCount())
        if (now := look(undisturbed)) != seen:
            raise Broken(f"at step {now['steps']} it has {seen}, an undisturbed run {now}")
    if not np.array_equal(place(tested), place(undisturbed)):
        raise Broken("its last positions are not those of an undisturbed run")


def row(run: str, engine: str, start: openmm.State, settings: InterruptSettings) -> dict[str, Any]:
    """Interrupt a run, and compare it with an undisturbed one.

    Raises:
        Broken: an interrupt left a trace.
    """
    try:
        tested = begun(run, engine, start, settings)
        looks, after, errors = disturb(tested, settings)
        compare(tested, looks, begun(run, engine, start, settings))
    except Broken as error:
        raise Broken(f"{run}, {engine} engine: {error}") from error
    record = {"run": run, "engine": engine, "interrupts": settings.interrupts}
    return record | {"after": after, "errors": errors, "steps": tested.getStepCount()}


def study(settings: InterruptSettings, report: Report = SILENT) -> list[dict[str, Any]]:
    """Interrupt all runs with both engines.

    Raises:
        Broken: an interrupt left a trace.
        ValueError: there is no such run or engine.
    """
    chosen(settings.runs, RUNS, "run")
    chosen(settings.engines, dict.fromkeys(ENGINES), "engine")
    start = start_of(settings)
    form = "{run}, {engine}: {interrupts} interrupts, {after} after a step, {errors} as SystemError, {steps} steps"
    rows = []
    for run, engine in product(settings.runs or RUNS, settings.engines or ENGINES):
        rows.append(row(run, engine, start, settings))
        report.note(text.cell(form, rows[-1]))
    return rows


main = command(InterruptSettings, study, __doc__, __name__)
