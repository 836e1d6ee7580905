"""The command `openmm-sier run`: a PDB file in, a trajectory out."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import openmm
from openmm import unit

from openmm_sier.cli import runaway, summary
from openmm_sier.cli.console import REPORT, ProgressBar, clock, note, table
from openmm_sier.cli.files import records
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.files.outputs import (
    Outputs,
    check_belonging,
    check_existing,
    check_outputs,
    files_of,
    is_finished,
    output_paths,
    run_identity,
)
from openmm_sier.cli.info import rigid_bodies
from openmm_sier.cli.plan import NothingLeft, Options, Plan, RunError, continued_plan, new_plan, noted_plan
from openmm_sier.cli.stopping import Stopped, StopRequests, signal_name
from openmm_sier.dynamics.bodies import RigidBodies, RigidityError
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.engines.temperature import degrees_of_freedom
from openmm_sier.integrators.hmc import SIERHMCIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.measure.force_clock import ForceClock
from openmm_sier.measure.forcefields import Box, describe, first_line, locate, read_box
from openmm_sier.measure.starts import make_context, prepare, stop_centre_of_mass
from openmm_sier.observe import conservation, stock
from openmm_sier.prepare.preparation import prepare_system
from openmm_sier_command.options import RECOMMENDED, USUAL_STEPS

#: Most steps between two checks of temperatures and signals, and most seconds that these steps should take.
LONGEST_CHUNK, LONGEST_WAIT = 20, 0.5

#: Relative difference allowed between the energy of a checkpoint's positions and the energy noted in it. Platforms
#: differ by single precision.
ENERGY_TOLERANCE = 1e-4


def run(options: Options) -> None:
    """Run `openmm-sier run`.

    Raises:
        RunError: options contradict each other or the checkpoint, or a file is in the way or cannot be written.
        Runaway: the energy or the temperature ran away.
        Stopped: a signal ended the run; the message says how to go on.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    with FileLocks() as locks, StopRequests(locks.remove) as requests:
        try:
            _run(options, requests, locks)
        except BaseException:
            if (signum := requests.interrupted) is None:
                raise
            message = f"stopped by {signal_name(signum)} before the first step; nothing was written"
            raise Stopped(signum, message) from None


def _run(options: Options, requests: StopRequests, locks: FileLocks) -> None:
    _check_platform(options.platform)
    source = options.restart or options.start
    if options.restart and options.restart.is_file():
        # Before it is read, so that nobody replaces it from here on.
        locks.hold([options.restart])
    state, notes = records.read_checkpoint(source, files=bool(options.restart)) if source else (None, {})
    origin: Plan | None = None
    if options.restart:
        plan, checkpoint = continued_plan(options, options.restart, notes["plan"]), options.restart
    else:
        origin = noted_plan(options.start, notes["plan"]) if options.start else None
        plan = new_plan(options, origin)
        checkpoint = plan.out.with_suffix(".chk")
        notes = {}
    paths = output_paths(plan, checkpoint)
    check_outputs(paths, _inputs(options))
    locks.hold(files_of(paths).values())
    check_existing(paths, "continue" if options.restart else "replace" if options.overwrite else "refuse")
    noted = check_belonging(paths, notes) if options.restart else {}
    box = read_box(options.box, plan.forcefield, plan.constraints, plan.interactions)
    check_outputs(paths, _inputs(options, box))
    note(f"{options.box}: force field {' '.join(box.choice.files)} ({box.choice.reason}); {describe(box)}")
    bodies = rigid_bodies(box, plan.rigid)
    prepared = prepare_system(box.system, bodies)
    if plan.moves_volume and not box.system.usesPeriodicBoundaryConditions():
        raise RunError("constant pressure needs a periodic box, which the PDB file does not have")
    if plan.pressure_tensor and not box.system.usesPeriodicBoundaryConditions():
        raise RunError("--pressure-tensor needs a periodic box, which the PDB file does not have")
    fast = prepared.fastForceGroups
    if options.restart:
        context = _context(plan, box, bodies, fast, options.platform, notes["step"])
        _restore(context, state, notes, options, plan, is_finished(paths))
    else:
        context = _begin(plan, box, bodies, fast, state, origin, options)
    # From here on, the step and all files are completed before a signal ends the run.
    requests.defer()
    if not options.restart:
        # The checkpoint is removed first, so that it is never left with files that are not its own.
        for path in paths.values():
            path.unlink(missing_ok=True)
        notes = {"run": run_identity(plan, context)}
    note(f"{plan.title}, to step {_length(plan, plan.steps)} on the {context.getPlatform().getName()} platform")
    columns = conservation.columns(context.getIntegrator())
    outputs = Outputs(plan, box, bodies, checkpoint, notes["run"], columns, noted, notes.get("step"))
    dof = degrees_of_freedom(bodies, context.getIntegrator().conservesMomentum)
    guard = runaway.Guard(plan, dof, notes.get("start_energy"))
    cost = _advance(context, plan, outputs, guard, requests)
    outputs.finish()
    _report(plan, outputs, cost)
    note(f"wrote {', '.join(str(path) for path in paths.values())}")


def _inputs(options: Options, box: Box | None = None) -> list[Path]:
    """Files that are read and must not be written. The checkpoint of --restart, which is both, is not among them."""
    files = [options.box, options.start]
    if box is not None:
        files += [Path(locate(file, options.box.parent)) for file in box.choice.files]
    return [path for path in files if path is not None]


def _check_platform(name: str | None) -> None:
    known = [openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())]
    if name is not None and name not in known:
        raise RunError(f"there is no registered Platform {name}, expected one of {', '.join(known)}")


def _context(
    plan: Plan, box: Box, bodies: RigidBodies, fast: Collection[int], platform: str | None, step: int = 0
) -> openmm.Context:
    """The Context of a run that begins or goes on at a step."""
    if plan.method.scheme is not None:
        return make_context(box.system, _integrator(plan, bodies, fast), platform)
    if plan.moves_volume and plan.interval(plan.checkpoint_every) < stock.BAROSTAT_INTERVAL:
        raise RunError(
            f"--checkpoint-every {plan.checkpoint_every:g} is too short: OpenMM's barostat counts its "
            f"{stock.BAROSTAT_INTERVAL} steps anew after each checkpoint"
        )
    bath = plan.temperature if plan.ensemble != "nve" else None
    around = stock.Surroundings(bath, plan.friction, plan.pressure if plan.moves_volume else None)
    integrator = stock.make_stock(plan.scheme, plan.dt / 1000, around)
    system = stock.surrounded(box.system, plan.scheme, around)
    stock.seed_noise(system, integrator, plan.seed, step)
    context = make_context(system, integrator, platform)
    integrator.attend(context, bodies)
    return context


def _integrator(plan: Plan, bodies: RigidBodies, fast: Collection[int]) -> SIERIntegrator:
    step, scheme = plan.dt / 1000, plan.method.scheme or SIER4G
    # The exact engine, which runs on GPUs too, has what the native one lacks: bodies that no constraints hold.
    engine = "exact" if plan.rigid else "auto"
    if plan.ensemble == "nve":
        return SIERIntegrator(step, scheme, bodies, engine=engine, fastForceGroups=fast)
    if plan.ensemble == "hmc":
        return _sampler(plan, bodies, fast)
    pressure = plan.pressure if plan.ensemble == "npt" else None
    integrator = SIERLangevinIntegrator(
        plan.temperature, plan.friction, step, scheme, bodies, pressure=pressure, engine=engine, fastForceGroups=fast
    )
    integrator.setRandomNumberSeed(plan.seed)
    return integrator


def _sampler(plan: Plan, bodies: RigidBodies, fast: Collection[int]) -> SIERIntegrator:
    integrator = SIERHMCIntegrator(
        plan.temperature,
        plan.dt / 1000,
        plan.method.scheme or SIER4G,
        plan.steps_per_trial,
        plan.friction or None,
        plan.pressure,
        engine="exact" if plan.rigid else "auto",
        bodies=bodies,
        fastForceGroups=fast,
    )
    integrator.setRandomNumberSeed(plan.seed)
    return integrator


def _length(plan: Plan, steps: int) -> str:
    return f"{steps} ({steps * plan.step_time:g} ps)"


def _report(plan: Plan, outputs: Outputs, cost: summary.Cost) -> None:
    log = outputs.log.read()
    warning = runaway.fluctuation_warning(plan, log)
    rows = summary.conservation_rows(log)
    rows += summary.density_rows(log) if plan.moves_volume else []
    rows += summary.acceptance_rows(log)
    rows += [("WARNING: rms(H)/rms(V)", warning)] if warning else []
    table(f"{plan.title}, {plan.steps * plan.step_time:g} ps", ("", ""), rows + cost.rows())


# --- the beginning ---


def _begin(
    plan: Plan,
    box: Box,
    bodies: RigidBodies,
    fast: Collection[int],
    state: openmm.State | None,
    origin: Plan | None,
    options: Options,
) -> openmm.Context:
    """The Context of a new run, with positions and velocities.

    All methods begin alike: OpenMM's own integrators go on from a start that one of this package has made.

    Args:
        state, origin: of the checkpoint that the run starts from, and the plan of its run.

    Raises:
        RunError: the checkpoint that it starts from belongs to another system.
        Runaway: the equilibration broke down.
    """
    stand_in = plan if plan.method.scheme else replace(plan, scheme=RECOMMENDED, dt=USUAL_STEPS[RECOMMENDED])
    begun = make_context(box.system, _integrator(stand_in, bodies, fast), options.platform)
    positions = box.positions
    if state is not None:
        _start_from(begun, state, origin, options)
        positions = state.getPositions()
    if options.equilibrates:
        _equilibrate(
            begun, positions, options, plan, minimize=options.minimize if state is None else bool(options.minimize)
        )
    elif plan.ensemble == "nve":
        stop_centre_of_mass(begun)
    if plan.method.scheme:
        return begun
    note(f"bath and barostat of {plan.method.name}: {plan.method.surroundings(plan.ensemble) or 'none'}")
    context = _context(plan, box, bodies, fast, options.platform)
    context.setState(begun.getState(positions=True, velocities=True))
    if plan.method.leapfrog:
        stock.shift_velocities(context, -plan.dt / 2000)
    return context


def _start_from(context: openmm.Context, state: openmm.State, origin: Plan | None, options: Options) -> None:
    """Take positions, velocities and box of a checkpoint."""
    _check_particles(context, state, options.start, options.box)
    context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
    context.setPositions(state.getPositions())
    context.setVelocities(state.getVelocities())
    try:
        context.getIntegrator().getBodyState()
    except RigidityError as error:
        raise RunError(f"{options.start} does not fit {options.box}: {first_line(error)}") from error
    if origin is not None and origin.method.leapfrog:
        stock.shift_velocities(context, origin.dt / 2000)
    note(f"starts from the positions, velocities and box of {options.start}")


def _equilibrate(context: openmm.Context, positions: Any, options: Options, plan: Plan, minimize: bool | None) -> None:
    try:
        prepare(context, positions, plan.temperature, plan.seed, options.equilibrate, minimize, REPORT)
    except openmm.OpenMMException as error:
        if not runaway.is_runaway(error):
            raise
        raise runaway.Runaway(f"the equilibration broke down, do atoms overlap? {first_line(error)}") from error


# --- the continuation ---


def _restore(
    context: openmm.Context,
    state: openmm.State,
    notes: dict[str, Any],
    options: Options,
    plan: Plan,
    finished: bool,
) -> None:
    """Set a Context to the state of a checkpoint.

    Raises:
        RunError: the checkpoint belongs to another system, or the run is already complete.
    """
    # An .h5 file is made last: a run that was killed before that still has to be finished.
    at_end = notes["step"] == plan.steps and finished
    if at_end or notes["step"] > plan.steps:
        raise (NothingLeft if at_end else RunError)(
            f"{options.restart} is at step {_length(plan, notes['step'])}, the run is to end at step {plan.steps}; "
            "ask for more with --steps or --time"
        )
    _check_particles(context, state, options.restart, options.box)
    try:
        context.setState(state)
    except openmm.OpenMMException as error:
        raise RunError(f"{options.restart} does not fit {options.box}: {first_line(error)}") from error
    energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    if abs(energy - notes["potential_energy"]) > ENERGY_TOLERANCE * (abs(energy) + 1):
        raise RunError(
            f"the positions of {options.restart} have the energy {energy:.6g} kJ/mol in the system of {options.box}, "
            f"in the run they had {notes['potential_energy']:.6g}: it is another system or force field"
        )


def _check_particles(context: openmm.Context, state: openmm.State, checkpoint: Path | None, box: Path) -> None:
    there, here = len(state.getPositions()), context.getSystem().getNumParticles()
    if there != here:
        raise RunError(f"{checkpoint} has {there} particles, {box} with its force field {here}")


# --- the run ---


def _advance(
    context: openmm.Context, plan: Plan, outputs: Outputs, guard: runaway.Guard, requests: StopRequests
) -> summary.Cost:
    """Run from the Context's step to the last one of the plan, writing what is due.

    Raises:
        RunError: a file cannot be written.
        Runaway: energy or temperature passed a bound; nothing beyond the bound was written.
        Stopped: a signal arrived. The step has been completed, and all files are written.
    """
    integrator = context.getIntegrator()
    begun = step = context.getStepCount()
    watch, seconds, force_seconds = ForceClock(context), 0.0, 0.0
    evaluations, longest = integrator.forceEvaluations, 1
    progress = ProgressBar(plan.method.name, plan.steps, plan.step_time, begun)
    with _saying_how_to_go_on(context, plan, outputs), progress as show:
        if not outputs.log.count:
            _write(["row", "checkpoint"], context, plan, outputs, guard)
        while step < plan.steps and requests.received is None:
            chunk = min(outputs.next_due(step), plan.steps, step + longest) - step
            start, before = clock(), watch.seconds
            integrator.step(chunk)
            spent = clock() - start
            longest = max(1, min(LONGEST_CHUNK, int(LONGEST_WAIT * chunk / spent)))
            seconds += spent
            force_seconds += watch.seconds - before
            step += chunk
            _write(outputs.due(step), context, plan, outputs, guard)
            show(step)
        if outputs.saved_step != step:
            _write(["checkpoint"], context, plan, outputs, guard)
    if step < plan.steps and requests.received is not None:
        by, where = signal_name(requests.received), _length(plan, step)
        message = f"stopped by {by} at step {where}, all files are written; go on with --restart {outputs.checkpoint}"
        raise Stopped(requests.received, message)
    evaluations = integrator.forceEvaluations - evaluations
    return summary.Cost(step - begun, seconds, force_seconds, evaluations, watch.calls, plan.step_time)


@contextmanager
def _saying_how_to_go_on(context: openmm.Context, plan: Plan, outputs: Outputs) -> Iterator[None]:
    """Add to errors the step, the likely cause and the last checkpoint.

    Raises:
        Runaway, RunError: in place of the errors of a runaway and of the operating system.
    """
    try:
        yield
    except (openmm.OpenMMException, runaway.Runaway) as error:
        if not isinstance(error, runaway.Runaway) and not runaway.is_runaway(error):
            raise
        where, cause = _length(plan, context.getStepCount()), runaway.likely_cause(plan)
        kept = _kept(outputs, "--start begins a new run from it")
        raise runaway.Runaway(f"ran away at step {where}: {first_line(error)}; {cause}. {kept}") from error
    except OSError as error:
        where, kept = _length(plan, context.getStepCount()), _kept(outputs, "--restart goes on from it")
        raise RunError(f"{error.filename}: {error.strerror}, at step {where}. {kept}") from error


def _write(due: list[str], context: openmm.Context, plan: Plan, outputs: Outputs, guard: runaway.Guard) -> None:
    """Check the bounds, then write the files that are due."""
    values = None
    if "row" in due or "checkpoint" in due:
        values = dict(zip(outputs.log.columns, conservation.row(context), strict=True))
        guard.look(values)
    else:
        guard.look_at_temperatures(*context.getIntegrator().computeTemperatures()[1:])
    outputs.write(due, context, values, guard.start)
    if "checkpoint" in due and isinstance(context.getIntegrator(), stock.StockIntegrator):
        stock.go_on_as_a_restart(context, plan.seed)


def _kept(outputs: Outputs, use: str) -> str:
    if outputs.saved_step is None:
        return "There is no checkpoint yet"
    return f"The last good checkpoint is {outputs.checkpoint}, of step {outputs.saved_step}; {use}"
