"""Checkpoints: a State, and notes of the run that reached it."""

from __future__ import annotations

import io
import json
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import openmm

from openmm_sier.cli.files.records import RecordError, replacing
from openmm_sier_command.options import MOST_STEPS, checked
from openmm_sier_command.values import Kind, number, table, whole, word

#: Version of what a checkpoint holds.
FORMAT = 2

#: What is noted of a run: its identity, its options, and numbers.
ENTRIES = {
    "run": word(),
    "plan": Kind("options by name", lambda value: isinstance(value, dict)),
    "step": whole(0, MOST_STEPS),
    "potential_energy": number("kJ/mol", -1e15, 1e15),
}

#: What is noted of each file that grows. Counts in DCD files have 32 bits.
_FILE = table({"size": whole(0, 2**63 - 1), "count": whole(0, 2**31 - 1), "fingerprint": word()})
FILES = dict.fromkeys(("trajectory", "log", "bodies", "tensors"), _FILE)

#: What not every run has.
OPTIONAL = ("bodies", "tensors")


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


def read_checkpoint(path: Path, files: bool = True) -> tuple[Any, dict[str, Any]]:
    """State and notes of a checkpoint.

    Args:
        path: of the checkpoint.
        files: whether what it notes of the run's files matters.

    Raises:
        RecordError: the file is no checkpoint of this command.
        OptionError: its notes are not what they must be; `openmm_sier.cli.plan.noted_plan` checks its plan.
        FileNotFoundError: there is no such file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            state = _state(archive.read("state.xml").decode())
            notes = json.loads(archive.read("notes.json"))
            if not isinstance(notes, dict):
                raise ValueError("the notes have no names")
    except (zipfile.BadZipFile, KeyError, ValueError, EOFError, zlib.error, openmm.OpenMMException) as error:
        raise RecordError(f"{path} is no checkpoint of openmm-sier run") from error
    if notes.get("format") != FORMAT:
        raise RecordError(f"{path} was written by another version of openmm-sier, in format {notes.get('format')}")
    for name, kind in (ENTRIES | FILES if files else ENTRIES).items():
        if name not in OPTIONAL or notes.get(name) is not None:
            checked(str(path), name, kind, notes.get(name))
    return state, notes


def _state(text: str) -> openmm.State:
    """A State from XML; what is anything else is not even read."""
    if not re.match(r"(<\?xml[^>]*\?>)?\s*<State\b", text):
        raise ValueError("expected the XML of a State")
    return openmm.XmlSerializer.deserialize(text)
