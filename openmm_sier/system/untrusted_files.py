"""Read files from untrusted sources: only regular files, and no XML that could execute code."""

import errno
import os
import stat
from typing import IO, BinaryIO
from xml.parsers import expat
from xml.sax.saxutils import escape

import openmm

from openmm_sier.system.forces import FORCES

#: Values of the attribute `type` in XML for which OpenMM creates objects that neither execute code nor open files,
#: unlike PythonForce, and Forces of plugins such as TorchForce.
DATA = {
    *(force.__name__ for force, kind in FORCES.items() if kind.is_data),
    *(f"{kind}{dimensions}DFunction" for kind in ("Continuous", "Discrete") for dimensions in (1, 2, 3)),
}

#: Quotes that end values of attributes.
QUOTES = {'"': "&quot;"}

#: Values of `type` that are not classes: displacements of an ATMForce.
DISPLACEMENTS = {"fixed", "offset"}

#: Maximum number of bytes of a State, in total and per particle; a State of a run has some 500 per particle.
STATE_BYTES, PARTICLE_BYTES = 2**17, 2**12


class ContentError(ValueError):
    """Content of a file that is not of the expected kind, is too long, or could execute code."""


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading; pipes and devices, which could block for ever, are refused.

    Raises:
        OSError: the file cannot be opened, or is not a regular file.
    """
    # Only O_RDONLY exists on every system.
    flags = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_BINARY", "O_CLOEXEC"))
    descriptor = os.open(path, flags)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    raise OSError(errno.EINVAL, "not a regular file", os.fspath(path))


def read_within(stream: IO[bytes], most: int) -> bytes:
    """Return all bytes of a stream, up to a maximum.

    Raises:
        ContentError: the stream is longer.
    """
    content = stream.read(most + 1)
    if len(content) > most:
        raise ContentError(f"it holds more than {most} bytes")
    return content


def read_system(stream: IO[bytes]) -> openmm.System:
    """Return the System in an XML stream.

    Raises:
        ContentError: the stream is not a System, or could execute code.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    return openmm.XmlSerializer.deserializeSystem(_checked_xml("System", stream.read()))


def read_state(stream: IO[bytes], particles: int | None = None) -> openmm.State:
    """Return the State in an XML stream.

    Args:
        stream: the open file.
        particles: number of particles, which bounds the length; None if unknown.

    Raises:
        ContentError: the stream is not a State, or longer than a State of these particles can be.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    content = stream.read() if particles is None else read_within(stream, STATE_BYTES + PARTICLE_BYTES * particles)
    return openmm.XmlSerializer._deserializeState(_checked_xml("State", content))


def _checked_xml(kind: str, content: bytes) -> str:
    """Return XML for OpenMM, with the elements and attributes that a strict parser reads.

    OpenMM's parser reads elements inside comments, and OpenMM creates objects by the attribute `type`, whatever the
    tag. So OpenMM receives only checked elements and attributes.

    Args:
        kind: of the object, "System" or "State".
        content: the XML.

    Raises:
        ContentError: the content is not such an object, or could execute code.
    """
    pieces: list[str] = []

    def begin(tag: str, attributes: dict[str, str]) -> None:
        created = attributes.get("type")
        if not pieces and (tag, created) != (kind, kind):
            raise ContentError(f"expected a {kind}, got {tag[:40]!r} of the type {str(created)[:40]!r}")
        if pieces and created is not None and created not in DATA and created not in DISPLACEMENTS:
            raise ContentError(
                f"it has a {created[:40]!r}, which is not read from files, since such an object may execute code. "
                "Create the System in a script, and simulate it there"
            )
        pieces.extend((f"<{tag}", *(f' {name}="{escape(value, QUOTES)}"' for name, value in attributes.items()), ">"))

    def refuse_doctype(*_: object) -> None:
        raise ContentError("it has a document type (DOCTYPE), which OpenMM never writes")

    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler = begin
    parser.EndElementHandler = lambda tag: pieces.append(f"</{tag}>")
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise ContentError(f"it is not XML: {error}") from None
    return "".join(pieces)
