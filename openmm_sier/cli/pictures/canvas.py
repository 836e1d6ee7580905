"""Picture files: their formats, checks before one is drawn, and their common style."""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from openmm_sier.cli.errors import Misused
from openmm_sier.cli.files import records
from openmm_sier.cli.files.places import check_place, refuse_to_replace
from openmm_sier.cli.pictures.endings import ENDINGS
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.inputs.source_files import FilePath

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Metadata that matplotlib writes, by the ending of the name: no time, so that equal logs give equal files, and the
#: program, by which an earlier picture is recognized.
FORMATS: dict[str, dict[str, Any]] = {
    ".png": {"Software": PROGRAM},
    ".svg": {"Creator": PROGRAM, "Date": None},
    ".html": {"Date": None},
}

#: Bytes near the beginning of each picture that this package has drawn, by the ending of the name.
MARKS = {
    ".png": f"Software\0{PROGRAM}".encode(),
    ".svg": f"<dc:title>{PROGRAM}</dc:title>".encode(),
    ".html": f'<meta name="generator" content="{PROGRAM}">'.encode(),
}

#: Inches.
WIDTH, HEIGHT_OF_PANEL, HEIGHT_OF_HEADINGS = 9.0, 2.6, 1.1

#: Font sizes, legible at half the size.
TITLE, PANEL_TITLE, LABEL, SMALL = 17, 14, 13, 11.5

RC: Any = {
    "font.size": LABEL,
    "axes.titlelocation": "left",
    "axes.titlesize": PANEL_TITLE,
    "axes.titleweight": "bold",
    "axes.labelsize": LABEL,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.formatter.useoffset": False,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "legend.fontsize": LABEL,
    "savefig.dpi": 160,
    "svg.hashsalt": "openmm-sier",
}


def check(path: Path, inputs: Collection[FilePath], may_replace: bool, outputs: Collection[Path] = ()) -> None:
    """Refuse a picture that cannot be drawn, or would overwrite another file.

    Args:
        path: of the picture.
        inputs, outputs: other files that the command reads and writes.
        may_replace: whether it may take the place of an earlier picture.

    Raises:
        Misused: its name has a wrong ending.
        RunError: naming the file that is in the way.
        ModuleNotFoundError: there is no matplotlib; the message says how to install it.
    """
    if path.suffix.lower() not in ENDINGS:
        raise Misused(f"the name of a picture must end in {', '.join(ENDINGS)}, got {path}")
    check_place(path, inputs, outputs)
    refuse_to_replace(path, "--plot", MARKS[path.suffix.lower()] if may_replace else b"")
    try:
        import matplotlib.figure  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "pictures need matplotlib; install it with: pip install 'openmm-sier[plot]'"
        ) from error


@contextmanager
def panels(path: Path, number: int, title: str, caption: str, page: Callable[[str], str]) -> Iterator[list[Axes]]:
    """Yield panels below each other with a common axis of time, and write them to a file afterwards.

    Args:
        path: of the picture.
        number: of panels.
        title: above all.
        caption: below all, in small letters.
        page: function that makes a page of a picture in SVG, for a file that ends in .html.

    Raises:
        OSError: the file cannot be written. An earlier one still exists.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    with mpl.rc_context(RC):
        size = WIDTH, HEIGHT_OF_PANEL * number + HEIGHT_OF_HEADINGS
        figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(h_pad=0.08, w_pad=0.08))
        figure.suptitle(title, x=0.01, ha="left", fontsize=TITLE, fontweight="bold")
        figure.supxlabel(caption, x=0.01, ha="left", fontsize=SMALL, color="0.25")
        axes = list(figure.subplots(number, 1, squeeze=False, sharex=True).flat)
        yield axes
        figure.align_ylabels(axes)
        content, suffix = io.BytesIO(), path.suffix.lower()
        is_page = suffix == ".html"
        figure.savefig(content, format="svg" if is_page else suffix[1:], metadata=FORMATS[suffix])
    data = page(content.getvalue().decode()).encode() if is_page else content.getbuffer()
    records.replace(path, memoryview(data))
