"""The settings of a run from the options of a user: of a new run, or of the run of a checkpoint."""

import json
import os
import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from openmm_sier.cli.arguments import argument, arguments, flag
from openmm_sier.cli.contradictions import contradiction
from openmm_sier.cli.defaults import steps_in
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.fields import refusal
from openmm_sier.cli.methods import METHODS
from openmm_sier.cli.settings import CONTINUED, FILES, NOTED, OF_THE_SYSTEM, InputSettings, RunSettings
from openmm_sier.inputs.forcefields import foreign_files, pick
from openmm_sier.inputs.inputs import IGNORED, topology_kind
from openmm_sier.inputs.pdb_files import ForceFieldError
from openmm_sier.inputs.source_files import SourceFile


def new_settings(given: InputSettings, origin: RunSettings | None = None) -> RunSettings:
    """Return the settings of a new run.

    Args:
        given: settings that the user chose, and defaults.
        origin: settings of the run from whose checkpoint this one starts. They define the System.

    Raises:
        Misused: there are no coordinates, or settings contradict each other or the topology, or have no effect.
        ForceFieldError, OSError: the topology is not one, or cannot be read.
    """
    chosen = given.chosen
    if "box" not in chosen:
        raise Misused("expected BOX, a file of coordinates, or for `run` a checkpoint by --restart (see --help)")
    values: dict[str, Any] = {}
    if origin is not None:
        values = {name: getattr(origin, name) for name in (*OF_THE_SYSTEM, "temperature")}
    values |= chosen
    values |= dict.fromkeys(_settings_in_topology(values.get("topology"), chosen))
    if "scheme" in values:
        # OpenMM's own integrators are not all of constant energy.
        values.setdefault("ensemble", METHODS[values["scheme"]].ensembles[0])
    return _with_defaults(values, chosen)


def _with_defaults(values: Mapping[str, Any], chosen: Collection[str]) -> RunSettings:
    """Return settings with these values, each within its range, and defaults that follow from them."""
    settings = RunSettings.model_construct(**values)
    if reason := contradiction(settings, chosen):
        raise Misused(reason)
    return settings


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
        settings = RunSettings.model_validate_json(json.dumps(plan), strict=True)
    except ValidationError as error:
        name, reason = refusal(error, RunSettings)
        raise RunError(f"{checkpoint} has a wrong setting: {name}, {reason}") from None
    here = os.path.dirname(checkpoint)
    files = {name: path for name in FILES if (path := getattr(settings, name)) is not None}
    paths = {name: Path(os.path.normpath(os.path.join(here, path))) for name, path in files.items()}
    return settings.model_copy(update=paths)


def continued_settings(given: RunSettings, checkpoint: Path, plan: Mapping[str, object]) -> RunSettings:
    """Return the settings of a checkpoint, with another length if the user gives one.

    Args:
        given: settings that the user chose, and defaults.
        checkpoint, plan: see `noted_settings`.

    Raises:
        Misused: settings contradict each other.
        RunError: settings contradict the checkpoint, or it has none.
    """
    chosen = given.chosen
    noted = noted_settings(checkpoint, plan)
    for name in CONTINUED:
        value, before = chosen.get(name), getattr(noted, name)
        if value is not None and not _is_same(value, before):
            option = flag(name) + ("" if value is True else f" {_shown(value)}")
            raise RunError(
                f"{option} differs from {_shown(before)} in {checkpoint}; leave it out, or begin a new run with --start"
            )
    changed = {name: value for name, value in chosen.items() if name not in (*CONTINUED, "start")}
    if given.time is not None and "steps" not in chosen:
        changed["steps"] = steps_in(given.time, 1000 * noted.step_time)
    values = {name: getattr(noted, name) for name in NOTED}
    return _with_defaults({**values, **changed, "restart": checkpoint}, chosen)


def refuse_foreign_force_field(
    settings: RunSettings, chosen: Collection[str], checkpoint: Path, box: SourceFile
) -> None:
    """Refuse a force field that only a checkpoint names, and that could execute code.

    Args:
        settings: those of the checkpoint and of the user.
        chosen: names of the settings that the user chose.
        checkpoint: its path.
        box: coordinates, which may name the force field.

    Raises:
        RunError: naming the file, and the argument that names it again.
        OSError: the coordinates cannot be read.
    """
    setting = "box" if settings.forcefield is None else "forcefield"
    # Parameters of a psf file are numbers, but force fields of OpenMM may have scripts.
    if settings.topology is not None or {"forcefield", setting} & set(chosen):
        return
    if foreign := foreign_files(_force_field(settings, box), settings.box.parent):
        raise RunError(
            f"{checkpoint} names {foreign[0]}, a force field that comes neither with OpenMM nor with this package, and "
            f"could execute code: if you trust it, give {_argument_again(setting, getattr(settings, setting))}"
        )


def _force_field(settings: RunSettings, box: SourceFile) -> Sequence[str]:
    """Return the names of the files of a force field: those in the settings, else those in the PDB file."""
    if settings.forcefield is not None:
        return [str(file) for file in settings.forcefield]
    try:
        return pick(box)[0]
    except ForceFieldError:
        # A file without a force field is refused when it is read.
        return []


def _argument_again(name: str, value: Any) -> str:
    """Return the arguments of a command line that give a setting again."""
    return f"{shlex.quote(argument(value))} as BOX" if name == "box" else shlex.join(arguments(name, value))


def _is_same(value: Any, noted: Any) -> bool:
    if isinstance(value, Path) and noted is not None:
        return os.path.abspath(value) == os.path.abspath(noted)
    return bool(value == noted)


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
