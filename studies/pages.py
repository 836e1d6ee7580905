"""Tables, figures and numbers of records for cells of the documentation, which MyST-NB executes.

    speeds = read("gpu.json", "speeds")
    show("gpu.json", table(speeds.query("box == 'dhfr'"), {"method": "{method}", "us": "{microseconds:.0f}"}))

is a table with the command under it that made the record, and in a sentence {eval}`value(speeds, "{over:.2f}")` is a
number. Rows are chosen and put in order by pandas.
"""

from __future__ import annotations

from pathlib import Path
from string import Formatter

import pandas as pd

from studies import readme, records, trust
from studies.__main__ import modules, summary, times
from studies.archive import ARCHIVED, COMMIT
from studies.claims import TOPICS
from studies.records import DATA
from studies.text import UNKNOWN, cell, markdown, table

__all__ = ["archived", "claims", "figure", "read", "show", "studies", "table", "uses", "value"]

DOCS = Path(__file__).parents[1] / "docs"

#: Where figures are drawn, from the folder of the pages.
DRAWN = "_figures"


class Markdown(str):
    """Text that a page shows as its own."""

    def _repr_markdown_(self) -> str:
        return str(self)


def read(file: str, table: str = "rows") -> pd.DataFrame:
    """Return a table of a record.

    Raises:
        KeyError: the record has no such table.
        OSError: `studies/data` has no such file.
    """
    return records.read(DATA / file).tables[table]


def show(file: str, table: pd.DataFrame) -> Markdown:
    """Return a table of text with the file of its numbers and the commands that made it.

    Raises:
        ValueError: the table is empty.
    """
    if table.empty:
        raise ValueError(f"{file} has no rows for this table")
    return Markdown(f"{markdown(table)}\n{_source(file)}")


def figure(name: str, shows: str) -> Markdown:
    """Draw a figure of `studies.figures`, and return it with its source.

    Args:
        name: of the figure.
        shows: description for readers who do not see it.

    Raises:
        KeyError: there is no such figure.
    """
    from studies import figures

    drawn = figures.FIGURES[name]
    path = DOCS / DRAWN / f"{name}.png"
    path.parent.mkdir(exist_ok=True)
    drawn.figure(records.read(DATA / drawn.data), path)
    return Markdown(f"![{shows}](/{DRAWN}/{name}.png)\n\n{_source(drawn.data)}")


def _source(file: str) -> str:
    return f"{{.source}}\n{records.source(file)}\n"


def value(rows: pd.DataFrame, form: str) -> str:
    """Return a number in a sentence.

    Args:
        rows: of a record; of several, the least and the largest are shown, with "to" between them.
        form: see `text.cell`; its first field is the number.

    Raises:
        ValueError: there are no rows, or they have no such number.
    """
    number = next(field for _, field, _, _ in Formatter().parse(form) if field)
    if number not in rows:
        raise ValueError(f"there is no column {number!r}; there are {', '.join(rows)}")
    sorted_rows = rows.dropna(subset=[number]).sort_values(number)
    if sorted_rows.empty:
        raise ValueError(f"no row has a {number}")
    texts = [cell(form, row) for row in sorted_rows.iloc[[0, -1]].to_dict("records")]
    return " to ".join(dict.fromkeys(texts))


def studies() -> Markdown:
    """Return all studies: commands, results, and costs."""
    rows = [(f"`python -m {module}`", summary(module), times(module) or UNKNOWN) for module in modules()]
    return Markdown(markdown(pd.DataFrame(rows, columns=["command", "what it shows", "what it took"])))


def archived() -> Markdown:
    """Return the studies whose code is in an earlier commit."""
    rows = [(f"`python -m {module}`", shows, COMMIT) for module, shows in ARCHIVED.items()]
    return Markdown(markdown(pd.DataFrame(rows, columns=["command", "what it showed", "commit"])))


def uses() -> Markdown:
    """Return the uses that README lists."""
    return Markdown(readme.uses())


def claims(topic: str) -> Markdown:
    """Return the claims of a topic of `studies.claims`, each with its bounds and its record."""
    return Markdown(trust.listed(TOPICS[topic]))
