"""A run: a loop over outputs that are due."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from signal import Signals

import openmm

from openmm_sier.cli import config, results, run_checks
from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.console import clock, note, progress_bar
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.files.outputs import Outputs, check_place, refuse_to_replace
from openmm_sier.cli.logged_runs import FEWEST_ROWS
from openmm_sier.cli.methods import is_heavy
from openmm_sier.cli.pictures import canvas
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.stopping import Stopped, StopRequests
from openmm_sier.inputs.pdb_files import first_line
from openmm_sier.observe import conservation
from openmm_sier.observe.openmm_integrators import OpenMMIntegrator, continue_as_restart
from openmm_sier.system.temperature import degrees_of_freedom

#: Most steps between two checks of temperatures and signals, and most seconds that these steps should take.
LONGEST_CHUNK, LONGEST_WAIT = 20, 0.5

#: K, below which liquids are not simulated and somebody may have meant degrees Celsius.
COLD = 100.0


def check_extras(settings: RunSettings, outputs: Outputs, may_replace: bool) -> None:
    """Refuse a picture that cannot be drawn, and a picture or settings that would replace another file.

    Args:
        settings: of the run.
        outputs: of the run.
        may_replace: whether a picture and settings of an earlier run are replaced.

    Raises:
        Misused: the name of a picture has a wrong ending, or its log would be too short.
        RunError: naming the file that is in the way.
        ModuleNotFoundError: there is no matplotlib.
    """
    inputs = [path for path in (settings.box, settings.topology, settings.start) if path]
    if settings.plot:
        canvas.check(settings.plot, inputs, may_replace, outputs.paths)
        rows = settings.steps // settings.interval(settings.report_every) + 1
        if rows < FEWEST_ROWS:
            needs = f"--plot needs a log of {FEWEST_ROWS} rows or more"
            raise Misused(f"{needs}, and this one would have {rows}: lower --report-every")
    if settings.save_config:
        written = [*outputs.paths, *([settings.plot] if settings.plot else [])]
        check_place(settings.save_config, inputs, written)
        refuse_to_replace(settings.save_config, "--save-config", config.MARK if may_replace else b"")


def tell_of_settings(settings: RunSettings) -> None:
    """Say which settings are seldom meant."""
    if 0 < settings.temperature < COLD:
        note(f"{settings.temperature:g} K is very cold; a temperature is in kelvin, not in degrees Celsius")
    if settings.ensemble == "nve" and is_heavy(settings.hydrogen_mass):
        note(
            f"hydrogens of {settings.hydrogen_mass:g} dalton make motion slower: at constant energy keep their usual "
            "mass"
        )


@dataclass
class Run:
    """A run that has begun or was resumed.

    Attributes:
        settings: all of them.
        simulated: its System.
        context: at its last completed step.
        outputs: its files, which are open.
        unsettled: how a doubtful equilibration ended, in words; None without one.
    """

    settings: RunSettings
    simulated: Simulated
    context: openmm.Context
    outputs: Outputs
    unsettled: str | None

    def __post_init__(self) -> None:
        conserved = self.context.getIntegrator().conservesMomentum
        self._bounds = run_checks.bounds(self.settings, degrees_of_freedom(self.simulated.bodies, conserved))

    def tell(self) -> None:
        """Say what is run, how long and where."""
        settings, platform = self.settings, self.context.getPlatform().getName()
        note(f"{settings.title}, to step {settings.length(settings.steps)} on the {platform} platform")

    def advance(self, requests: StopRequests) -> list[tuple[str, str]]:
        """Run to the last step, or to a signal, and write what is due; then close all files.

        Returns:
            The rows of `results.cost_rows`.

        Raises:
            Runaway: the energy or the temperature ran away.
            RunError: a file cannot be written.
            Stopped: a signal ended the run. Both say how to go on.
            openmm.OpenMMException: as its message says.
        """
        integrator, settings, outputs = self.context.getIntegrator(), self.settings, self.outputs
        begun = step = self.context.getStepCount()
        evaluations, seconds, longest = integrator.forceEvaluations, 0.0, 1
        progress = progress_bar(settings.method.name, settings.steps, settings.step_time, begun)
        with self._saying_how_to_go_on(), progress as show:
            if outputs.saved_step is None:
                self._write(["log", "checkpoint"])
            while step < settings.steps and requests.received is None:
                chunk = min(outputs.next_due(step), settings.steps, step + longest) - step
                start = clock()
                integrator.step(chunk)
                spent = clock() - start
                longest = max(1, min(LONGEST_CHUNK, int(LONGEST_WAIT * chunk / spent)))
                seconds += spent
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
        context = self.context
        run_checks.check(context, self._bounds)
        values = {}
        if "log" in due or "checkpoint" in due:
            values = dict(zip(conservation.columns(context.getIntegrator()), conservation.row(context), strict=True))
        self.outputs.write(due, context, values)
        if "checkpoint" in due and isinstance(context.getIntegrator(), OpenMMIntegrator):
            continue_as_restart(context, self.settings.seed)

    @contextmanager
    def _saying_how_to_go_on(self) -> Iterator[None]:
        """Add to errors the step, the likely cause and the last checkpoint."""
        try:
            yield
        except openmm.OpenMMException as error:
            if not run_checks.is_runaway(error):
                raise
            cause, kept = run_checks.likely_cause(self.settings), self._kept("--start begins a new run from it")
            message = f"the run became unstable at step {self._where()}: {first_line(error)}; {cause}. {kept}"
            raise run_checks.Runaway(message) from error
        except OSError as error:
            kept = self._kept("--restart continues from it")
            raise RunError(f"{error.filename}: {error.strerror}, at step {self._where()}. {kept}") from error

    def _where(self) -> str:
        return self.settings.length(self.context.getStepCount())

    def _kept(self, use: str) -> str:
        outputs = self.outputs
        if outputs.saved_step is None:
            return "There is no checkpoint yet"
        return f"The last checkpoint is {outputs.checkpoint}, of step {outputs.saved_step}; {use}"
