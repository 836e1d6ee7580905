"""Checkpoints: a State, and notes of the run that reached it."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import openmm

from openmm_sier.cli.files.records import RecordError, replacing

#: Version of what a checkpoint holds.
FORMAT = 3


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
    with replacing(path) as made:
        made.write_bytes(content.getbuffer())


def read_checkpoint(path: Path) -> tuple[openmm.State, dict[str, Any]]:
    """State and notes of a checkpoint.

    Raises:
        RecordError: the file is no checkpoint of this command, or of another version of it.
        FileNotFoundError: there is no such file.
    """
    found: list[openmm.State] = []
    notes = read_notes(path, lambda text: found.append(openmm.XmlSerializer.deserialize(text)))
    return found[0], notes


def read_notes(path: Path, take_state: Callable[[str], None] | None = None) -> dict[str, Any]:
    """The notes of a checkpoint, with the errors of `read_checkpoint`.

    Args:
        path: of the file.
        take_state: gets the State in XML.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            notes: dict[str, Any] = json.loads(archive.read("notes.json"))
            version = notes.get("format")
            if take_state is not None:
                take_state(archive.read("state.xml").decode())
    except (zipfile.BadZipFile, KeyError, ValueError, EOFError, zlib.error, openmm.OpenMMException) as error:
        raise RecordError(f"{path} is no checkpoint of openmm-sier run") from error
    if version != FORMAT:
        raise RecordError(f"{path} was written by another version of openmm-sier, in format {version}")
    return notes
