"""The command `openmm-sier run`: coordinates in, a trajectory out."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from signal import Signals
from typing import Any

import openmm
from openmm import unit

from openmm_sier.analysis import read_log
from openmm_sier.cli import many, results, run_checks
from openmm_sier.cli.beginning import Simulated, read_start
from openmm_sier.cli.console import clock, note, progress_bar, table
from openmm_sier.cli.files import checkpoints, cuts
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.logged_runs import FEWEST_ROWS, read_runs
from openmm_sier.cli.methods import is_heavy
from openmm_sier.cli.pictures import canvas, drawing
from openmm_sier.cli.plan import (
    NothingLeft,
    Options,
    Plan,
    RunError,
    checkpoint_of,
    continued_plan,
    new_plan,
    trajectory_of,
)
from openmm_sier.cli.platforms import keep_platform, tell_of_another_platform
from openmm_sier.cli.stopping import Stopped, StopRequests
from openmm_sier.inputs.pdb_files import first_line
from openmm_sier.observe import conservation, stock
from openmm_sier.system.temperature import degrees_of_freedom

#: Most steps between two checks of temperatures and signals, and most seconds that these steps should take.
LONGEST_CHUNK, LONGEST_WAIT = 20, 0.5

#: K, below which liquids are not simulated and somebody may have meant degrees Celsius.
COLD = 100.0

#: Relative difference allowed between the energy of a checkpoint's positions and the energy noted in it. Platforms
#: differ by single precision.
ENERGY_TOLERANCE = 1e-4


def execute(
    seeds: Sequence[int] | None = None, workers: int | None = None, scheduler: str | None = None, **given: Any
) -> None:
    """Run `openmm-sier run`.

    Args:
        seeds, workers, scheduler: of many runs, see `openmm_sier.cli.many.execute`; None for one run.
        given: options by name, as for `Options`.

    Raises:
        RunError: options contradict each other or the checkpoint, or a file is in the way or cannot be written.
        Runaway: the energy or the temperature ran away.
        Stopped: a signal ended the run; the message says how to go on.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    if seeds:
        many.execute({name: value for name, value in given.items() if value is not None}, seeds, workers, scheduler)
        return
    if workers or scheduler:
        raise RunError(f"{'--workers' if workers else '--scheduler'} needs --seeds, such as --seeds 1-24")
    options = Options(**given)
    with FileLocks() as locks, StopRequests() as requests:
        _begin_or_continue(options, requests, locks)


def _begin_or_continue(options: Options, requests: StopRequests, locks: FileLocks) -> None:
    if options.resume:
        options = _resumed(options, locks)
    if options.restart:
        if options.restart.parent.is_dir():
            # Before it is read, so that nobody replaces it from here on. Where the file is missing, a run that has just
            # removed it says so by its lock.
            locks.hold([options.restart])
        state, notes = checkpoints.read_checkpoint(options.restart)
        plan, checkpoint = continued_plan(options, options.restart, notes["plan"]), options.restart
        options = replace(keep_platform(options, checkpoint, notes["platform"]), box=plan.box)
    else:
        notes, (state, origin) = None, read_start(options.start)
        plan = new_plan(options, origin)
        checkpoint = checkpoint_of(plan.out)
    outputs = Outputs(plan, checkpoint)
    if options.plot:
        _check_picture(options.plot, options, outputs, may_replace=bool(notes or options.overwrite))
        _check_rows(plan)
    if notes and options.resume and notes["step"] == plan.steps:
        outputs.check_noted(notes)
        note(f"{checkpoint} is at step {_length(plan, plan.steps)}: the run is complete")
        _report(plan, [], notes.get("unsettled"), options.plot)
        return
    if 0 < plan.temperature < COLD:
        note(f"{plan.temperature:g} K is very cold; a temperature is in kelvin, not in degrees Celsius")
    if plan.ensemble == "nve" and is_heavy(plan.hydrogen_mass):
        note(f"hydrogens of {plan.hydrogen_mass:g} dalton slow motion; at constant energy leave their mass as it is")
    simulated = Simulated(options, plan)
    outputs.check([*simulated.box.sources.values(), *([options.start] if options.start else [])])
    locks.hold(outputs.paths)
    if not (notes or options.overwrite):
        outputs.refuse_existing(bool(options.resume))
    if notes:
        found = _cuts(plan, outputs, notes, may_lose=bool(options.overwrite))
        simulated.unsettled = notes["unsettled"]
    context = _restored(simulated, state, notes) if notes else simulated.begin(state, origin)
    # From here on, the step and all files are completed before a signal ends the run.
    requests.defer()
    if not notes:
        outputs.remove()
    note(f"{plan.title}, to step {_length(plan, plan.steps)} on the {context.getPlatform().getName()} platform")
    if notes:
        tell_of_another_platform(context, checkpoint, notes["platform"])
        if found:
            note(cuts.describe(found, plan, checkpoint, notes["step"]))
    outputs.open(simulated, context, notes)
    bounds = run_checks.bounds(plan, degrees_of_freedom(simulated.bodies, context.getIntegrator().conservesMomentum))
    cost = _advance(context, plan, outputs, bounds, requests)
    outputs.close()
    _report(plan, cost, simulated.unsettled, options.plot)
    note(f"wrote {outputs}" + (f", {options.plot}" if options.plot else ""))


def _resumed(options: Options, locks: FileLocks) -> Options:
    """Return the options of a run that goes on where it has a checkpoint, and begins where it has none."""
    if options.restart:
        raise RunError("--resume finds the checkpoint beside --out: leave --restart out")
    checkpoint = checkpoint_of(trajectory_of(options))
    if checkpoint.parent.is_dir():
        # Before anybody looks for it: a run that begins at the same time would make one.
        locks.hold([checkpoint])
    if not checkpoint.exists():
        return options
    return replace(options, restart=checkpoint, start=None)


def _check_picture(path: Path, options: Options, outputs: Outputs, may_replace: bool) -> None:
    """Refuse a picture that would destroy another file, or cannot be drawn."""
    inputs = [each for each in (options.box, options.topology, options.start) if each]
    canvas.check(path, [*inputs, *outputs.paths], may_replace)


def _check_rows(plan: Plan) -> None:
    """Refuse a picture of a log that will be too short for one."""
    rows = plan.steps // plan.interval(plan.report_every) + 1
    if rows < FEWEST_ROWS:
        raise RunError(f"--plot needs a log of {FEWEST_ROWS} rows or more, it would have {rows}: lower --report-every")


def _length(plan: Plan, steps: int) -> str:
    return f"{steps} ({steps * plan.step_time:g} ps)"


def _report(plan: Plan, cost: list[tuple[str, str]], unsettled: str | None, picture: Path | None) -> None:
    """Print the table at the end of a run, and draw its log."""
    log = read_log(plan.report)
    warning = run_checks.fluctuation_warning(plan, log)
    rows = results.rows(log, plan.ensemble, plan.moves_volume)
    rows += [("WARNING: rms(H)/rms(V)", warning)] if warning else []
    rows += [("WARNING: not equilibrated", f"after {unsettled}")] if unsettled else []
    table(f"{plan.title}, {plan.steps * plan.step_time:g} ps", ("", ""), rows + cost)
    if picture:
        drawing.draw(read_runs([plan.report]), picture)


# --- the continuation ---


def _cuts(plan: Plan, outputs: Outputs, notes: dict[str, Any], may_lose: bool) -> list[cuts.Cut]:
    """Return what is cut from the files of a run that goes on, after all reasons to refuse that."""
    checkpoint, step = outputs.checkpoint, notes["step"]
    outputs.check_noted(notes)
    _check_unfinished(plan, checkpoint, step)
    found = cuts.find_cuts(plan, notes)
    if not may_lose:
        cuts.refuse_to_lose(found, plan, checkpoint, step)
    return found


def _check_unfinished(plan: Plan, checkpoint: Path, step: int) -> None:
    """Refuse to go on with a run that has nothing left to do."""
    if step >= plan.steps:
        raise (NothingLeft if step == plan.steps else RunError)(
            f"{checkpoint} is at step {_length(plan, step)}, the run is to end at step {plan.steps}; "
            "ask for more with --steps or --time"
        )


def _restored(simulated: Simulated, state: openmm.State, notes: dict[str, Any]) -> openmm.Context:
    """A Context in the state of a checkpoint, which must belong to this system."""
    box, checkpoint = simulated.options.box, simulated.options.restart
    _refuse_other_inputs(simulated, notes["inputs"])
    context = simulated.context(notes["step"])
    context.setState(state)
    energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    if abs(energy - notes["potential_energy"]) > ENERGY_TOLERANCE * (abs(energy) + 1):
        raise RunError(
            f"the positions of {checkpoint} have the energy {energy:.6g} kJ/mol in the system of {box}, "
            f"in the run they had {notes['potential_energy']:.6g}: it is another system or force field"
        )
    return context


def _refuse_other_inputs(simulated: Simulated, noted: Mapping[str, str]) -> None:
    """Refuse to go on with files that are not those of the run, which may hold another system of nearly its energy."""
    for use, path in simulated.box.sources.items():
        if simulated.inputs[use] != noted.get(use):
            raise RunError(
                f"{path} is not the file that the run of {simulated.options.restart} read, or was edited. Give that, "
                "or begin a new run with --start"
            )


# --- the run ---


def _advance(
    context: openmm.Context, plan: Plan, outputs: Outputs, bounds: run_checks.Bounds, requests: StopRequests
) -> list[tuple[str, str]]:
    """Run from the Context's step to the last one of the plan, or to a signal, writing what is due.

    Returns:
        The rows of `results.cost_rows`.
    """
    integrator = context.getIntegrator()
    begun = step = context.getStepCount()
    evaluations, seconds, longest = integrator.forceEvaluations, 0.0, 1
    progress = progress_bar(plan.method.name, plan.steps, plan.step_time, begun)
    with _saying_how_to_go_on(context, plan, outputs), progress as show:
        if outputs.saved_step is None:
            _write(["log", "checkpoint"], context, plan, outputs, bounds)
        while step < plan.steps and requests.received is None:
            chunk = min(outputs.next_due(step), plan.steps, step + longest) - step
            start = clock()
            integrator.step(chunk)
            spent = clock() - start
            longest = max(1, min(LONGEST_CHUNK, int(LONGEST_WAIT * chunk / spent)))
            seconds += spent
            step += chunk
            _write(outputs.due(step), context, plan, outputs, bounds)
            show(step)
        if outputs.saved_step != step:
            _write(["checkpoint"], context, plan, outputs, bounds)
    if step < plan.steps and requests.received is not None:
        by, where = Signals(requests.received).name, _length(plan, step)
        message = f"stopped by {by} at step {where}, all files are written; go on with --restart {outputs.checkpoint}"
        raise Stopped(requests.received, message)
    evaluations = integrator.forceEvaluations - evaluations
    return results.cost_rows(step - begun, plan.step_time, seconds, evaluations)


@contextmanager
def _saying_how_to_go_on(context: openmm.Context, plan: Plan, outputs: Outputs) -> Iterator[None]:
    """Add to errors the step, the likely cause and the last checkpoint."""
    try:
        yield
    except openmm.OpenMMException as error:
        if not run_checks.is_runaway(error):
            raise
        where, cause = _length(plan, context.getStepCount()), run_checks.likely_cause(plan)
        kept = _kept(outputs, "--start begins a new run from it")
        raise run_checks.Runaway(f"ran away at step {where}: {first_line(error)}; {cause}. {kept}") from error
    except OSError as error:
        where, kept = _length(plan, context.getStepCount()), _kept(outputs, "--restart goes on from it")
        raise RunError(f"{error.filename}: {error.strerror}, at step {where}. {kept}") from error


def _write(due: list[str], context: openmm.Context, plan: Plan, outputs: Outputs, bounds: run_checks.Bounds) -> None:
    """Check the bounds, then write the files that are due."""
    run_checks.check(context, bounds)
    values = {}
    if "log" in due or "checkpoint" in due:
        values = dict(zip(conservation.columns(context.getIntegrator()), conservation.row(context), strict=True))
    outputs.write(due, context, values)
    if "checkpoint" in due and isinstance(context.getIntegrator(), stock.StockIntegrator):
        stock.go_on_as_a_restart(context, plan.seed)


def _kept(outputs: Outputs, use: str) -> str:
    if outputs.saved_step is None:
        return "There is no checkpoint yet"
    return f"The last checkpoint is {outputs.checkpoint}, of step {outputs.saved_step}; {use}"
