"""What pages of the documentation show of the records in `studies/data`: tables, single numbers, and commands.

Sphinx calls it by `docs/_extensions/records.py`; tests of claims may call it too. The commands of records are in
`studies.sources`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from string import Formatter
from typing import Any

import pandas as pd

from studies import STUDIES, records
from studies.__main__ import summary
from studies.records import Record
from studies.report import Table
from studies.sources import DATA

#: The table of a record that is taken where none is named.
USUAL = "rows"


def chosen(name: str, where: str = "", sort: str = "") -> pd.DataFrame:
    """Rows of a table.

    Args:
        name: a file of `studies/data`, and after a space one of its tables, `USUAL` unless given.
        where: which rows, as pandas' `query` takes it; all of them unless given.
        sort: columns by which they are put in order; as they are in the record unless given.

    Raises:
        ValueError: there is no such table, or no such row.
        OSError: there is no such file.
    """
    file, table, *_ = *name.split(), USUAL
    tables = records.read(DATA / file).tables
    if table not in tables:
        raise ValueError(f"{file} has no table {table!r}; it has {', '.join(tables)}")
    rows = tables[table].query(where) if where else tables[table]
    if rows.empty:
        raise ValueError(f"{file} has no {table} where {where}")
    if sort:
        rows = rows.sort_values(sort.split(), kind="stable")
    return rows.reset_index(drop=True)


def table(rows: pd.DataFrame, columns: Mapping[str, str], across: str = "") -> Table:
    """A table of rows of `chosen`, without columns in which nothing is known; see `records.table`."""
    return without_unknown(records.table("", rows, columns, across=across))


def without_unknown(made: Table) -> Table:
    """The table without columns in which all cells are empty or "-"."""
    known = [i for i in range(len(made.columns)) if any(row[i] not in ("", "-") for row in made.rows)]
    return made._replace(columns=[made.columns[i] for i in known], rows=[[row[i] for i in known] for row in made.rows])


def made_by(name: str, file: str) -> Table:
    """A table that a study makes of a record.

    Args:
        name: a function of `studies`, such as `paper.dipole.tables`, that takes the record; after it the number of
            one table, if it makes several.
        file: of `studies/data`.
    """
    function, *number = name.split()
    found = _attribute(function)(records.read(DATA / file))
    return without_unknown(found if not number else found[int(number[0])])


def columns_of(name: str, without: Sequence[str] = ()) -> dict[str, str]:
    """The columns of a study, such as `whole_run.GAINS`, but for those with some headings."""
    return {heading: form for heading, form in _attribute(name).items() if heading not in without}


def _attribute(name: str) -> Any:
    module, _, attribute = f"studies.{name}".rpartition(".")
    return getattr(import_module(module), attribute)


def value(text: str) -> str:
    """A number of a record in a sentence.

    Args:
        text: "FILE TABLE | WHERE | FORMAT", see `chosen` and `records.cell`. Where several rows are meant it has the
            least and the largest of the first number in FORMAT, with "to" between them.

    Raises:
        ValueError: it has not these three parts, or as `chosen` says.
    """
    parts = [part.strip() for part in text.split("|")]
    if len(parts) != 3:
        raise ValueError(f"expected FILE TABLE | WHERE | FORMAT, got {text!r}")
    name, where, form = parts
    rows = chosen(name, where)
    number = next(field for _, field, _, _ in Formatter().parse(form) if field)
    if number not in rows:
        raise ValueError(f"{name} has no column {number!r}; it has {', '.join(rows)}")
    if len(rows) > 1:
        rows = rows.dropna(subset=[number]).sort_values(number).iloc[[0, -1]]
    told = list(dict.fromkeys(records.cell(form, row) for row in rows.to_dict("records")))
    return " to ".join(told)


def studies(_: Record | None = None) -> Table:
    """All studies: commands, what they show, and what they take."""
    rows = [[f"python -m {module}", summary(module), cost or "-"] for module, cost in STUDIES.items()]
    return Table("", ["command", "what it shows", "what it takes"], rows, 3)
