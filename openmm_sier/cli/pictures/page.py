"""A page in HTML of one run or of several, in one file: means, picture, settings, warnings and versions."""

import html
import platform
from collections.abc import Sequence

import openmm

from openmm_sier.cli.findings import verdict, warnings_of
from openmm_sier.cli.logged_runs import Runs
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.version import __version__

STYLE = """
body { font: 16px/1.45 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; } td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
tr { border-bottom: 1px solid #ddd; } .warning { font-weight: bold; } svg { width: 100%; height: auto; }
"""


def page_of(runs: Runs, picture: str) -> str:
    """Return an HTML page of runs: title, warnings, means, picture and settings.

    Args:
        runs: of one kind.
        picture: in SVG.
    """
    body = [f"<h1>{_text(runs.title)}</h1>"]
    body += [f"<p class=warning>{_text(text)}</p>" for text in warnings_of(runs)]
    body += ["<h2>Means</h2>", f"<p>{_text(verdict(runs))}</p>", _means(runs)]
    # The lines before it are for separate SVG files.
    body += ["<h2>Course</h2>", picture[picture.index("<svg") :]]
    if runs.first.plan is not None:
        noted = runs.first.plan.noted(runs.first.path)
        more = "" if len(runs.runs) == 1 else f" of {runs.first.path.name}"
        body += [f"<h2>Settings{more}</h2>", _table([(name, _value(value)) for name, value in noted.items()])]
    versions = [
        ("openmm_sier", __version__),
        ("OpenMM", openmm.Platform.getOpenMMVersion()),
        ("Python", platform.python_version()),
    ]
    body += ["<h2>Versions, where this page was made</h2>", _table(versions)]
    generator = f'<meta name="generator" content="{PROGRAM}">'
    head = f'<meta charset="utf-8">{generator}<title>{_text(runs.title)}</title><style>{STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>\n' + "\n".join(body) + "\n</body></html>\n"


def _means(runs: Runs) -> str:
    if len(runs.runs) == 1:
        return _table([(over_all.name, str(over_all)) for over_all, _ in runs.means()])
    heading = ("", "mean over runs", *(run.path.stem for run in runs.runs))
    return _table([heading, *((over_all.name, str(over_all), *map(str, by_run)) for over_all, by_run in runs.means())])


def _value(value: object) -> str:
    if value is None:
        return "-"
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = ("".join(f"<td>{_text(cell)}</td>" for cell in row) for row in rows)
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def _text(text: str) -> str:
    return html.escape(text)
