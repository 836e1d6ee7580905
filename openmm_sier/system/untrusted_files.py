"""Read files from untrusted sources: only regular files, and no XML that could execute code."""

import errno
import math
import os
import stat
from typing import IO, BinaryIO
from xml.parsers import expat
from xml.sax.saxutils import escape

import openmm

from openmm_sier.system.forces import FORCES

#: Classes of objects that OpenMM creates by the attribute `type`, by the tags of their elements. They neither execute
#: code nor open files, unlike PythonForce, and Forces of plugins such as TorchForce.
CLASSES = {
    "Force": {force.__name__ for force, kind in FORCES.items() if kind.is_data},
    "Function": {f"{kind}{dimensions}DFunction" for kind in ("Continuous", "Discrete") for dimensions in (1, 2, 3)},
}

#: Element whose children are functions, and nothing else.
FUNCTIONS = "Functions"

#: Values of `type` that are not classes, except numbers: displacements of an ATMForce.
DISPLACEMENTS = {"fixed", "offset"}

#: Attributes of a State that are not numbers.
TEXTS = {"type", "openmmVersion"}

#: Quotes that end values of attributes.
QUOTES = {'"': "&quot;"}

#: Maximum depth of nested elements, which OpenMM reads by recursion; a Force within a Force is three deeper.
DEEPEST = 100


class ContentError(ValueError):
    """Content of a file that is not of the expected kind, or could execute code."""


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


def read_system(stream: IO[bytes]) -> openmm.System:
    """Return the System in an XML stream.

    Raises:
        ContentError: the stream is not a System, or could execute code.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    return openmm.XmlSerializer.deserializeSystem(_checked_xml("System", stream.read()))


def read_state(stream: IO[bytes]) -> openmm.State:
    """Return the State in an XML stream.

    Raises:
        ContentError: the stream is not a State, or has numbers that are not finite.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    return openmm.XmlSerializer._deserializeState(_checked_xml("State", stream.read()))


def _checked_xml(kind: str, content: bytes) -> str:
    """Return XML for OpenMM, with the elements and attributes that a strict parser reads.

    OpenMM's parser reads elements inside comments, and OpenMM creates objects by the attribute `type`, whatever the
    tag, and uses a function as a Force. So OpenMM receives only checked elements and attributes.

    Args:
        kind: of the object, "System" or "State".
        content: the XML.

    Raises:
        ContentError: the content is not such an object, could execute code, or has numbers that are not finite.
    """
    pieces: list[str] = []
    opened: list[str] = []

    def begin(tag: str, attributes: dict[str, str]) -> None:
        created = attributes.get("type")
        if not opened and (tag, created) != (kind, kind):
            raise ContentError(f"expected a {kind}, got {tag[:40]!r} of the type {str(created)[:40]!r}")
        if opened and created is not None:
            _check_type(created, tag, opened[-1])
        if len(opened) == DEEPEST:
            raise ContentError(f"it has more than {DEEPEST} elements within each other")
        if kind == "State" and not all(_is_finite(value) for name, value in attributes.items() if name not in TEXTS):
            raise ContentError("it has numbers that are not finite")
        opened.append(tag)
        pieces.extend((f"<{tag}", *(f' {name}="{escape(value, QUOTES)}"' for name, value in attributes.items()), ">"))

    def end(tag: str) -> None:
        opened.pop()
        pieces.append(f"</{tag}>")

    def refuse_doctype(*_: object) -> None:
        raise ContentError("it has a document type (DOCTYPE), which OpenMM never writes")

    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler = begin
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = refuse_doctype
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise ContentError(f"it is not XML: {error}") from None
    return "".join(pieces)


def _check_type(created: str, tag: str, parent: str) -> None:
    """Refuse an element of which OpenMM would create an object that executes code, or one in place of another.

    Args:
        created: its attribute `type`.
        tag, parent: its tag, and that of the element in which it is.
    """
    if tag in CLASSES and (tag == "Function") == (parent == FUNCTIONS) and created in CLASSES[tag]:
        return
    if tag not in CLASSES and (created in DISPLACEMENTS or _is_finite(created)):
        return
    if any(created in classes for classes in CLASSES.values()):
        place = f"as a {tag[:40]!r} in {parent[:40]!r}"
        raise ContentError(f"it has a {created} {place}, where OpenMM expects another object")
    raise ContentError(
        f"it has a {created[:40]!r}, which is not read from files, since such an object may execute code. Create the "
        "System in a script, and simulate it there"
    )


def _is_finite(text: str) -> bool:
    """Return whether a text is a finite number."""
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
