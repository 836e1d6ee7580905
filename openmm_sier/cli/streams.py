"""Standard output and standard error: streams that are closed or broken, warnings, and errors in one line."""

import contextlib
import io
import os
import sys
from typing import TextIO

PROGRAM = "openmm-sier"

#: Libraries of the extra `cli`.
LIBRARIES = ("cyclopts", "filelock", "mdtraj", "pydantic", "rich", "tomli")


def escape(stream: TextIO | None) -> None:
    """Let a stream escape characters that its encoding does not have, as Python's standard error does."""
    # Streams of a program that calls the command stay as they are.
    if isinstance(stream, io.TextIOWrapper):
        stream.reconfigure(errors="backslashreplace")


def printable(text: str) -> str:
    """Return a text in which control characters, except line breaks, are escaped.

    All lines and tables of the command are printed this way, since names and texts in files may contain them.
    """
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def discard(stream: TextIO) -> None:
    """Send unwritten text of a broken stream to the null device; otherwise Python would fail on it when it exits."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def show(text: str, end: str = "\n") -> None:
    """Print a text on standard output. If its reader has ended, as `head` does, the command goes on without it."""
    try:
        print(text, end=end, flush=True)
    except BrokenPipeError:
        discard(sys.stdout)


def complain(message: str) -> None:
    """Print one line on standard error, or nothing if that fails, as with a closed terminal."""
    try:
        print(printable(f"{PROGRAM}: {message}"), file=sys.stderr, flush=True)
    except OSError:
        discard(sys.stderr)


def in_one_line(message: Warning | BaseException | str) -> str:
    """Return a message in one line."""
    return " ".join(str(message).split())


def note_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning as one line among the notes; replaces `warnings.showwarning`."""
    show(printable(f"warning: {in_one_line(message)}"))


def described(error: Exception) -> str:
    """Return an error in one line."""
    if isinstance(error, ModuleNotFoundError) and (library := str(error.name).split(".")[0]) in LIBRARIES:
        return f"the command needs {library}; install it with: pip install 'openmm-sier[cli]'"
    message = in_one_line(error) or type(error).__name__
    if isinstance(error, FileNotFoundError) and error.filename:
        return f"{error.filename}: {error.strerror}. Check its name, which counts from the current directory"
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    of_ours = type(error).__module__.startswith("openmm") or hasattr(error, "exit_code")
    expected = of_ours or isinstance(error, (ValueError, OSError, ImportError))
    return message if expected else f"{type(error).__name__}: {message} (--debug shows where)"
