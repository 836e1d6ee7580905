"""Tables of results as text, for terminals and pages: a heading and a format of Python for each column.

    table(rows, {"method": "{method}", "{box}": "{over:.2f} ± {over_error:.2f}"})

has a line for each method, and a column for each box.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from string import Formatter
from typing import Any

import pandas as pd

from openmm_sier.analysis.statistics import Estimate

#: Headings of columns of several studies, by their names in tables.
HEADINGS = {
    "label": "run",
    "fast": "fast forces",
    "step": "step/fs",
    "time": "ps",
    "length": "trial/fs",
    "percent": "rms(H)/rms(V)/%",
    "walk": "walk/%",
    "drift": "drift of the box/kJ/mol/ps",
    "spread": "sd/kT",
    "translation": "T_trans/K",
    "rotation": "T_rot/K",
    "difference": "T_rot - T_trans/K",
    "potential": "V/kJ/mol",
    "density": "g/cm³",
    "relative": "over Verlet at 2 fs",
}

#: Cell without a value.
UNKNOWN = "-"


def columns(*names: str) -> dict[str, str]:
    """Return columns for `table`: values, with their errors where there are any.

    Names that `HEADINGS` lacks are headings.
    """
    return {HEADINGS.get(name, name.replace("_", " ")): f"{{{name}_text}}" for name in names}


def table(rows: pd.DataFrame, columns: Mapping[str, str]) -> pd.DataFrame:
    """Return a table of text.

    Args:
        rows: data of the table.
        columns: for each heading what stands in its cells, see `cell`. A heading with fields of its own, such as
            "{molecules} molecules", becomes a column for each of their values; rows that are equal in the other
            columns are then one line.

    Returns:
        Strings, without columns in which nothing is known.

    Raises:
        ValueError: the rows have no column of a name in `columns`; an error that they lack is not known.
    """
    for field in _fields(columns):
        if len(rows) and field not in rows and not field.endswith("_error"):
            raise ValueError(f"there is no column {field!r}; there are {', '.join(rows)}")
    result = pd.DataFrame(
        [{cell(heading, row): cell(form, row) for heading, form in columns.items()} for row in rows.to_dict("records")],
        columns=None if len(rows) else list(columns),
    )
    lines = [heading for heading in columns if "{" not in heading]
    if len(rows) and len(lines) < len(columns):
        result = result.groupby(lines, sort=False).first().reset_index()
    result = result.fillna(UNKNOWN)
    return result.loc[:, ~result.isin(["", UNKNOWN]).all()]


def _fields(columns: Mapping[str, str]) -> Iterator[str]:
    """Yield the names of values in headings and cells."""
    for form in itertools.chain.from_iterable(columns.items()):
        for _, field, _, _ in Formatter().parse(form):
            if field:
                yield field.removesuffix("_text")


class _Known(dict[str, Any]):
    """A row in which `NAME_text` is a value with its error, and whatever else it does not have is not a number."""

    def __missing__(self, name: str) -> Any:
        of = name.removesuffix("_text")
        if of == name or of not in self:
            return math.nan
        value = self[of]
        if f"{of}_error" in self:
            return str(Estimate(value, self[f"{of}_error"]))
        if not isinstance(value, float):
            return str(value)
        return f"{value:.0f}" if value.is_integer() or abs(value) >= 1000 else f"{value:.3g}"


def cell(form: str, row: Mapping[str, Any]) -> str:
    """Return the text of a cell.

    Args:
        form: such as "{rotation:.1f} ± {rotation_error:.1f}", or "{rotation_text}" for a value with its error as far as
            that is known.
        row: the numbers. What is not known, or not there, makes the cell `UNKNOWN`; an error that is not known is left
            out.
    """
    filled = form.format_map(_Known(row)).replace(" ± nan", "").replace("±nan", "")
    return UNKNOWN if re.search(r"\bnan\b", filled) else filled


def markdown(table: pd.DataFrame) -> str:
    """Return a table of text as a page has it."""
    lines = [list(table.columns), ["---"] * len(table.columns), *table.to_numpy().tolist()]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
