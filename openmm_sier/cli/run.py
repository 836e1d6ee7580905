"""The command `openmm-sier run`: coordinates in, a trajectory out."""

import gc
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from signal import Signals

import openmm

from openmm_sier.analysis import read_log
from openmm_sier.cli import pictures, results, run_checks
from openmm_sier.cli.config import joined, read_config
from openmm_sier.cli.console import clock, note, progress_bar, table
from openmm_sier.cli.errors import Misused, NothingLeft, RunError
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.many import command as many
from openmm_sier.cli.new_run import NewRun
from openmm_sier.cli.restart import Restart, checkpoint_to_continue
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.settling import read_runs, verdict
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.cli.stopping import Stopped, StopRequests
from openmm_sier.inputs.pdb_files import first_line
from openmm_sier.observe import conservation, openmm_integrators
from openmm_sier.system.temperature import degrees_of_freedom

#: Most steps between two checks of temperatures and signals, and most seconds that these steps should take.
LONGEST_CHUNK, LONGEST_WAIT = 20, 0.5


def execute(
    given: RunSettings,
    config: Path | None = None,
    seeds: Sequence[int] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Run `openmm-sier run`.

    Args:
        given: settings that the user chose, and defaults.
        config: a TOML file with more settings.
        seeds, workers, scheduler: of many runs, see `openmm_sier.cli.many.command.execute`; None for one run.

    Raises:
        Misused: there are no coordinates, or settings contradict each other.
        RunError: settings contradict the checkpoint, or a file is in the way or cannot be written.
        NothingLeft: the run that `restart` names is complete.
        Runaway: the energy or the temperature ran away.
        Stopped: a signal ended the run; the message says how to continue.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    if config:
        given = joined(read_config(config), given)
    if seeds:
        many.execute(given, seeds, workers, scheduler)
        return
    if workers or scheduler:
        raise Misused(f"{'--workers' if workers else '--scheduler'} needs --seeds, such as --seeds 1-24")
    with FileLocks() as locks, StopRequests() as requests:
        checkpoint = checkpoint_to_continue(given, locks)
        beginning = Restart(given, checkpoint) if checkpoint else NewRun(given)
        _run(beginning, config, locks, requests)


def _run(beginning: NewRun | Restart, config: Path | None, locks: FileLocks, requests: StopRequests) -> None:
    """Execute a run, from its beginning to the table at its end."""
    settings = beginning.settings
    outputs = Outputs(settings, beginning.checkpoint)
    outputs.check([*beginning.sources.values(), *([config] if config else [])], beginning.continues)
    try:
        beginning.check_inputs(outputs)
    except NothingLeft:
        if not settings.resume:
            raise
        note(f"{beginning.checkpoint} is at step {settings.length(settings.steps)}: the run is complete")
        _report(settings, [], beginning.unsettled)
        return
    with _uncollected():
        simulated = SimulatedSystem(settings, beginning.sources)
        locks.hold(outputs.paths)
        beginning.check_outputs(outputs)
        context = beginning.context(simulated)
    # From here on, the step and all files are completed before a signal ends the run.
    requests.defer()
    platform = context.getPlatform().getName()
    note(f"{settings.title}, to step {settings.length(settings.steps)} on the {platform} platform")
    outputs.open(simulated, context, beginning.unsettled, beginning.notes)
    cost = RunningSimulation(simulated, context, outputs).advance(requests)
    _report(settings, cost, beginning.unsettled)
    note(f"wrote {', '.join(map(str, [*outputs.paths, *([settings.plot] if settings.plot else [])]))}")


@contextmanager
def _uncollected() -> Iterator[None]:
    """Let a block make its objects, millions for a large System that stay, without searches for garbage among them."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _report(settings: RunSettings, cost: list[tuple[str, str]], unsettled: str | None) -> None:
    """Print the table at the end of a run, of the part from which `summary` takes means, and draw its log."""
    log = read_log(settings.report)
    runs = read_runs([settings.report]) if len(log["Step"]) >= results.FEWEST_ROWS else None
    if runs:
        log = runs.first.after(runs.begin)
    quantities = results.quantities(log, settings.ensemble, settings.moves_volume)
    rows = [(quantity.name, str(quantity)) for quantity in quantities]
    rows += [("WARNING: not equilibrated", f"after {unsettled}")] if unsettled else []
    table(f"{settings.title}, {settings.steps * settings.step_time:g} ps", ("", ""), rows + cost)
    if runs and runs.begin:
        note(verdict(runs))
    if settings.plot:
        # A log that is too short is refused there.
        pictures.draw(runs or read_runs([settings.report]), settings.plot)


class RunningSimulation:
    """A run after its beginning: a loop over outputs that are due."""

    def __init__(self, simulated: SimulatedSystem, context: openmm.Context, outputs: Outputs):
        """
        Args:
            simulated: the System, and settings of the run.
            context: at its last completed step.
            outputs: files of the run, which are open.
        """
        self._settings = simulated.settings
        self._context = context
        self._outputs = outputs
        conserved = context.getIntegrator().conservesMomentum
        self._bounds = run_checks.bounds(self._settings, degrees_of_freedom(simulated.bodies, conserved))

    def advance(self, requests: StopRequests) -> list[tuple[str, str]]:
        """Run to the last step, or to a signal, and write what is due; then close all files.

        Returns:
            The rows of `results.cost_rows`.

        Raises:
            Runaway: the energy or the temperature ran away.
            RunError: a file cannot be written.
            Stopped: a signal ended the run. The messages say how to continue.
            openmm.OpenMMException: as its message says.
        """
        integrator, settings, outputs = self._context.getIntegrator(), self._settings, self._outputs
        begun = step = self._context.getStepCount()
        evaluations, seconds, longest = integrator.forceEvaluations, 0.0, 1
        progress = progress_bar(settings.method.name, settings.steps, settings.step_time, begun)
        with self._explained_errors(), progress as show:
            if outputs.saved_step is None:
                self._write(["log", "checkpoint"])
            while step < settings.steps and requests.received is None:
                chunk = min(outputs.next_due(step), settings.steps, step + longest) - step
                start = clock()
                integrator.step(chunk)
                elapsed = clock() - start
                longest = max(1, min(LONGEST_CHUNK, int(LONGEST_WAIT * chunk / elapsed)))
                seconds += elapsed
                step += chunk
                self._write(outputs.due(step))
                show(step)
            if outputs.saved_step != step:
                self._write(["checkpoint"])
        if step < settings.steps and requests.received is not None:
            by, where = Signals(requests.received).name, settings.length(step)
            way = f"all files are written; continue with --restart {outputs.checkpoint}"
            raise Stopped(requests.received, f"stopped by {by} at step {where}, {way}")
        outputs.close()
        evaluations = integrator.forceEvaluations - evaluations
        return results.cost_rows(step - begun, settings.step_time, seconds, evaluations)

    def _write(self, due: Collection[str]) -> None:
        """Check the bounds, then write the files that are due."""
        context = self._context
        run_checks.check(context, self._bounds)
        values = {}
        if "log" in due or "checkpoint" in due:
            values = dict(zip(conservation.columns(context.getIntegrator()), conservation.row(context), strict=True))
        self._outputs.write(due, context, values)
        if "checkpoint" in due and isinstance(context.getIntegrator(), openmm_integrators.OpenMMIntegrator):
            openmm_integrators.continue_as_restart(context, self._settings.seed)

    @contextmanager
    def _explained_errors(self) -> Iterator[None]:
        """Add to errors the step, the likely cause and the last checkpoint."""
        try:
            yield
        except openmm.OpenMMException as error:
            if not run_checks.is_runaway(error):
                raise
            cause, saved = run_checks.likely_cause(self._settings), self._saved("--start begins a new run from it")
            message = f"the run became unstable at step {self._where()}: {first_line(error)}; {cause}. {saved}"
            raise run_checks.Runaway(message) from error
        except OSError as error:
            saved = self._saved("--restart continues from it")
            raise RunError(f"{error.filename}: {error.strerror}, at step {self._where()}. {saved}") from error

    def _where(self) -> str:
        return self._settings.length(self._context.getStepCount())

    def _saved(self, use: str) -> str:
        outputs = self._outputs
        if outputs.saved_step is None:
            return "There is no checkpoint yet"
        return f"The last checkpoint is {outputs.checkpoint}, of step {outputs.saved_step}; {use}"
