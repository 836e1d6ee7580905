"""Tables, figures and numbers of pages, made of the records in `studies/data` when the site is built.

    ```{record} schemes.json rows
    :where: liquid == "tip3p-512"
    :across: method
    fs per force: {fs_per_force:g}
    rms(H)/rms(V), %: {percent:.2f} ± {percent_error:.2f}
    ```

is a table of some rows of a file, with the command that made the file under it: a line of the text for each column, its
heading and what stands in its cells. `:columns: whole_run.GAINS` takes the columns of a study in place of them, but for
those that `:without:` has, between strokes; `:made-by: paper.dipole.tables 0` takes a table that a study makes of the
whole record. `:across:` spreads the last column over the values of another one, and `:sort:` names columns that give
the order. `{drawn}` is a figure of `studies.figures`, whose text is what it shows; `{studies}` lists the studies. In a
sentence {value}`whole-run.json gains | liquid == "OPC" and time == 100 | {gain:.0f}` is a number. `studies.pages` does
the work.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective, SphinxRole

from studies import figures, pages, records
from studies.command import chosen
from studies.report import Table
from studies.sources import COMMANDS, DATA

#: Where figures are drawn, from the folder of the pages.
DRAWN = "_figures"


def table_node(made: Table, literal: int = 0) -> nodes.table:
    """A table; the first `literal` cells of a row are shown as code."""
    group = nodes.tgroup("", *(nodes.colspec(colwidth=1) for _ in made.columns), cols=len(made.columns))
    for part, rows in ((nodes.thead(), [made.columns]), (nodes.tbody(), made.rows)):
        for row in rows:
            cells = [nodes.Text(cell) for cell in row]
            if isinstance(part, nodes.tbody):
                cells[:literal] = [nodes.literal(text=cell) for cell in row[:literal]]
            part += nodes.row("", *(nodes.entry("", nodes.paragraph("", "", cell)) for cell in cells))
        group += part
    return nodes.table("", group, classes=["colwidths-auto"])


def source_node(file: str) -> nodes.paragraph:
    """The file of the numbers and the commands that made it."""
    parts: list[nodes.Node] = [nodes.literal(text=f"studies/data/{file}"), nodes.Text(": ")]
    for i, command in enumerate(COMMANDS[file]):
        parts += [nodes.Text(", then " if i else ""), nodes.literal(text=command)]
    return nodes.paragraph("", "", *parts, classes=["source"])


@cache
def draw(name: str, path: Path) -> None:
    """Draw a figure, once for all pages of a build that show it."""
    path.parent.mkdir(exist_ok=True)
    figures.FIGURES[name].figure(records.read(DATA / figures.FIGURES[name].data), path)


class FromRecords(SphinxDirective):
    """What is made of a record; what is wrong with it is told at its line of the page."""

    has_content = True
    required_arguments = 1
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        try:
            return self.made()
        except Exception as error:  # pandas has many for a wrong query
            raise self.error(f"{' '.join(self.arguments)}: {error}") from error

    def made(self) -> list[nodes.Node]:
        raise NotImplementedError

    def depends_on(self, file: str) -> None:
        """The page is made again where the file has changed."""
        self.env.note_dependency(str(DATA / file))


class RecordTable(FromRecords):
    """A table."""

    option_spec = dict.fromkeys(("where", "sort", "columns", "without", "made-by", "across"), directives.unchanged)

    def made(self) -> list[nodes.Node]:
        file, option = self.arguments[0], self.options.get
        self.depends_on(file)
        if made_by := option("made-by"):
            made = pages.made_by(made_by, file)
        else:
            rows = pages.chosen(" ".join(self.arguments), option("where", ""), option("sort", ""))
            columns = dict(line.split(": ", 1) for line in self.content if line.strip())
            if name := option("columns"):
                columns = pages.columns_of(name, [each.strip() for each in option("without", "").split("|")])
            made = pages.table(rows, columns, option("across", ""))
        return [table_node(made), source_node(file)]


class Drawn(FromRecords):
    """A figure."""

    optional_arguments = 0

    def made(self) -> list[nodes.Node]:
        name = self.arguments[0]
        (figure,) = chosen((name,), figures.FIGURES, "figure")
        self.depends_on(figure.data)
        path = Path(self.env.srcdir, DRAWN, f"{name}.png")
        draw(name, path)
        image = nodes.image(uri=f"/{DRAWN}/{path.name}", alt=" ".join(self.content))
        return [nodes.paragraph("", "", image), source_node(figure.data)]


class Studies(SphinxDirective):
    """The list of the studies."""

    def run(self) -> list[nodes.Node]:
        return [table_node(pages.studies(), literal=1)]


class Value(SphinxRole):
    """A number."""

    def run(self) -> tuple[list[nodes.Node], list[nodes.system_message]]:
        self.env.note_dependency(str(DATA / self.text.split()[0]))
        try:
            return [nodes.Text(pages.value(self.text))], []
        except Exception as error:
            message = self.inliner.reporter.error(f"{self.text}: {error}", line=self.lineno)
            return [self.inliner.problematic(self.rawtext, self.rawtext, message)], [message]


def setup(app: Sphinx) -> dict[str, Any]:
    kinds: dict[str, Callable[..., Any]] = {"record": RecordTable, "drawn": Drawn, "studies": Studies}
    for name, kind in kinds.items():
        app.add_directive(name, kind)
    app.add_role("value", Value())
    return {"parallel_read_safe": False, "version": "1"}
