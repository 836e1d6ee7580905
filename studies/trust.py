"""Claims: text and bounds. The list is in `studies.claims`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import pandas as pd

from studies import records
from studies.command import SYSTEMS
from studies.records import DATA, Record

ROOT = SYSTEMS.parent

#: Lower and upper bound of a figure.
Bound = tuple[float, float]

#: No bound on this side.
ANY = float("inf")


@dataclass(frozen=True)
class Claim:
    """A claim that a record shows.

    Attributes:
        text: the sentence, with fields such as {least:.0f}.
        record: file in studies/data.
        figures: of the record, by the names of the fields.
        bounds: of figures, by name.
        in_readme: whether README has the sentence, word for word.
        in_paper: whether the draft of the paper has it.
    """

    text: str
    record: str
    figures: Callable[[Record], Mapping[str, float]]
    bounds: Mapping[str, Bound]
    in_readme: bool = False
    in_paper: bool = False

    def found(self) -> Mapping[str, float]:
        """Return the figures of the record.

        Raises:
            LookupError: it lacks a row or a column that the claim is about.
        """
        try:
            return self.figures(records.read(DATA / self.record))
        except LookupError as error:
            raise LookupError(f"{self.record} does not show {self.text!r}: {error}") from error

    def sentence(self) -> str:
        """Return the text with its figures."""
        return self.text.format_map(self.found())

    def broken(self) -> list[str]:
        """Return the bounds that the record does not keep, in words."""
        figures = self.found()
        return [
            f"{in_words(name, bound)}, got {figures[name]:g}"
            for name, bound in self.bounds.items()
            if not bound[0] <= figures[name] <= bound[1]
        ]


def in_words(name: str, bound: Bound) -> str:
    """Return a bound as the page has it."""
    (least, most), name = bound, name.replace("_", " ")
    if least == most:
        return f"{name} = {least:g}"
    if most == ANY:
        return f"{name} ≥ {least:g}"
    return f"{name} ≤ {most:g}" if least == -ANY else f"{least:g} ≤ {name} ≤ {most:g}"


def listed(claims: Iterable[Claim]) -> str:
    """Return claims as a page lists them, each with its bounds and its record, and then the commands of the records."""
    lines, files = [], []
    for claim in claims:
        bounds = "; ".join(in_words(name, bound) for name, bound in claim.bounds.items())
        lines.append(f"- {claim.sentence()}\\\n  Bounds: {bounds}. Record: `{claim.record}`\n")
        files.append(claim.record)
    made_by = [f"- {records.source(file)}\n" for file in dict.fromkeys(files)]
    return "\n".join([*lines, "The records were made by these commands:\n", *made_by])


def one(frame: pd.DataFrame, **conditions: object) -> pd.Series:
    """Return the only row that has these values.

    Raises:
        LookupError: there is none, or there are several.
    """
    rows = frame
    for name, value in conditions.items():
        rows = rows[rows[name] == value]
    if len(rows) != 1:
        raise LookupError(f"{len(rows)} rows have {conditions}")
    return rows.iloc[0]
