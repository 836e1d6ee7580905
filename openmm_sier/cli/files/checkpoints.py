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
    """Replace the checkpoint, a zip archive: at any moment, and after an error, it is either the old or the new one."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("state.xml", openmm.XmlSerializer.serialize(state))
        archive.writestr("notes.json", json.dumps({"format": FORMAT, **notes}, indent=1))
    with replacing(path) as made:
        made.write_bytes(content.getbuffer())


def read_checkpoint(path: Path, files: bool = True) -> tuple[Any, dict[str, Any]]:
    """State and notes of a checkpoint, of the run's files too where `files` says that they matter.

    A `RecordError` or `OptionError` says what is wrong; `openmm_sier.cli.plan.noted_plan` checks its plan.
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
