"""A member of an ensemble that counts instead of simulating: `python -m tests.support.members NUMBER`.

It prints the number of threads that OpenMM would have. Each row of its log is one number more, and it goes on with the
next one after its process was killed. Arguments that are no number are an error.
"""

import json
import os
import select
import signal
import sys
from pathlib import Path

# Those of openmm_sier.cli.pool, which would take longer to import than the member runs.
LOG, COMPLETE = "run.csv", "complete.json"

HEADING = "Time (ps),Number\n"


def count_to(last):
    log = Path(LOG)
    done = max(0, len(log.read_text().splitlines()) - 1) if log.exists() else 0
    with log.open("a", buffering=1) as file:
        if not done:
            file.write(HEADING)
        for number in range(done + 1, last + 1):
            file.write(f"{number},{number}\n")
            # Standard input is never written to: it can be read where it has ended.
            if select.select([0], [], [], 0.02)[0]:
                sys.exit(128 + signal.SIGTERM)


if __name__ == "__main__":
    if not sys.argv[1].isdigit():
        sys.exit(f"expected a number, got {sys.argv[1]}")
    print(os.environ["OPENMM_CPU_THREADS"], flush=True)
    count_to(int(sys.argv[1]))
    Path(COMPLETE).write_text(json.dumps(sys.argv[1:]))
