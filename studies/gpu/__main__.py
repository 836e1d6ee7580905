"""Speeds, averages and energies on a GPU, as a command."""

from __future__ import annotations

from studies import gpu
from studies.command import command
from studies.gpu.study import GpuSettings, study

main = command(GpuSettings, study, gpu.__doc__, __name__)
