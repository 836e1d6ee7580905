"""Command lines of README, the guide and the notebooks are accepted as they stand."""

import json
import re
import shlex
from pathlib import Path

from openmm_sier.cli.command_line import parse
from openmm_sier.cli.errors import Misused

ROOT = Path(__file__).parents[2]

PAGES = (
    *(ROOT / "README.md", ROOT / "systems/README.md", *sorted((ROOT / "docs").rglob("*.md"))),
    *sorted((ROOT / "docs").rglob("*.ipynb")),
)

#: A command up to the end of its line, of the code in a sentence, or of its part of a line of the shell. A page may
#: leave out what stands for anything.
COMMAND = re.compile(r"openmm-sier ((?:setup|run|tune|info|summary)\b[^`|;&\n]*)")


def command_lines(page):
    text = page.read_text()
    if page.suffix == ".ipynb":
        text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    text = text.replace("\\\n", " ")
    lines = [match.split("  ")[0] if "…" in match else match for match in COMMAND.findall(text)]
    return [line.replace("…", "").strip() for line in lines if len(line.split()) > 1]


LINES = sorted({line for page in PAGES for line in command_lines(page)})


def refusal(line):
    """Return the message of the command about a line, or None. A loop of the shell fills its variables in."""
    try:
        parse(["1" if word.startswith(("$", "{")) else word for word in shlex.split(line)])
    except Misused as error:
        return str(error)
    return None


def test_command_lines_of_pages():
    assert len(LINES) > 25
    assert {line: message for line in LINES if (message := refusal(line))} == {}
