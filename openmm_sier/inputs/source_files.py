"""Files of an input, each of which is read once."""

from __future__ import annotations

import hashlib
import io
import os
from functools import cached_property

from openmm_sier.system.untrusted_files import open_regular

#: A path, as functions of this package take it.
FilePath = str | os.PathLike[str]


class SourceFile(os.PathLike[str]):
    """A file of an input, which can be used as its path. Its content is read once.

    So all readers, and the fingerprint, have the same content, even if the file is edited meanwhile.
    """

    def __init__(self, path: FilePath):
        """Take the path of a file, which is opened when its content is first needed."""
        self._path = os.fspath(path)

    @classmethod
    def of(cls, path: FilePath) -> SourceFile:
        """Return the file at a path, or `path` itself where that is such a file already."""
        return path if isinstance(path, cls) else cls(path)

    def __fspath__(self) -> str:
        return self._path

    def __str__(self) -> str:
        return self._path

    @cached_property
    def content(self) -> bytes:
        """Bytes of the file.

        Raises:
            OSError: it cannot be read, or is no regular file.
        """
        with open_regular(self._path) as file:
            return file.read()

    @cached_property
    def text(self) -> str:
        """Text of the file; bytes that are not UTF-8 are replaced."""
        return self.content.decode(errors="replace")

    @property
    def lines(self) -> list[str]:
        """Lines of the text, without their ends."""
        return self.text.splitlines()

    @property
    def stream(self) -> io.StringIO:
        """The text for a reader of OpenMM that takes an open file."""
        return io.StringIO(self.text, newline=None)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the content."""
        return hashlib.sha256(self.content).hexdigest()
