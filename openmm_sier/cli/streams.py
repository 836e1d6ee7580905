"""Standard output and standard error: streams that are closed or broken, warnings, and errors in one line."""

import contextlib
import io
import os
import sys
from typing import TextIO

from openmm_sier.stability import advice

PROGRAM = "openmm-sier"

#: What the extra `cli` brings.
LIBRARIES = ("cyclopts", "filelock", "mdtraj", "pydantic", "rich", "tomli")

#: What the library advises its callers, as options of the command, which prepares every System.
AS_OPTIONS = {
    advice.PREPARE: "Take a shorter step (--dt)",
    advice.SHORTER_STEP: "Take a shorter step (--dt)",
    advice.MORE_SUBSTEPS: "Take a shorter step (--dt)",
    advice.CONSTRAIN: "hold the bond by --constraints hbonds (bonds to hydrogen) or allbonds",
    advice.CONSTRAIN_HEAVY: "hold the bond by --constraints allbonds, or its residue by --rigid NAME",
    advice.ONE_BODY: "leave its molecule out of --rigid and hold the bond by --constraints allbonds",
    advice.KEEP_HEAVY: "",
    advice.HEAVY: "--hydrogen-mass 4",
}


def escape(stream: TextIO | None) -> None:
    """Let a stream take every text, as Python's standard error does: letters that it does not have are escaped."""
    # There may be none, or one of a program that calls the command, which is not ours to change.
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="backslashreplace")


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
    for words, option in AS_OPTIONS.items():
        text = text.replace(words, option)
    return text


def note_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Show a warning as one line among the notes; it takes the place of `warnings.showwarning`."""
    print(f"warning: {for_the_command(message)}", flush=True)


def described(error: Exception) -> str:
    """An error in one line."""
    if isinstance(error, ModuleNotFoundError) and (library := str(error.name).split(".")[0]) in LIBRARIES:
        return f"the command needs {library}; install it with: pip install 'openmm-sier[cli]'"
    message = for_the_command(error) or type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    of_ours = type(error).__module__.startswith("openmm") or hasattr(error, "exit_code")
    expected = of_ours or isinstance(error, (ValueError, OSError, ImportError))
    return message if expected else f"{type(error).__name__}: {message} (--debug shows where)"
