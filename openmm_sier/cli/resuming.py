"""Resume a run from its checkpoint, without a gap."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import openmm
from openmm import unit

from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.console import note
from openmm_sier.cli.errors import Misused, NothingLeft, RunError
from openmm_sier.cli.files import checkpoints, cuts
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.files.outputs import Outputs
from openmm_sier.cli.planning import continued_settings
from openmm_sier.cli.platforms import keep_platform, tell_of_another_platform
from openmm_sier.cli.running import Run, check_extras, tell_of_settings
from openmm_sier.cli.settings import RunSettings, checkpoint_of, trajectory_of
from openmm_sier.cli.stopping import StopRequests
from openmm_sier.inputs.inputs import fingerprints, sources_of

#: Relative difference allowed between the energy of a checkpoint's positions and the energy noted in it. Platforms
#: differ by single precision.
ENERGY_TOLERANCE = 1e-4


class Complete(NothingLeft):
    """The run to be continued is already complete, and its files are there.

    Attributes:
        settings: of the run.
        unsettled: how a doubtful equilibration ended, in words.
    """

    def __init__(self, message: str, settings: RunSettings, unsettled: str | None):
        super().__init__(message)
        self.settings, self.unsettled = settings, unsettled


def checkpoint_to_resume(given: Mapping[str, Any], locks: FileLocks) -> Path | None:
    """Return the checkpoint from which a run is to go on: the one of `restart`, or with `resume` its own.

    It is locked before anybody looks for it or reads it, so that nobody makes or replaces it from here on. Where the
    file is missing, a run that has just removed it says so by its lock.

    Raises:
        Misused: both are asked for.
        RunError: another command writes there.
    """
    checkpoint: Path | None = given.get("restart")
    if given.get("resume"):
        if checkpoint:
            raise Misused("--resume finds the checkpoint beside --out: leave --restart out")
        out = given.get("out") or ("box" in given and trajectory_of(given["box"]))
        checkpoint = checkpoint_of(out) if out else None
    if checkpoint and checkpoint.parent.is_dir():
        locks.hold([checkpoint])
    return checkpoint if given.get("restart") or (checkpoint and checkpoint.exists()) else None


def resume(given: Mapping[str, Any], checkpoint: Path, locks: FileLocks, requests: StopRequests) -> Run:
    """Return the run of a checkpoint, at the step of that, with its files open and cut back.

    Args:
        given: settings by name.
        checkpoint: which is locked, see `checkpoint_to_resume`.
        locks: that take the locks of its files.
        requests: for signals, which wait from when files are cut.

    Raises:
        Complete: there is nothing left to do.
        RunError: settings contradict the checkpoint, or files are not those of its run or would lose too much.
        ForceFieldError, RecordError, RigidityError, OSError, openmm.OpenMMException: as their messages say.
    """
    notes = checkpoints.read_notes(checkpoint)
    settings = continued_settings(given, checkpoint, notes["plan"])
    settings = keep_platform(settings, checkpoint, notes["platform"])
    outputs = Outputs(settings, checkpoint)
    check_extras(settings, outputs, may_replace=True)
    sources = sources_of(settings.box, settings.topology, settings.forcefield)
    _refuse_other_inputs(sources, checkpoint, notes["inputs"])
    outputs.check(sources.values())
    _check_unfinished(settings, outputs, notes)
    tell_of_settings(settings)
    simulated = Simulated(settings)
    locks.hold(outputs.paths)
    outputs.check_noted(notes)
    found = cuts.find_cuts(settings, notes)
    if not settings.overwrite:
        cuts.refuse_to_lose(found, settings, checkpoint, notes["step"])
    context = _restored(simulated, checkpoint, notes)
    # From here on, the step and all files are completed before a signal ends the run.
    requests.defer()
    run = Run(settings, simulated, context, outputs, notes["unsettled"])
    run.tell()
    tell_of_another_platform(context, checkpoint, notes["platform"])
    if found:
        note(cuts.describe(found, settings, checkpoint, notes["step"]))
    outputs.open(simulated, context, notes["unsettled"], notes)
    return run


def _check_unfinished(settings: RunSettings, outputs: Outputs, notes: Mapping[str, Any]) -> None:
    """Refuse to go on with a run that has nothing left to do."""
    step, checkpoint = notes["step"], outputs.checkpoint
    if step < settings.steps:
        return
    message = (
        f"{checkpoint} is at step {settings.length(step)}, and the run ends at step {settings.steps}; "
        "ask for more with --steps or --time"
    )
    if step > settings.steps:
        raise RunError(message)
    outputs.check_noted(notes)
    raise Complete(message, settings, notes["unsettled"])


def _restored(simulated: Simulated, checkpoint: Path, notes: Mapping[str, Any]) -> openmm.Context:
    """Return a Context in the state of a checkpoint, which must belong to this system."""
    state, _ = checkpoints.read_checkpoint(checkpoint, simulated.box.system.getNumParticles())
    context = simulated.context(notes["step"])
    context.setState(state)
    energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    # An energy that is not a number differs too.
    if not abs(energy - notes["potential_energy"]) <= ENERGY_TOLERANCE * (abs(energy) + 1):
        raise RunError(
            f"the positions of {checkpoint} have the energy {energy:.6g} kJ/mol in the system of "
            f"{simulated.settings.box}, but had {notes['potential_energy']:.6g} in the run: the molecules or the force "
            "field are not those of the run. Give the files of the run"
        )
    return context


def _refuse_other_inputs(sources: Mapping[str, Path], checkpoint: Path, noted: Mapping[str, str]) -> None:
    """Refuse files that are not those of the run, which may hold another system of nearly its energy."""
    inputs = fingerprints(sources)
    for use, path in sources.items():
        if inputs[use] != noted.get(use):
            raise RunError(
                f"{path} is not the file that the run of {checkpoint} read, or was edited. Give the original file, or "
                "begin a new run with --start"
            )
    if missing := [use for use in noted if use not in sources]:
        raise RunError(f"{missing[0]}, which the run of {checkpoint} read, is missing: put it back under this name")
