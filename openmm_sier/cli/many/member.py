"""The process of one of many runs: `openmm-sier`, which ends with the process that started it.

`python -m openmm_sier.cli.many.member run …` executes a command line. Its standard input is a pipe from the process
that started it. When that process closes the pipe or is killed, this one ends as by SIGTERM: it completes a step and
its files.
"""

import os
import signal
import sys
import threading
import time
from pathlib import Path

from openmm_sier.cli.errors import RunError
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.main import main

#: Seconds for an earlier process of the same member, whose starter was killed, to complete its step and its files.
PATIENCE = 60.0


def _end_with_the_starter() -> None:
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def _wait_for_the_last(out: Path) -> None:
    """Wait until no process writes the checkpoint of a run, at most `PATIENCE`; then the run reports the lock."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        try:
            with FileLocks() as locks:
                locks.hold([out.with_suffix(".chk")])
            return
        except RunError:
            time.sleep(0.2)


if __name__ == "__main__":
    line = sys.argv[1:]
    threading.Thread(target=_end_with_the_starter, daemon=True).start()
    _wait_for_the_last(Path(line[line.index("--out") + 1]))
    sys.exit(main(line))
