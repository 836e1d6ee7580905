"""Rigid domains as a command."""

from __future__ import annotations

from studies.command import command
from studies.domains import study

main = command(study.DomainSettings, study.study, study.__doc__, __name__)
