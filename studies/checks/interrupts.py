"""Ctrl-C at random moments of every kind of run: the Context must be at a completed step, and the run must go on.

    python -m studies.checks.interrupts [--interrupts 2000] [--engines exact] [--runs langevin]

Another process sends real SIGINTs while a small box of water is run, mostly into calls of `step`. After each
KeyboardInterrupt the time must be that of the steps, molecules must be rigid, and the momentum and the total energy
less the heat must be what they were. One more step is made then. Energies and momenta at all these steps, and
positions, velocities and box at the end, must be those of a run that nothing disturbed, bit for bit.
"""

from __future__ import annotations

import math
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
import pandas as pd
from openmm import unit

from openmm_sier import SIER2, SIERHMCIntegrator, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.cli.stopping import interrupt_behind
from studies import records
from studies.checks.soak import deformation, water
from studies.command import Settings, chosen, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

STEP, TEMPERATURE, FRICTION = 0.001, 297.0, 5.0

#: Of the barostats, bar and steps: moves of the volume in every other step.
PRESSURE, INTERVAL = 1.0, 2

#: Steps of the scheme in a trial, and the longer step that has some of them rejected.
TRIAL, TRIAL_STEP = 3, 0.003

#: Largest errors of distances in nm, and of the total momentum in dalton nm/ps. In the native engine OpenMM solves
#: constraints to a relative 1e-9.
EXACTNESS = {"exact": 1e-9, "native": 1e-7}

#: Steps of a call that is interrupted, and of the run that heats the lattice.
CALL, MELTING = 8, 300

#: Longest time to an interrupt, in steps.
LATEST = 4.0

#: Energy in units of the mean kinetic energy by which H may differ from its first value, but for trials, each of which
#: adds its error. The errors of SIER2 at 1 fs stay an order below.
JUMP = 0.05

#: A process that sends SIGINT to its parent after as many seconds as it is told.
SENDER = """
import os, signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
for line in sys.stdin:
    time.sleep(float(line))
    os.kill(os.getppid(), signal.SIGINT)
"""

COLUMNS = {
    "run": "{run}",
    "engine": "{engine}",
    "interrupts": "{interrupts}",
    "after a step": "{after}",
    "as SystemError": "{errors}",
    "steps": "{steps}",
    "time/fs": "{time:.1e}",
    "rigid/nm": "{deformation:.1e}",
    "momentum/dalton nm/ps": "{momentum:.1e}",
    "H/kJ/mol": "{jump:.3f}",
    "kinetic energy/kJ/mol": "{kinetic:.0f}",
}


class Broken(ValueError):
    """An interrupt left something that is not a completed step."""


# --- what is run ---

Made = tuple[openmm.System, SIERIntegrator]


def _constant_energy(system: openmm.System, engine: str) -> Made:
    return system, SIERIntegrator(STEP, SIER2, engine=engine)


def _langevin(system: openmm.System, engine: str, **options: Any) -> Made:
    return system, SIERLangevinIntegrator(TEMPERATURE, FRICTION, STEP, SIER2, engine=engine, **options)


def _with_barostat(system: openmm.System, engine: str) -> Made:
    barostat = openmm.MonteCarloBarostat(PRESSURE * unit.bar, TEMPERATURE * unit.kelvin, INTERVAL)
    barostat.setRandomNumberSeed(1)
    system.addForce(barostat)
    return _langevin(system, engine)


def _hybrid(system: openmm.System, engine: str) -> Made:
    return system, SIERHMCIntegrator(TEMPERATURE, TRIAL_STEP, SIER2, TRIAL, engine=engine)


#: What adds to a System what a kind of run needs, and makes its integrator.
RUNS: dict[str, Callable[[openmm.System, str], Made]] = {
    "constant-energy": _constant_energy,
    "langevin": _langevin,
    "pressure": partial(_langevin, pressure=PRESSURE, barostatInterval=INTERVAL),
    "barostat": _with_barostat,
    "hmc": _hybrid,
}


@dataclass(frozen=True)
class InterruptSettings(Settings):
    """What is interrupted, and how often.

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


@dataclass(frozen=True)
class Subject:
    """A run that can be made twice alike: its Context at step 0."""

    context: openmm.Context
    integrator: SIERIntegrator

    @property
    def now(self) -> tuple[np.ndarray, ...]:
        """Positions, velocities and box."""
        state = self.context.getState(positions=True, velocities=True)
        places, speeds = state.getPositions(asNumpy=True), state.getVelocities(asNumpy=True)
        return md(places), md(speeds), md(state.getPeriodicBoxVectors(asNumpy=True))


def start_of(molecules: int, seed: int) -> openmm.State:
    """A warm box of water."""
    system, positions = water(molecules)
    _, bath = _langevin(_with_room(system), "exact")
    bath.setRandomNumberSeed(seed)
    context = openmm.Context(system, bath, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(positions)
    context.setVelocitiesToTemperature(TEMPERATURE, seed)
    bath.step(MELTING)
    return context.getState(positions=True, velocities=True)


def _with_room(system: openmm.System) -> openmm.System:
    """A System with a cut-off so short that its box may shrink."""
    nonbonded = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    cutoff = 0.8 * nonbonded.getCutoffDistance()
    nonbonded.setCutoffDistance(cutoff)
    nonbonded.setSwitchingDistance(0.8 * cutoff)
    return system


def subject(run: str, engine: str, start: openmm.State, settings: InterruptSettings) -> Subject:
    """A run at its beginning, with the first step made, so that all that is set up once is there."""
    system, integrator = RUNS[run](_with_room(water(settings.molecules)[0]), engine)
    integrator.setRandomNumberSeed(settings.seed)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPeriodicBoxVectors(*start.getPeriodicBoxVectors())
    context.setPositions(start.getPositions())
    context.setVelocities(start.getVelocities())
    integrator.step(1)
    return Subject(context, integrator)


# --- interrupts ---


@contextmanager
def sender() -> Iterator[Callable[[float], None]]:
    """A process that interrupts this one so many seconds after each call."""
    process = subprocess.Popen([sys.executable, "-c", SENDER], stdin=subprocess.PIPE, text=True)
    assert process.stdin is not None
    orders = process.stdin

    def send(seconds: float) -> None:
        orders.write(f"{seconds}\n")
        orders.flush()

    try:
        yield send
    finally:
        orders.close()
        process.wait()


def interrupt(tested: Subject, send: Callable[[float], None], seconds: float, lengths: Iterator[int]) -> bool:
    """Run until the interrupt comes.

    Returns:
        Whether Python made a SystemError of it.
    """
    try:
        send(seconds)
        while True:
            tested.integrator.step(next(lengths))
    except KeyboardInterrupt:
        return False
    except SystemError as error:
        if interrupt_behind(error) is None:
            raise
        return True


def look(tested: Subject, engine: str) -> dict[str, float]:
    """The figures of the Context after an interrupt.

    Raises:
        Broken: it is not at a completed step.
    """
    state = tested.context.getState(energy=True)
    steps, size = state.getStepCount(), md(tested.integrator.getStepSize())
    off = abs(md(state.getTime()) - steps * size)
    # Each of the sums that made the time was rounded.
    if off > steps * np.finfo(float).eps * md(state.getTime()):
        raise Broken(f"after {steps} steps of {size:g} ps the time is {state.getTime()}")
    bodies, motion = tested.integrator.bodies, tested.integrator.getBodyState()
    bent = deformation(tested.now[0], bodies)
    if not bent < EXACTNESS[engine]:
        raise Broken(f"after {steps} steps a distance in a molecule is off by {bent:.1e} nm")
    kinetic = sum(bodies.kinetic_energies(motion))
    conserved = md(state.getPotentialEnergy()) + kinetic - motion.heat
    momentum = bodies.total_momenta(motion)[0]
    return {
        "steps": steps,
        "time": 1e3 * off,
        "deformation": bent,
        "kinetic": kinetic,
        "H": conserved,
        **dict(zip("xyz", momentum, strict=True)),
    }


def disturb(tested: Subject, engine: str, settings: InterruptSettings) -> tuple[pd.DataFrame, int, int]:
    """Interrupt a run again and again, with a step after each interrupt that nothing disturbs.

    Returns:
        What `look` found before and after each interrupt, how many of these came when a step had been completed since
        the one before, and how many were SystemErrors.

    Raises:
        Broken: something is wrong after one.
    """
    rng, after, errors = np.random.default_rng(settings.seed), 0, 0
    lengths = iter(lambda: int(rng.integers(1, CALL + 1)), 0)
    begun = perf_counter()
    tested.integrator.step(CALL)
    latest = LATEST * (perf_counter() - begun) / CALL
    looks = [look(tested, engine)]
    with sender() as send:
        for _ in range(settings.interrupts):
            try:
                errors += interrupt(tested, send, rng.uniform(0, latest), lengths)
            finally:
                looks.append(look(tested, engine))
            done = looks[-1]["steps"]
            after += done > looks[-2]["steps"]
            tested.integrator.step(1)
            looks.append(look(tested, engine))
            if looks[-1]["steps"] != done + 1:
                raise Broken(f"a step after an interrupt led from step {done} to {looks[-1]['steps']}")
    return pd.DataFrame(looks), after, errors


def compare(tested: Subject, found: pd.DataFrame, undisturbed: Subject, engine: str) -> None:
    """Check that a run is the same as one that was not interrupted.

    The other run is looked at where the first one was: with OpenMM's CustomIntegrator a request for the energy takes
    random numbers. It has to begin only now, since all Contexts on the Reference platform share their generator.

    Raises:
        Broken: they differ.
    """
    for _, seen in found.iterrows():
        undisturbed.integrator.step(int(seen["steps"]) - undisturbed.context.getStepCount())
        if (now := look(undisturbed, engine)) != seen.to_dict():
            raise Broken(f"at step {now['steps']} it has {seen.to_dict()}, an undisturbed run {now}")
    if not all(np.array_equal(one, two) for one, two in zip(tested.now, undisturbed.now, strict=True)):
        raise Broken("its last positions are not those of an undisturbed run")


def row(run: str, engine: str, start: openmm.State, settings: InterruptSettings) -> dict[str, Any]:
    """Interrupt a run, and compare it with an undisturbed one.

    Raises:
        Broken: an interrupt left a trace.
    """
    try:
        tested = subject(run, engine, start, settings)
        found, after, errors = disturb(tested, engine, settings)
        drift = found[["x", "y", "z"]] - found[["x", "y", "z"]].iloc[0]
        momentum = float(np.abs(drift).max(axis=None)) if run == "constant-energy" else math.nan
        if momentum > EXACTNESS[engine]:
            raise Broken(f"the total momentum changed by {momentum:.1e} dalton nm/ps")
        # OpenMM's barostat counts no heat.
        jump = float(np.abs(found["H"] - found["H"].iloc[0]).max()) if run != "barostat" else math.nan
        kinetic = float(found["kinetic"].mean())
        if run != "hmc" and jump > JUMP * kinetic:
            raise Broken(f"the total energy less the heat changed by {jump:.3g} kJ/mol, of {kinetic:.0f} in motion")
        compare(tested, found, subject(run, engine, start, settings), engine)
    except Broken as error:
        raise Broken(f"{run}, {engine} engine: {error}") from error
    return {
        "run": run,
        "engine": engine,
        "interrupts": settings.interrupts,
        "after": after,
        "errors": errors,
        "steps": tested.context.getStepCount(),
        "time": found["time"].max(),
        "deformation": found["deformation"].max(),
        "momentum": momentum,
        "jump": jump,
        "kinetic": kinetic,
    }


def study(settings: InterruptSettings, report: Report = SILENT) -> Record:
    """Interrupt all runs with both engines, and write interrupts.json.

    Raises:
        Broken: an interrupt left a trace.
        ValueError: there is no such run or engine.
    """
    chosen(settings.runs, RUNS, "run")
    chosen(settings.engines, EXACTNESS, "engine")
    start = start_of(settings.molecules, settings.seed)
    rows = []
    for run, engine in product(settings.runs or RUNS, settings.engines or EXACTNESS):
        rows.append(row(run, engine, start, settings))
        report.note(records.cell("{run}, {engine}: {interrupts} interrupts, {steps} steps", rows[-1]))
    found = pd.DataFrame(rows)
    report.table(records.table(f"SIGINT, {settings.molecules} molecules of water", found, COLUMNS, left=2))
    return Record(settings.recorded(), {"rows": found}, {}).write(settings.out / "interrupts.json")


main = command(InterruptSettings, study, __doc__, __name__)
