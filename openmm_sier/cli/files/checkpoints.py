"""Checkpoints: a State, and notes of the run that reached it."""

import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import openmm
from openmm import unit
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from openmm_sier.cli.fields import Name
from openmm_sier.cli.files import records
from openmm_sier.cli.settings import MOST_STEPS
from openmm_sier.inputs.pdb_files import LONGEST
from openmm_sier.system.untrusted_files import ContentError, open_regular, read_state

#: Version of the content of checkpoints.
FORMAT = 1

#: The name of the platform in the notes.
PLATFORM = "Platform"

#: Errors of zip, JSON and OpenMM for other content. A RuntimeError is raised for passwords and for lists that are
#: nested too deeply.
_UNREADABLE = zipfile.BadZipFile, KeyError, ValueError, EOFError, RuntimeError, zlib.error, openmm.OpenMMException


class Notes(BaseModel):
    """Notes on a run in its checkpoint.

    Attributes:
        format: `FORMAT`.
        plan: settings of the run by name, which `openmm_sier.cli.planning.noted_settings` checks.
        step: of the run.
        potential_energy: at that step, kJ/mol.
        platform: its name under `PLATFORM`; those of earlier versions have more.
        inputs: SHA-256 of the files that the run read, by purpose.
        unsettled: how a doubtful equilibration ended, in words.
        trajectory, log, tensors: notes on the files that the run writes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: int
    plan: dict[str, Any]
    step: Annotated[int, Field(ge=0, le=MOST_STEPS)]
    potential_energy: Annotated[float, Field(allow_inf_nan=False)]
    platform: dict[Name, Name]
    inputs: dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]]
    unsettled: Name | None
    trajectory: records.Noted
    log: records.Noted
    tensors: Annotated[records.Noted | None, Field(validate_default=True)] = None

    def file(self, name: str) -> records.Noted:
        """Return the note on a file that the run writes, by its name among these notes."""
        noted: records.Noted = getattr(self, name)
        return noted

    @field_validator("platform")
    @classmethod
    def _check_platform(cls, platform: dict[str, str]) -> dict[str, str]:
        if PLATFORM not in platform:
            raise ValueError(f"expected a {PLATFORM}")
        return platform

    @field_validator("tensors")
    @classmethod
    def _check_tensors(cls, tensors: records.Noted | None, info: ValidationInfo) -> records.Noted | None:
        is_written = info.data.get("plan", {}).get("pressure_tensor") is not None
        if is_written != (tensors is not None):
            raise ValueError(f"expected {'a file' if is_written else 'nothing'}, as the settings say")
        return tensors


def write_checkpoint(path: Path, state: openmm.State, notes: Notes) -> None:
    """Replace the checkpoint: at any moment the file is either the old or the new one.

    Args:
        path: of the file, a zip archive with state.xml and notes.json.
        state: openmm.State with positions, velocities and parameters.
        notes: of the run that reached the state.

    Raises:
        OSError: it cannot be written. The old one still exists, and nothing of the new one.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("state.xml", openmm.XmlSerializer.serialize(state))
        archive.writestr("notes.json", notes.model_dump_json(indent=1))
    records.replace(path, content.getbuffer())


def read_checkpoint(path: Path) -> tuple[openmm.State, Notes]:
    """Return the State and the notes of a checkpoint.

    Raises:
        RecordError: the file is damaged, is not a checkpoint of this command, or of another version of it.
        FileNotFoundError: there is no such file.
    """
    with _opened(path) as archive:
        noted = json.loads(archive.read("notes.json"))
        with archive.open("state.xml") as content:
            state = read_state(content)
    notes = _checked(path, noted)
    if (step := state.getStepCount()) != notes.step:
        raise _damaged(path, f"its State is of step {step}, and its note step says {notes.step}")
    _check_contents(path, state)
    return state, notes


def _check_contents(path: Path, state: openmm.State) -> None:
    """Refuse a State that no run writes."""
    try:
        state.getPositions(), state.getVelocities()
    except openmm.OpenMMException:
        raise _damaged(path, "its State lacks positions or velocities") from None
    longest = float(np.abs(state.getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer)).max())
    if longest > LONGEST:
        raise _damaged(path, f"its State has a box with an edge of {longest:.3g} nm")


def read_notes(path: Path) -> Notes:
    """Return the notes of a checkpoint without reading its State; see `read_checkpoint`."""
    with _opened(path) as archive:
        noted = json.loads(archive.read("notes.json"))
    return _checked(path, noted)


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a checkpoint; errors while it is read become a `RecordError`."""
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            yield archive
    except ContentError as error:
        raise _damaged(path, str(error)) from None
    except _UNREADABLE as error:
        raise _damaged(path, "it cannot be read, or was cut off") from error


def _checked(path: Path, noted: Any) -> Notes:
    """Return notes from the JSON of a checkpoint.

    Raises:
        RecordError: a note is missing or wrong, or of another version; the message names it.
    """
    version = noted.get("format") if isinstance(noted, dict) else None
    if type(version) is int and version != FORMAT:
        raise records.RecordError(
            f"{path} was written by another version of openmm-sier, in format {version}; this version reads format "
            f"{FORMAT}: finish the run with that version, or begin a new one"
        )
    try:
        return Notes.model_validate_json(json.dumps(noted), strict=True)
    except ValidationError as error:
        first = error.errors(include_input=False)[0]
        name = ".".join(map(str, first["loc"]))
        raise _damaged(path, f"{f'its note {name}' if name else 'its notes'}: {first['msg']}") from None


def _damaged(path: Path, reason: str) -> records.RecordError:
    return records.RecordError(
        f"{path} is damaged, or is not a checkpoint of openmm-sier run: {reason}. Give another one, or begin a new run"
    )
