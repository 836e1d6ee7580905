"""Bias of averages in a heat bath, as a command."""

from __future__ import annotations

from studies.bath_bias import study
from studies.command import command

main = command(study.BiasSettings, study.study, study.__doc__, __name__)
