"""Read files from untrusted sources: only regular files, and no XML that could execute code."""

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

#: Values of the attribute `type` in XML for which OpenMM creates objects that neither execute code nor open files,
#: unlike PythonForce, and Forces of plugins such as TorchForce.
DATA = {
    *(force.__name__ for force, kind in FORCES.items() if kind.is_data),
    *(f"{kind}{dimensions}DFunction" for kind in ("Continuous", "Discrete") for dimensions in (1, 2, 3)),
}

#: Values of `type` that are not classes: displacements of an ATMForce.
DISPLACEMENTS = {"fixed", "offset"}

#: Number of bytes parsed at a time. Files of OpenMM have tags in any chunk, as the longest value is an expression.
CHUNK = 2**16

#: Maximum number of chunks without the start or end of an element.
MOST_IDLE = 16

#: Maximum nesting of elements.
DEEPEST = 32

#: Maximum number of characters in the values of an element.
LONGEST_VALUES = 2**16

#: Maximum number of characters among them that XML escapes. OpenMM's time for these is quadratic in their number: a
#: value of 28 MB takes hours.
MOST_ESCAPED = 100

#: Maximum number of elements of a State, in total and per particle; checkpoints of runs have nine per particle.
STATE_ELEMENTS = 1000
PARTICLE_ELEMENTS = 32

#: Maximum number of bytes per element of a State.
ELEMENT_BYTES = 128


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
        raise ContentError(f"it holds more than {most} bytes of notes")
    return content


def read_system(stream: IO[bytes]) -> openmm.System:
    """Return the System in an XML stream.

    Raises:
        ContentError: the stream is not a System, or could execute code.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    return openmm.XmlSerializer.deserializeSystem(_Checked("System").text(stream))


def read_state(stream: IO[bytes], particles: int | None = None) -> openmm.State:
    """Return the State in an XML stream.

    Args:
        stream: the open file.
        particles: number of particles, which bounds the length; None if unknown.

    Raises:
        ContentError: the stream is not a State, or longer than a State of these particles can be.
        openmm.OpenMMException: OpenMM cannot read it.
    """
    most = None if particles is None else STATE_ELEMENTS + PARTICLE_ELEMENTS * particles
    return openmm.XmlSerializer._deserializeState(_Checked("State", most).text(stream))


class _Checked:
    """Sanitizer of XML, which rewrites the elements and attributes read by a strict parser.

    OpenMM's parser reads elements inside comments, and OpenMM creates objects by the attribute `type`, whatever the
    tag. So OpenMM receives only checked elements and attributes.
    """

    def __init__(self, kind: str, most: int | None = None):
        """Expect an object of a kind, "System" or "State", with at most `most` elements."""
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
            ContentError: the stream is not such an object, is too long, or could execute code.
        """
        count, idle = 0, 0
        try:
            while chunk := stream.read(CHUNK):
                pieces = len(self._pieces)
                self._parser.Parse(chunk)
                count += len(chunk)
                idle = idle + 1 if len(self._pieces) == pieces else 0
                if idle > MOST_IDLE:
                    raise ContentError(
                        f"it has a tag or text of more than {MOST_IDLE * CHUNK} bytes, which OpenMM never writes"
                    )
                if self._most is not None and count > self._most * ELEMENT_BYTES:
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
        """Refuse an object of an unexpected kind, by its tag and by the attribute that OpenMM uses."""
        if self._elements == 1:
            if tag != self._kind or kind != self._kind:
                raise ContentError(f"expected a {self._kind}, got {_shown(tag)} of the type {_shown(kind)}")
        elif kind is not None and kind not in DATA and kind not in DISPLACEMENTS:
            raise ContentError(
                f"it has a {_shown(kind)}, which is not read from files, since such an object may execute code. Create "
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
    """Return the start of an element, with %s for each value. Names contain no %."""
    return " ".join((f"<{tag}", *(f'{name}="%s"' for name in names))) + ">"


def _shown(name: str | None) -> str:
    """Return a name for messages, shortened to 40 characters."""
    return repr(name) if name is None or len(name) <= 40 else f"{name[:40]!r}…"
