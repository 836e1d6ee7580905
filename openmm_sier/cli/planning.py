"""Complete what a user gave to the settings of a run: of a new one, or of one that a checkpoint holds."""

import json
import os
import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from openmm_sier.analysis.many_runs import argument, arguments
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.fields import refusal
from openmm_sier.cli.files.trajectories import FORMATS
from openmm_sier.cli.methods import METHODS
from openmm_sier.cli.settings import (
    CONTINUED,
    FILES,
    INPUTS,
    LATER,
    LENGTHS,
    NOTED,
    OF_THE_SYSTEM,
    OUTPUTS,
    SETTINGS,
    RunSettings,
    flag,
    steps_in,
)
from openmm_sier.inputs.forcefields import foreign_files, pick
from openmm_sier.inputs.inputs import IGNORED, topology_kind
from openmm_sier.inputs.pdb_files import ForceFieldError


def new_settings(given: Mapping[str, Any], origin: RunSettings | None = None) -> RunSettings:
    """Return the settings of a new run.

    Args:
        given: those that a user gave, by name.
        origin: those of the run from whose checkpoint this one starts. They define the System.

    Raises:
        Misused: settings contradict each other, or the topology, or would do nothing.
        RunError: files that make the System must be named again.
        ForceFieldError, OSError: the topology is none, or cannot be read.
    """
    _refuse_both_lengths(given)
    values: dict[str, Any] = {}
    if origin is not None:
        values = {name: getattr(origin, name) for name in (*OF_THE_SYSTEM, "temperature")}
    values |= given
    values |= dict.fromkeys(ignored_settings(values.get("topology"), given))
    if "scheme" in values:
        # OpenMM's own integrators are not all of constant energy.
        values.setdefault("ensemble", METHODS[values["scheme"]].ensembles[0])
    settings = RunSettings(**values)
    if origin is not None:
        _refuse_unnamed(INPUTS, settings, given, given["start"])
    _check(settings)
    for name in useless_settings(settings):
        if name in given:
            raise Misused(f"{flag(name)} needs {_NEEDED[name]}")
    return settings


#: What settings need that do nothing without it.
_NEEDED = {
    "thermostat": "--ensemble nvt or npt, and a scheme of this package",
    "friction": "--ensemble nvt, npt or hmc",
    "pressure": "--ensemble npt or hmc",
    "steps_per_trial": "--ensemble hmc",
    "pressure_tensor_every": "--pressure-tensor FILE.csv",
}


def useless_settings(settings: RunSettings) -> list[str]:
    """Return the names of settings that do nothing beside the others."""
    does_something = {
        "thermostat": settings.ensemble in ("nvt", "npt") and settings.method.scheme is not None,
        "friction": settings.ensemble != "nve",
        "pressure": settings.ensemble in ("npt", "hmc"),
        "steps_per_trial": settings.ensemble == "hmc",
        "pressure_tensor_every": settings.pressure_tensor is not None,
    }
    return [name for name, does in does_something.items() if not does]


def ignored_settings(topology: Path | None, given: Collection[str]) -> tuple[str, ...]:
    """Return the names of settings that would do nothing with a topology.

    Args:
        topology: its file; None without one.
        given: names of settings that the user gave.

    Raises:
        Misused: one of them was given.
        ForceFieldError, OSError: the topology is none, or cannot be read.
    """
    if topology is None:
        return ()
    kind = topology_kind(topology)
    for name in IGNORED[kind]:
        if name in given:
            raise Misused(f"{flag(name)} has no effect with {topology}, which is {kind}: leave it out")
    return IGNORED[kind]


def _refuse_both_lengths(given: Mapping[str, Any]) -> None:
    if all(name in given for name in LENGTHS):
        raise Misused(f"{' and '.join(map(flag, LENGTHS))} both say how long the run is: give one of them")


def _check(settings: RunSettings) -> None:
    """Refuse what no run can have."""
    if settings.ensemble not in settings.method.ensembles:
        possible = ", ".join(settings.method.ensembles)
        raise Misused(f"{settings.method.name} supports the ensembles {possible}, got {settings.ensemble}")
    if settings.cutoff and settings.switch and settings.switch >= settings.cutoff:
        raise Misused(f"--switch {settings.switch:g} must be below --cutoff {settings.cutoff:g}")
    if settings.rigid and settings.method.scheme is None:
        raise Misused(
            f"--rigid {' '.join(settings.rigid)} needs a scheme of this package: {settings.method.name} keeps "
            "molecules rigid only by constraints"
        )
    if settings.out.suffix.lower() not in FORMATS:
        raise Misused(f"the name of a trajectory must end in {' or '.join(FORMATS)}, got {settings.out}")
    for table in (settings.report, settings.pressure_tensor):
        if table is not None and table.suffix.lower() in FORMATS:
            raise Misused(f"{table} will be a table: give a name that ends in .csv")


# --- from a checkpoint ---


def noted_settings(checkpoint: Path, saved: Mapping[str, object]) -> RunSettings:
    """Return the settings that a checkpoint holds, with files relative to the current directory.

    Raises:
        RunError: a setting is unknown, missing or wrong; the message names the checkpoint and the setting.
    """
    if absent := [name for name in NOTED if name not in (*saved, *LATER)]:
        raise RunError(f"{checkpoint} lacks the setting {absent[0]}: begin a new run")
    if unknown := set(saved) - set(NOTED):
        raise RunError(
            f"{checkpoint} has the setting {min(unknown)}, which this version does not know: continue with the version "
            "that wrote it, or begin a new run"
        )
    try:
        settings = RunSettings.model_validate_json(json.dumps(saved), strict=True)
    except ValidationError as error:
        raise RunError(f"{checkpoint} has a wrong setting: {': '.join(refusal(error, RunSettings))}") from None
    try:
        _check(settings)
    except Misused as error:
        raise RunError(f"{checkpoint} has settings that no run has: {error}") from None
    here = os.path.dirname(checkpoint)
    files = {name: path for name in FILES if (path := getattr(settings, name)) is not None}
    beside = {name: Path(os.path.normpath(os.path.join(here, path))) for name, path in files.items()}
    return settings.model_copy(update=beside)


def continued_settings(given: Mapping[str, Any], checkpoint: Path, saved: Mapping[str, object]) -> RunSettings:
    """Return the settings of a checkpoint, with another length if one is given.

    Those given must not contradict the checkpoint, and files that do not lie beside it must be named again.

    Raises:
        Misused: settings contradict each other.
        RunError: they contradict the checkpoint, or it holds no settings.
        OSError, ValueError: a file of bodies cannot be read, or describes none.
    """
    _refuse_both_lengths(given)
    noted = noted_settings(checkpoint, saved)
    if "start" in given and not given.get("resume"):
        raise Misused("--start begins a new run, and --restart continues an old one: give one of them")
    for name in CONTINUED:
        value, before = given.get(name), getattr(noted, name)
        if value is not None and not _same(value, before):
            option = flag(name) + ("" if value is True else f" {_shown(value)}")
            raise RunError(
                f"{option} differs from {_shown(before)} in {checkpoint}; leave it out, or begin a new run with --start"
            )
    changed = {name: value for name, value in given.items() if SETTINGS[name]["restart"] != "keeps" and name != "start"}
    if "time" in given:
        changed["steps"] = steps_in(given["time"], 1000 * noted.step_time)
    settings = noted.model_copy(update={**changed, "restart": checkpoint})
    _refuse_unnamed(FILES, settings, given, checkpoint)
    return settings


def _refuse_unnamed(names: Sequence[str], settings: RunSettings, given: Collection[str], checkpoint: Path) -> None:
    """Refuse files that only a checkpoint names, if they are not beside it or could execute code.

    Args:
        names: of the settings that the checkpoint gives and that name a file.
        settings: those of the checkpoint and of the user.
        given: names of the settings that the user gave.
        checkpoint: which may be from anybody.

    Raises:
        RunError: naming the file, and the argument that names it again.
    """
    for name in names:
        path = getattr(settings, name)
        if path is not None and name not in given and not _is_below(path, checkpoint):
            purpose = "write there" if name in OUTPUTS else "read it"
            raise RunError(
                f"{checkpoint} names {path} for {_option(name)}, in a directory other than its own: to {purpose}, give "
                f"{_again(name, path)}"
            )
    if "forcefield" in given or (settings.forcefield is None and "box" in given):
        return
    for name, path in foreign_files(_force_field(settings), settings.box.parent).items():
        # Parameters of a psf file are numbers, but force fields of OpenMM may have scripts.
        if settings.topology is None:
            reason = "which could execute code: if you trust it"
        elif not _is_below(path, checkpoint):
            reason = "in a directory other than its own: to read it"
        else:
            continue
        if settings.forcefield is None:
            raise RunError(
                f"{settings.box}, which {checkpoint} names, names the force field {name}, {reason}, give "
                f"{_again('box', settings.box)}"
            )
        raise RunError(
            f"{checkpoint} names {name} for --forcefield, {reason}, give {_again('forcefield', settings.forcefield)}"
        )


def _force_field(settings: RunSettings) -> Sequence[str]:
    """Return the names of the files of a force field: those in the settings, else those in the PDB file."""
    if settings.forcefield is not None:
        return [str(file) for file in settings.forcefield]
    if settings.topology is not None:
        return []
    try:
        return pick(settings.box)[0]
    except ForceFieldError:
        # It names none, which is refused when the file is read.
        return []


def _option(name: str) -> str:
    return "BOX" if name == "box" else flag(name)


def _again(name: str, value: Any) -> str:
    """Return the arguments of a command line that give a setting again."""
    return f"{shlex.quote(argument(value))} as BOX" if name == "box" else shlex.join(arguments(name, value))


def _same(given: Any, noted: Any) -> bool:
    if isinstance(given, Path) and noted is not None:
        return os.path.abspath(given) == os.path.abspath(noted)
    return bool(given == noted)


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _is_below(path: Path, checkpoint: Path) -> bool:
    """Return whether a file is in the directory of a checkpoint or below it, all links followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(os.path.dirname(checkpoint) or "."))
