"""The benchmark as a command."""

from __future__ import annotations

from studies import bench
from studies.command import command

main = command(bench.BenchSettings, bench.study, bench.__doc__, __name__)
