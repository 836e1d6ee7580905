"""The settings of a run from the options of a user: of a new run, or of the run of a checkpoint."""

import json
import os
import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from openmm_sier.cli.arguments import argument, arguments, flag
from openmm_sier.cli.defaults import steps_in
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.fields import refusal
from openmm_sier.cli.methods import METHODS
from openmm_sier.cli.settings import (
    CONTINUED,
    FILES,
    INPUTS,
    NOTED,
    OF_THE_SYSTEM,
    OUTPUTS,
    RunSettings,
)
from openmm_sier.inputs.forcefields import foreign_files, pick
from openmm_sier.inputs.inputs import IGNORED, topology_kind
from openmm_sier.inputs.pdb_files import ForceFieldError
from openmm_sier.inputs.source_files import SourceFile


def new_settings(options: Mapping[str, Any], origin: RunSettings | None = None) -> RunSettings:
    """Return the settings of a new run.

    Args:
        options: of the user, by name, each within its range.
        origin: settings of the run from whose checkpoint this one starts. They define the System.

    Raises:
        Misused: settings contradict each other or the topology, or have no effect.
        RunError: files that define the System must be named again.
        ForceFieldError, OSError: the topology is not one, or cannot be read.
    """
    values: dict[str, Any] = {}
    if origin is not None:
        values = {name: getattr(origin, name) for name in (*OF_THE_SYSTEM, "temperature")}
    values |= options
    values |= dict.fromkeys(_settings_in_topology(values.get("topology"), options))
    if "scheme" in values:
        # OpenMM's own integrators are not all of constant energy.
        values.setdefault("ensemble", METHODS[values["scheme"]].ensembles[0])
    settings = _checked(values, options)
    if origin is not None:
        _refuse_unnamed(INPUTS, settings, options, options["start"])
    return settings


def _checked(values: Mapping[str, Any], chosen: Collection[str]) -> RunSettings:
    try:
        return RunSettings.model_validate(values, context={"chosen": set(chosen)})
    except ValidationError as error:
        name, reason = refusal(error, RunSettings)
        raise Misused(f"argument {flag(name)}: {reason}" if name else reason) from None


def _settings_in_topology(topology: Path | None, chosen: Collection[str]) -> tuple[str, ...]:
    """Return the names of settings that have no effect with a topology.

    Args:
        topology: its file; None without one.
        chosen: names of settings that the user chose.

    Raises:
        Misused: one of them was chosen.
        ForceFieldError, OSError: the topology is not one, or cannot be read.
    """
    if topology is None:
        return ()
    kind = topology_kind(topology)
    for name in IGNORED[kind]:
        if name in chosen:
            raise Misused(f"{flag(name)} has no effect with {topology}, which is {kind}: leave it out")
    return IGNORED[kind]


# --- from a checkpoint ---


def noted_settings(checkpoint: Path, plan: Mapping[str, object]) -> RunSettings:
    """Return the settings in a checkpoint, with files relative to the current directory.

    Args:
        checkpoint: its path.
        plan: settings in it, as JSON.

    Raises:
        RunError: a setting is unknown, missing or wrong; the message names the checkpoint and the setting.
    """
    if absent := [name for name in NOTED if name not in plan]:
        raise RunError(f"{checkpoint} lacks the setting {absent[0]}: begin a new run")
    if unknown := set(plan) - set(NOTED):
        raise RunError(
            f"{checkpoint} has the setting {min(unknown)}, which this version does not know: continue with the version "
            "that wrote it, or begin a new run"
        )
    try:
        settings = RunSettings.model_validate_json(json.dumps(plan), strict=True, context={"chosen": ()})
    except ValidationError as error:
        name, reason = refusal(error, RunSettings)
        if name:
            raise RunError(f"{checkpoint} has a wrong setting: {name}, {reason}") from None
        raise RunError(f"{checkpoint} has settings that no run has: {reason}") from None
    here = os.path.dirname(checkpoint)
    files = {name: path for name in FILES if (path := getattr(settings, name)) is not None}
    paths = {name: Path(os.path.normpath(os.path.join(here, path))) for name, path in files.items()}
    return settings.model_copy(update=paths)


def continued_settings(options: Mapping[str, Any], checkpoint: Path, plan: Mapping[str, object]) -> RunSettings:
    """Return the settings of a checkpoint, with another length if the user gives one.

    Options must not contradict the checkpoint, and files outside its folder must be named again.

    Args:
        options: of the user, by name.
        checkpoint, plan: see `noted_settings`.

    Raises:
        Misused: options contradict each other.
        RunError: options contradict the checkpoint, or it has no settings.
    """
    noted = noted_settings(checkpoint, plan)
    for name in CONTINUED:
        value, before = options.get(name), getattr(noted, name)
        if value is not None and not _is_same(value, before):
            option = flag(name) + ("" if value is True else f" {_shown(value)}")
            raise RunError(
                f"{option} differs from {_shown(before)} in {checkpoint}; leave it out, or begin a new run with --start"
            )
    changed = {name: value for name, value in options.items() if name not in (*CONTINUED, "start")}
    if "time" in options and "steps" not in options:
        changed["steps"] = steps_in(options["time"], 1000 * noted.step_time)
    values = {name: getattr(noted, name) for name in NOTED}
    settings = _checked({**values, **changed, "restart": checkpoint}, options)
    _refuse_unnamed(FILES, settings, options, checkpoint)
    return settings


def _refuse_unnamed(names: Sequence[str], settings: RunSettings, chosen: Collection[str], checkpoint: Path) -> None:
    """Refuse files outside the folder of a checkpoint that only the checkpoint names.

    Args:
        names: settings of the checkpoint that name a file.
        settings: those of the checkpoint and of the user.
        chosen: names of the settings that the user chose.
        checkpoint: its path; it may be crafted.

    Raises:
        RunError: naming the file, and the argument that names it again.
    """
    for name in names:
        path = getattr(settings, name)
        if path is not None and name not in chosen and not _is_below(path, checkpoint):
            purpose = "write there" if name in OUTPUTS else "read it"
            raise RunError(
                f"{checkpoint} names {path} for {_option(name)}, in a directory other than its own: to {purpose}, give "
                f"{_argument_again(name, path)}"
            )


def refuse_foreign_force_field(
    settings: RunSettings, chosen: Collection[str], checkpoint: Path, box: SourceFile
) -> None:
    """Refuse a force field that only a checkpoint names, if it could execute code or is outside its folder.

    Args:
        settings, chosen, checkpoint: see `_refuse_unnamed`.
        box: coordinates, which may name the force field.

    Raises:
        RunError: naming the file, and the argument that names it again.
        OSError: the coordinates cannot be read.
    """
    if "forcefield" in chosen or (settings.forcefield is None and "box" in chosen):
        return
    setting = "box" if settings.forcefield is None else "forcefield"
    for name, path in foreign_files(_force_field(settings, box), settings.box.parent).items():
        # Parameters of a psf file are numbers, but force fields of OpenMM may have scripts.
        if settings.topology is None or not _is_below(path, checkpoint):
            raise RunError(
                f"{checkpoint} names {name}, a force field that comes neither with OpenMM nor with this package, and "
                f"could execute code: if you trust it, give {_argument_again(setting, getattr(settings, setting))}"
            )


def _force_field(settings: RunSettings, box: SourceFile) -> Sequence[str]:
    """Return the names of the files of a force field: those in the settings, else those in the PDB file."""
    if settings.forcefield is not None:
        return [str(file) for file in settings.forcefield]
    if settings.topology is not None:
        return []
    try:
        return pick(box)[0]
    except ForceFieldError:
        # A file without a force field is refused when it is read.
        return []


def _option(name: str) -> str:
    return "BOX" if name == "box" else flag(name)


def _argument_again(name: str, value: Any) -> str:
    """Return the arguments of a command line that give a setting again."""
    return f"{shlex.quote(argument(value))} as BOX" if name == "box" else shlex.join(arguments(name, value))


def _is_same(value: Any, noted: Any) -> bool:
    if isinstance(value, Path) and noted is not None:
        return os.path.abspath(value) == os.path.abspath(noted)
    return bool(value == noted)


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _is_below(path: Path, checkpoint: Path) -> bool:
    """Return whether a file is in the directory of a checkpoint or below it, all links followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(os.path.dirname(checkpoint) or "."))
