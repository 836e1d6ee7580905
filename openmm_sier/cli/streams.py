"""Standard output and standard error: streams that are closed or broken, warnings, and errors in one line."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import sys
from typing import TextIO

from openmm_sier.system import vibrations

PROGRAM = "openmm-sier"

#: What the library advises its callers, as options of the command, which prepares every System.
AS_OPTIONS = {
    vibrations.SHORTER_STEP: "Take a shorter step (--dt)",
    vibrations.MORE_SUBSTEPS: "Take a shorter step (--dt)",
    vibrations.CONSTRAIN: "hold the bond by --constraints hbonds (bonds to hydrogen) or allbonds",
}


#: Signs in what the commands print, and how they are spelled where a stream has no such letters, as with LC_ALL=C.
SPELLED = {"±": "+-", "≥": ">="}


def spell_out(stream: TextIO | None) -> None:
    """Let a stream take every text: letters that it does not have are spelled by others, and the rest by "?"."""
    # There may be none, or one of a program that calls the command, which is not ours to change.
    if not isinstance(stream, io.TextIOWrapper):
        return
    try:
        "".join(SPELLED).encode(stream.encoding)
    except UnicodeEncodeError:
        codecs.register_error("openmm_sier.spelled", _spelled)
        stream.reconfigure(errors="openmm_sier.spelled")


def _spelled(error: UnicodeError) -> tuple[bytes, int]:
    """What stands for text that cannot be encoded, and where to go on: an error handler of `codecs`."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    # Bytes of a file's name that are no text are themselves.
    raw = [os.fsencode(letter) if "\udc80" <= letter <= "\udcff" else None for letter in letters]
    spelled = [SPELLED.get(letter, "?").encode() for letter in letters]
    return b"".join(one if one is not None else two for one, two in zip(raw, spelled, strict=True)), error.end


def discard(stream: TextIO) -> None:
    """Send unwritten text of a broken stream to the null device; otherwise Python would fail on it when it exits."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def complain(message: str) -> None:
    """Print one line on standard error, or nothing if that fails, as with a closed terminal."""
    try:
        print(f"{PROGRAM}: {message}", file=sys.stderr, flush=True)
    except OSError:
        discard(sys.stderr)


def for_the_command(message: Warning | BaseException | str) -> str:
    """A message of the library in one line, with options of the command in place of arguments."""
    text = " ".join(str(message).split())
    for advice, option in AS_OPTIONS.items():
        text = text.replace(advice, option)
    return text


def note_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Show a warning as one line among the notes; it takes the place of `warnings.showwarning`."""
    print(f"warning: {for_the_command(message)}", flush=True)


def described(error: Exception) -> str:
    """An error in one line."""
    message = for_the_command(error) or type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    expected = (
        isinstance(error, (ValueError, OSError, ImportError))
        or type(error).__module__.startswith("openmm")
        or hasattr(error, "exit_code")
    )
    return message if expected else f"{type(error).__name__}: {message} (--debug shows where)"
