"""Studies that were made once: their records stay on the pages, and their code is in an earlier commit.

git worktree add ../earlier eadf5c0f && cd ../earlier && python -m studies.native.cost
"""

from __future__ import annotations

import re

#: The commit of the repository that has them.
COMMIT = "eadf5c0f"

#: What each shows.
ARCHIVED = {
    "studies.defaults": "Energy error of SIER4G and Verlet by settings of the System.",
    "studies.equipartition": "Temperatures of rotations and translations by integrator and step.",
    "studies.hmc.exactness": "Exactness of hybrid Monte Carlo for models with known averages; `tests/laws` has them.",
    "studies.hmc.mixture": "The bias of long steps in a mixture, by configurational temperatures.",
    "studies.hmc.solvated": "Acceptance of trials of solvated molecules by scheme, step and size.",
    "studies.native.accuracy": "The native engine compared with the exact one: energy errors by scheme and platform.",
    "studies.native.cost": "Cost of a step by the native engine over that by the exact one.",
    "studies.schemes": "Energy conservation of the schemes for a given number of forces.",
    "studies.step_study": "Properties of a liquid against the step, from runs of `openmm-sier run`.",
}


def is_archived(command: str) -> bool:
    """Return whether a command is that of an archived study."""
    found = re.search(r"-m (studies[\w.]*)", command)
    return found is not None and found[1] in ARCHIVED
