"""Checkpoints: a State, and notes of the run that reached it."""

import io
import json
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import openmm

from openmm_sier.cli.files import records
from openmm_sier.system.untrusted_files import ContentError, open_regular, read_state, read_within

#: Version of what a checkpoint holds.
FORMAT = 1

#: Most bytes of notes; a hundred thousand bodies named by --rigid take some four million.
MOST_NOTES = 2**24


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


def read_checkpoint(path: Path, particles: int | None = None) -> tuple[openmm.State, dict[str, Any]]:
    """State and notes of a checkpoint.

    Args:
        path: of the file.
        particles: of its System, by which the length of its State is bounded; None: unknown.

    Raises:
        RecordError: the file is not a checkpoint of this command, or of another version of it.
        FileNotFoundError: there is no such file.
    """
    with _opened(path) as archive:
        notes = _notes(archive)
        with _part(archive, "state.xml") as content:
            state = read_state(content, particles)
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
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            yield archive
    except ContentError as error:
        raise records.RecordError(f"{path} is not a checkpoint of openmm-sier run: {error}") from None
    except _UNREADABLE as error:
        raise records.RecordError(f"{path} is not a checkpoint of openmm-sier run") from error


#: What zip, JSON and OpenMM raise where a file is none of theirs. A RuntimeError comes of passwords, and of lists that
#: are nested too deeply.
_UNREADABLE = zipfile.BadZipFile, KeyError, ValueError, EOFError, RuntimeError, zlib.error, openmm.OpenMMException


def _part(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    """Open a part of a checkpoint that is packed as `write_checkpoint` packs it."""
    if archive.getinfo(name).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise zipfile.BadZipFile
    return archive.open(name)


def _notes(archive: zipfile.ZipFile) -> dict[str, Any]:
    with _part(archive, "notes.json") as content:
        notes: dict[str, Any] = json.loads(read_within(content, MOST_NOTES))
    return notes


def _refuse_other_version(path: Path, notes: dict[str, Any]) -> None:
    if (version := notes.get("format")) != FORMAT:
        raise records.RecordError(
            f"{path} was written by another version of openmm-sier, in format {version}; this version reads format "
            f"{FORMAT}: finish the run with that version, or begin a new one"
        )
