"""Command lines of README, the guide and the notebooks are accepted as they stand."""

import json
import re
import shlex
from pathlib import Path

import pytest

from openmm_sier.cli.command_line import parse

ROOT = Path(__file__).parents[2]

PAGES = (
    *(ROOT / "README.md", ROOT / "systems/README.md", *sorted((ROOT / "docs").rglob("*.md"))),
    *sorted((ROOT / "docs").rglob("*.ipynb")),
)

#: A command up to the end of its line, of the code in a sentence, or of its part of a line of the shell. A page may
#: leave out what stands for anything.
COMMAND = re.compile(r"openmm-sier ((?:setup|run|tune|info|plot|summary)\b[^`|;&\n]*)")


def command_lines(page):
    text = page.read_text()
    if page.suffix == ".ipynb":
        text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    text = text.replace("\\\n", " ")
    lines = [found.split("  ")[0] if "…" in found else found for found in COMMAND.findall(text)]
    return [line.replace("…", "").strip() for line in lines if len(line.split()) > 1]


LINES = sorted({line for page in PAGES for line in command_lines(page)})


@pytest.mark.parametrize("line", LINES)
def test_command_lines_of_pages(line):
    words = shlex.split(line)
    # What a loop of the shell puts in.
    parse(["1" if word.startswith(("$", "{")) else word for word in words])


def test_there_are_such_lines():
    assert len(LINES) > 25
