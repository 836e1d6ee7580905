"""The benchmark as a command."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from studies import bench
from studies.command import execute


def main(arguments: Sequence[str] | None = None) -> int:
    return execute(bench.BenchSettings, bench.study, bench.__doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
