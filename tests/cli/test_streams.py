"""Standard output that has no letters beyond ASCII."""

from __future__ import annotations

import io

from openmm_sier.cli.main import main
from openmm_sier.cli.streams import SPELLED
from openmm_sier.measure.statistics import Estimate
from tests.support.commands import SMALL


def test_signs_are_spelled_where_a_stream_has_no_such_letters(box, monkeypatch):
    """As with LC_ALL=C, where a finished run ended with exit code 1 on "±"."""
    printed = io.TextIOWrapper(io.BytesIO(), "ascii", "surrogateescape")
    monkeypatch.setattr("sys.stdout", printed)
    assert main(["run", str(box), *SMALL, "--steps", "5"]) == 0
    printed.flush()
    assert " +- " in printed.buffer.getvalue().decode("ascii")
    # What has no spelling, and bytes of a file's name that are no letters.
    printed.write("ø \udcff")
    printed.flush()
    assert printed.buffer.getvalue().endswith(b"? \xff")
    assert {letter for letter in str(Estimate(1.0, 0.1, 3)) if not letter.isascii()} == set(SPELLED)
