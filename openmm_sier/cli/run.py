"""The command `openmm-sier run`: a PDB file in, a trajectory out."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import openmm
from openmm import app, unit

from openmm_sier.cli import records, summary
from openmm_sier.cli.console import REPORT, ProgressBar, clock, note, table
from openmm_sier.context import conservation
from openmm_sier.context.find_bodies import RigidBodies
from openmm_sier.context.integrator import SIERIntegrator
from openmm_sier.context.langevin import SIERLangevinIntegrator
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.measure.force_clock import ForceClock
from openmm_sier.measure.forcefields import Box, describe, first_line, read_box
from openmm_sier.measure.starts import make_context, prepare

#: What `--scheme auto` stands for; the README's page on choosing a step says why.
RECOMMENDED = "sier4g"

#: Steps between two updates of the progress bar.
LONGEST_CHUNK = 20

#: How far the energy of a checkpoint's positions may be from the one noted in it: platforms differ by single precision.
ENERGY_TOLERANCE = 1e-4

#: Options that a restart takes from its checkpoint.
CONTINUED = (
    "ensemble",
    "friction",
    "pressure",
    "forcefield",
    "scheme",
    "dt",
    "every",
    "report_every",
    "checkpoint_every",
    "out",
    "report",
)


class RunError(ValueError):
    """The command cannot do what it was asked for."""


@dataclass(frozen=True)
class Options:
    """What the command was given; None where it was left to the command. Times in ps but `dt`, which is in fs."""

    box: Path
    forcefield: list[str] | None = None
    scheme: str | None = None
    dt: float | None = None
    steps: int | None = None
    time: float | None = None
    temperature: float = 297.0
    equilibrate: float | None = None
    minimize: bool | None = None
    out: Path | None = None
    report: Path | None = None
    every: float | None = None
    report_every: float | None = None
    checkpoint_every: float | None = None
    ensemble: str | None = None
    friction: float | None = None
    pressure: float | None = None
    seed: int = 1
    platform: str | None = None
    restart: Path | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class Plan:
    """What a run and its continuations have in common; the units are those of `Options`, 1/ps and bar."""

    ensemble: str
    temperature: float
    friction: float
    pressure: float
    seed: int
    forcefield: list[str] | None
    scheme: str
    dt: float
    steps: int
    every: float
    report_every: float
    checkpoint_every: float
    out: str
    report: str

    @property
    def title(self) -> str:
        """Scheme, ensemble and step."""
        bath = f", {self.temperature:g} K" if self.ensemble != "nve" else ""
        piston = f", {self.pressure:g} bar" if self.ensemble == "npt" else ""
        return f"{CATALOGUE[self.scheme].name}, {self.ensemble.upper()}{bath}{piston}, {self.dt:g} fs"

    def interval(self, time: float) -> int:
        """Steps that come nearest to a time, at least 1."""
        return max(1, round(time * 1000 / self.dt))


def run(options: Options) -> None:
    """Carry out `openmm-sier run`.

    Raises:
        RunError: options contradict each other or the checkpoint, or a file is in the way.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
        KeyboardInterrupt: with a message that says how to go on.
    """
    state, notes = records.read_checkpoint(options.restart) if options.restart else (None, {})
    plan = _continued(options, notes["plan"]) if notes else _planned(options)
    checkpoint = options.restart or Path(plan.out).with_suffix(".chk")
    records.trajectory_format(Path(plan.out))
    paths = [Path(plan.out), Path(plan.report), checkpoint]
    if not notes:
        _check_paths(paths, options.overwrite)
    box = read_box(options.box, plan.forcefield)
    note(f"{options.box}: force field {' '.join(box.choice.files)} ({box.choice.reason}); {describe(box)}")
    bodies = RigidBodies.from_system(box.system, box.topology)
    if plan.ensemble == "npt" and not box.system.usesPeriodicBoundaryConditions():
        raise RunError("--ensemble npt needs a periodic box, which the PDB file does not have")
    context = make_context(box.system, _integrator(plan, bodies), options.platform)
    if notes:
        _restore(context, state, notes, options, plan)
    else:
        prepare(
            context,
            box.positions,
            options.temperature,
            options.seed,
            options.equilibrate,
            options.minimize,
            REPORT,
        )
        # The checkpoint goes first, so that none is ever left with files that are not its own.
        for path in reversed(paths):
            path.unlink(missing_ok=True)
    record = _Files(plan, box, checkpoint, notes)
    note(
        f"{plan.title}, to step {plan.steps} ({plan.steps * plan.dt / 1000:g} ps) "
        f"on the {context.getPlatform().getName()} platform"
    )
    try:
        cost = _advance(context, plan, record)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted at step {context.getStepCount()}; go on from the last checkpoint with --restart {checkpoint}"
        ) from None
    record.finish()
    rows = summary.conservation_rows(record.log.read()) + cost.rows()
    table(f"{plan.title}, {plan.steps * plan.dt / 1000:g} ps", ("", ""), rows)
    note(f"wrote {plan.out}, {plan.report} and {checkpoint}")


# --- the plan ---


def _planned(options: Options) -> Plan:
    scheme = RECOMMENDED if options.scheme == "auto" else options.scheme or "sier4"
    # 1 fs for each force evaluation.
    dt = options.dt or float(CATALOGUE[scheme].force_evaluations)
    ensemble = options.ensemble or "nve"
    _check_ensemble(options, ensemble)
    out = options.out or Path(f"{options.box.stem}.dcd")
    return Plan(
        ensemble=ensemble,
        temperature=options.temperature,
        friction=1.0 if options.friction is None else options.friction,
        pressure=1.0 if options.pressure is None else options.pressure,
        seed=options.seed,
        forcefield=options.forcefield,
        scheme=scheme,
        dt=dt,
        steps=_length(options, dt) or round(10_000 / dt),
        every=options.every or 0.1,
        report_every=options.report_every or 0.04,
        checkpoint_every=options.checkpoint_every or 1.0,
        out=str(out),
        report=str(options.report or out.with_suffix(".csv")),
    )


def _check_ensemble(options: Options, ensemble: str) -> None:
    if options.friction is not None and ensemble == "nve":
        raise RunError("--friction needs --ensemble nvt or npt")
    if options.pressure is not None and ensemble != "npt":
        raise RunError("--pressure needs --ensemble npt")


def _integrator(plan: Plan, bodies: RigidBodies) -> SIERIntegrator:
    step, scheme = plan.dt / 1000, CATALOGUE[plan.scheme]
    if plan.ensemble == "nve":
        return SIERIntegrator(step, scheme, bodies)
    pressure = plan.pressure if plan.ensemble == "npt" else None
    integrator = SIERLangevinIntegrator(plan.temperature, plan.friction, step, scheme, bodies, pressure=pressure)
    integrator.setRandomNumberSeed(plan.seed)
    return integrator


def _length(options: Options, dt: float) -> int | None:
    return max(1, round(options.time * 1000 / dt)) if options.time is not None else options.steps


def _continued(options: Options, saved: dict[str, Any]) -> Plan:
    """The plan of a checkpoint, with another length if one is given.

    Raises:
        RunError: an option asks for something else than the checkpoint has.
    """
    saved = {
        **saved,
        "out": _beside(options.restart, saved["out"]),
        "report": _beside(options.restart, saved["report"]),
    }
    for name in CONTINUED:
        given = getattr(options, name)
        given = os.path.normpath(given) if isinstance(given, Path) else given
        if given is not None and given != saved[name]:
            raise RunError(
                f"--{name.replace('_', '-')} {given} differs from {saved[name]} of {options.restart}; leave it out"
            )
    return Plan(**{**saved, "steps": _length(options, saved["dt"]) or saved["steps"]})


def _beside(checkpoint: Path | None, relative: str) -> str:
    return os.path.normpath(os.path.join(os.path.dirname(str(checkpoint)), relative))


def _check_paths(paths: list[Path], overwrite: bool) -> None:
    if len({os.path.abspath(path) for path in paths}) < len(paths):
        raise RunError(f"trajectory, log and checkpoint must be different files, got {', '.join(map(str, paths))}")
    for path in paths:
        if path.exists() and not overwrite:
            raise RunError(f"{path} exists. Go on from a checkpoint with --restart FILE, or allow --overwrite")
        if not path.parent.is_dir():
            raise RunError(f"there is no directory {path.parent} for {path.name}")


# --- the continuation ---


def _restore(context, state, notes: dict[str, Any], options: Options, plan: Plan) -> None:
    """Put a Context where a checkpoint left off.

    Raises:
        RunError: the checkpoint is of another system, or nothing is left to be done.
    """
    # An .h5 file comes last of all: a run that was killed before is still to be finished.
    if notes["step"] > plan.steps or (notes["step"] == plan.steps and Path(plan.out).exists()):
        raise RunError(
            f"{options.restart} is at step {notes['step']} ({notes['step'] * plan.dt / 1000:g} ps), "
            f"the run is to end at step {plan.steps}; ask for more with --steps or --time"
        )
    there, here = len(state.getPositions()), context.getSystem().getNumParticles()
    if there != here:
        raise RunError(f"{options.restart} has {there} particles, {options.box} with its force field {here}")
    try:
        context.setState(state)
    except openmm.OpenMMException as error:
        raise RunError(f"{options.restart} does not fit {options.box}: {first_line(error)}") from error
    energy = _potential_energy(context)
    if abs(energy - notes["potential_energy"]) > ENERGY_TOLERANCE * (abs(energy) + 1):
        raise RunError(
            f"the positions of {options.restart} have the energy {energy:.6g} kJ/mol in the system of {options.box}, "
            f"in the run they had {notes['potential_energy']:.6g}: it is another system or force field"
        )


def _potential_energy(context) -> float:
    return context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)


# --- the run ---


class _Files:
    """Trajectory, log and checkpoint of a run, new or cut back to what a checkpoint notes."""

    def __init__(self, plan: Plan, box: Box, checkpoint: Path, notes: dict[str, Any]):
        self._plan, self._listed, self._checkpoint = plan, box.listed, checkpoint
        self.intervals = {
            self.write_frame: plan.interval(plan.every),
            self.write_row: plan.interval(plan.report_every),
            self.write_checkpoint: plan.interval(plan.checkpoint_every),
        }
        out = Path(plan.out)
        self.trajectory = records.trajectory_format(out)(
            out,
            _subset(box.topology, box.listed),
            plan.dt / 1000,
            plan.interval(plan.every),
            **notes.get("trajectory", {}),
        )
        self.log = records.Log(Path(plan.report), conservation.COLUMNS, **notes.get("log", {}))

    def write_frame(self, context) -> None:
        state = context.getState(
            positions=True, enforcePeriodicBox=context.getSystem().usesPeriodicBoundaryConditions()
        )
        self.trajectory.write(state.getPositions(asNumpy=True)[self._listed], state.getPeriodicBoxVectors())

    def write_row(self, context) -> None:
        self.log.write(conservation.row(context))

    def write_checkpoint(self, context) -> None:
        self.trajectory.sync()
        self.log.sync()
        here = os.path.dirname(self._checkpoint) or "."
        plan = asdict(self._plan)
        notes = {
            "plan": {
                **plan,
                "out": os.path.relpath(plan["out"], here),
                "report": os.path.relpath(plan["report"], here),
            },
            "step": context.getStepCount(),
            "potential_energy": _potential_energy(context),
            "trajectory": self.trajectory.length(),
            "log": self.log.length(),
        }
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        records.write_checkpoint(self._checkpoint, state, notes)

    def due(self, step: int) -> list[Callable]:
        """What is to be written after a step; the checkpoint last, since it notes the lengths of the others."""
        return [write for write, interval in self.intervals.items() if step % interval == 0]

    def next_due(self, step: int) -> int:
        """The first step after this one at which something is to be written."""
        return min((step // interval + 1) * interval for interval in self.intervals.values())

    def finish(self) -> None:
        self.trajectory.finish()
        self.log.close()


def _subset(topology, listed):
    """The Topology of some atoms; names are all that a trajectory needs of them."""
    modeller = app.Modeller(topology, [openmm.Vec3(0, 0, 0)] * topology.getNumAtoms() * unit.nanometer)
    kept = set(listed.tolist())
    modeller.delete([atom for atom in topology.atoms() if atom.index not in kept])
    return modeller.topology


def _advance(context, plan: Plan, files: _Files) -> summary.Cost:
    """Run from the Context's step to the last one of the plan, writing what is due."""
    integrator = context.getIntegrator()
    begun = step = context.getStepCount()
    if not files.log.count:
        files.write_row(context)
        files.write_checkpoint(context)
    watch, seconds, force_seconds = ForceClock(context), 0.0, 0.0
    evaluations = integrator.forceEvaluations
    with ProgressBar(CATALOGUE[plan.scheme].name, plan.steps, plan.dt / 1000, begun) as show:
        while step < plan.steps:
            chunk = min(files.next_due(step), plan.steps, step + LONGEST_CHUNK) - step
            start, before = clock(), watch.seconds
            integrator.step(chunk)
            seconds += clock() - start
            force_seconds += watch.seconds - before
            step += chunk
            for write in files.due(step):
                write(context)
            show(step)
        if files.write_checkpoint not in files.due(step):
            files.write_checkpoint(context)
    evaluations = integrator.forceEvaluations - evaluations
    return summary.Cost(step - begun, seconds, force_seconds, evaluations, watch.calls, plan.dt / 1000)
