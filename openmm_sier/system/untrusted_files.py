"""Files that may come from anybody: only regular ones are opened, and OpenMM gets no XML that could execute code."""

import errno
import os
import re
import stat
from functools import lru_cache
from typing import IO, BinaryIO
from xml.parsers import expat
from xml.sax.saxutils import escape

import openmm

from openmm_sier.system.forces import FORCES

#: Classes that OpenMM may make from XML inside a System or State, by the attribute `type`. None of these executes code
#: or opens a file. PythonForce, and Forces of plugins such as TorchForce, do.
DATA = {
    *(force.__name__ for force, kind in FORCES.items() if kind.is_data),
    *(f"{kind}{dimensions}DFunction" for kind in ("Continuous", "Discrete") for dimensions in (1, 2, 3)),
}

#: Values of `type` that are no classes: how an ATMForce displaces a particle.
DISPLACEMENTS = {"fixed", "offset"}

#: Bytes that are parsed at a time. Among so many a file of OpenMM has tags, as the longest value is an expression.
CHUNK = 2**16

#: Most chunks without the begin or end of an element.
MOST_IDLE = 16

#: Most levels of elements.
DEEPEST = 32

#: Most characters in the values of an element.
LONGEST_VALUES = 2**16

#: Most characters among them that XML escapes. The time that OpenMM takes for these grows with the square of their
#: number: a value of 28 MB takes hours.
MOST_ESCAPED = 100

#: Most elements of a State, of which the checkpoint of a run has nine for each particle.
STATE_ELEMENTS = 1000
PARTICLE_ELEMENTS = 32

#: Most bytes of a State for each element.
ELEMENT_BYTES = 128


class ContentError(ValueError):
    """The content of a file is not of the expected kind, is too long, or could execute code."""


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a file for reading; a pipe or a device, which could block for ever, is refused.

    Raises:
        OSError: it cannot be opened, or is no regular file.
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
    """Return all bytes of a stream, of which no more are read than are allowed.

    Raises:
        ContentError: there are more.
    """
    content = stream.read(most + 1)
    if len(content) > most:
        raise ContentError(f"it holds more than {most} bytes of notes")
    return content


def read_system(stream: IO[bytes]) -> openmm.System:
    """Return the System in a stream of XML.

    Raises:
        ContentError: it is none, or could execute code.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    return openmm.XmlSerializer.deserializeSystem(_Checked("System").text(stream))


def read_state(stream: IO[bytes], particles: int | None = None) -> openmm.State:
    """Return the State in a stream of XML.

    Args:
        stream: of the file.
        particles: of its System, by which its length is bounded; None: unknown.

    Raises:
        ContentError: it is none, or longer than a State of so many particles can be.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    most = None if particles is None else STATE_ELEMENTS + PARTICLE_ELEMENTS * particles
    return openmm.XmlSerializer._deserializeState(_Checked("State", most).text(stream))


class _Checked:
    """XML that is safe for OpenMM, written from the elements and attributes that a strict parser has read.

    OpenMM's own parser reads elements within comments, and OpenMM makes objects by the attribute `type`, whatever the
    tag. So OpenMM gets only elements and attributes that were checked.
    """

    def __init__(self, kind: str, most: int | None = None):
        """Expect an object of a kind, "System" or "State", with so many elements at most."""
        self._kind = kind
        self._most = most
        self._pieces: list[str] = []
        self._elements = 0
        self._depth = 0
        self._parser = expat.ParserCreate("utf-8")
        self._parser.ordered_attributes = True
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype

    def text(self, stream: IO[bytes]) -> str:
        """Return the XML of a stream for OpenMM.

        Raises:
            ContentError: it is no such object, is too long, or could execute code.
        """
        read, idle = 0, 0
        try:
            while chunk := stream.read(CHUNK):
                pieces = len(self._pieces)
                self._parser.Parse(chunk)
                read += len(chunk)
                idle = idle + 1 if len(self._pieces) == pieces else 0
                if idle > MOST_IDLE:
                    raise ContentError(
                        f"it has a tag or text of more than {MOST_IDLE * CHUNK} bytes, which OpenMM never writes"
                    )
                if self._most is not None and read > self._most * ELEMENT_BYTES:
                    raise self._too_long()
            self._parser.Parse(b"", True)
        except expat.ExpatError as error:
            raise ContentError(f"it is not XML: {error}") from None
        return "".join(self._pieces)

    def _begin(self, tag: str, attributes: list[str]) -> None:
        self._elements += 1
        self._depth += 1
        if self._most is not None and self._elements > self._most:
            raise self._too_long()
        if self._depth > DEEPEST:
            raise ContentError(f"its elements are nested in more than {DEEPEST} levels")
        names, values = tuple(attributes[::2]), attributes[1::2]
        if self._elements == 1 or "type" in names:
            self._check_type(tag, dict(zip(names, values, strict=True)).get("type"))
        together = "".join(values)
        if len(together) > LONGEST_VALUES:
            raise ContentError(f"{_shown(tag)} has values of more than {LONGEST_VALUES} characters")
        if escaped := len(_SPECIAL.findall(together)):
            if escaped > MOST_ESCAPED:
                raise ContentError(f'{_shown(tag)} has values with more than {MOST_ESCAPED} of the characters & < > "')
            values = [escape(value, _QUOTES) for value in values]
        self._pieces.append(_template(tag, names) % tuple(values))

    def _check_type(self, tag: str, kind: str | None) -> None:
        """Refuse an object of another kind than is expected, by its tag or by the attribute that OpenMM goes by."""
        if self._elements == 1:
            if tag != self._kind or kind != self._kind:
                raise ContentError(f"expected a {self._kind}, got {_shown(tag)} of the type {_shown(kind)}")
        elif kind is not None and kind not in DATA and kind not in DISPLACEMENTS:
            raise ContentError(
                f"it has a {_shown(kind)}, which is not read from files, since such an object may execute code: make "
                "the System in a script, and simulate it there"
            )

    def _end(self, tag: str) -> None:
        self._depth -= 1
        self._pieces.append(f"</{tag}>")

    def _refuse_doctype(self, *_: object) -> None:
        raise ContentError("it has a document type (DOCTYPE), which OpenMM never writes")

    def _too_long(self) -> ContentError:
        return ContentError("it is longer than a State of the particles of this System can be")


_SPECIAL = re.compile('[&<>"]')
_QUOTES = {'"': "&quot;"}


@lru_cache(maxsize=64)
def _template(tag: str, names: tuple[str, ...]) -> str:
    """Return the begin of an element, with %s for each value. Names have no %."""
    return " ".join((f"<{tag}", *(f'{name}="%s"' for name in names))) + ">"


def _shown(name: str | None) -> str:
    """Return a name as messages show it, of a length that they have room for."""
    return repr(name) if name is None or len(name) <= 40 else f"{name[:40]!r}…"
