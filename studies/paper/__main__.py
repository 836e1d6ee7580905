"""The paper's experiments as a command."""

from __future__ import annotations

from studies import paper
from studies.command import command

main = command(paper.PaperSettings, paper.study, paper.__doc__, __name__)
