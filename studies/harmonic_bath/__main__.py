"""Errors of long steps around a solute by their causes, as a command."""

from __future__ import annotations

from studies.command import command
from studies.harmonic_bath import study

main = command(study.HarmonicSettings, study.study, study.__doc__, __name__)
