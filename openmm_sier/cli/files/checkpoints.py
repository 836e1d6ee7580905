"""Checkpoints: a State, and notes of the run that reached it."""

import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import openmm

from openmm_sier.cli.files import records

#: Version of what a checkpoint holds.
FORMAT = 1

#: With which a zip archive begins that has a file.
LOCAL_HEADER = b"PK\x03\x04"


def write_checkpoint(path: Path, state: openmm.State, notes: dict[str, Any]) -> None:
    """Replace the checkpoint: at any moment the file is either the old or the new one.

    Args:
        path: of the file, a zip archive with state.xml and notes.json.
        state: openmm.State with positions, velocities and parameters.
        notes: what JSON can hold.

    Raises:
        OSError: it cannot be written. The old one is still there, and nothing of the new one.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("state.xml", openmm.XmlSerializer.serialize(state))
        archive.writestr("notes.json", json.dumps({"format": FORMAT, **notes}, indent=1))
    records.replace(path, content.getbuffer())


def read_checkpoint(path: Path) -> tuple[openmm.State, dict[str, Any]]:
    """State and notes of a checkpoint.

    Raises:
        RecordError: the file is not a checkpoint of this command, or of another version of it.
        FileNotFoundError: there is no such file.
    """
    with _opened(path) as archive:
        notes = _notes(archive)
        state = openmm.XmlSerializer.deserialize(archive.read("state.xml").decode())
    _refuse_other_version(path, notes)
    return state, notes


def read_notes(path: Path) -> dict[str, Any]:
    """Notes of a checkpoint, without its State; see `read_checkpoint`."""
    with _opened(path) as archive:
        notes = _notes(archive)
    _refuse_other_version(path, notes)
    return notes


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a checkpoint; what fails while it is read becomes a `RecordError`."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except (zipfile.BadZipFile, KeyError, ValueError, EOFError, zlib.error, openmm.OpenMMException) as error:
        raise records.RecordError(_complaint(path)) from error


def _complaint(path: Path) -> str:
    """Say of a file that cannot be read whether it is a checkpoint that was cut off, or none."""
    with path.open("rb") as file:
        begin = file.read(len(LOCAL_HEADER))
    if LOCAL_HEADER.startswith(begin) and not zipfile.is_zipfile(path):
        return f"{path} is incomplete: a checkpoint of openmm-sier run was cut off, for example while it was copied"
    return f"{path} is not a checkpoint of openmm-sier run"


def _notes(archive: zipfile.ZipFile) -> dict[str, Any]:
    notes: dict[str, Any] = json.loads(archive.read("notes.json"))
    return notes


def _refuse_other_version(path: Path, notes: dict[str, Any]) -> None:
    if (version := notes.get("format")) != FORMAT:
        raise records.RecordError(
            f"{path} was written by another version of openmm-sier, in format {version}; this version reads format "
            f"{FORMAT}: finish the run with that version, or begin a new one"
        )
