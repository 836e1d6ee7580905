"""What the native engine's programs consist of: statements, constraints and forces, and kernels on a GPU.

    python -m studies.native.program [--schemes sier2 sier4g sier2p3]

counts, for one step of each scheme without and with fast forces in its drifts: native steps, statements for each degree
of freedom, which OpenMM interprets on the CPU and Reference platforms, solutions of the constraints for positions and
for velocities, forces, and fast forces alone. Nothing is run. Kernels are those that OpenMM's GPU platforms launch for
the statements, by the rule of `CommonIntegrateCustomStepKernel::prepareForComputation`; constraints and forces have
their own. Writes native-program.json.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.engines.native.installation import OWN
from openmm_sier.engines.native.program import CONSTRAIN_V, CONSTRAIN_X, Program, Statement, write
from studies import text
from studies.command import Settings, chosen, command
from studies.records import Record
from studies.report import SILENT, Report

#: The force that a statement uses; the number is that of a group, and is missing for the sum of all groups.
FORCE = re.compile(r"\bf(\d*)/m")

#: The force group that is fast in programs that have one.
FAST = 1

COLUMNS = text.columns(
    *("scheme", "fast", "native_steps", "statements", "constrain_x", "constrain_v"),
    *("forces", "fast_alone", "kernels", "kernels_per_force"),
)


@dataclass(frozen=True)
class ProgramSettings(Settings):
    """What is counted.

    Attributes:
        schemes: by name.
    """

    schemes: tuple[str, ...] = ("sier2", "sier2p3", "sier4g")


def group(statement: Statement) -> str | None:
    """The force group that a statement uses, "" for the sum of all, None if it uses no force."""
    found = FORCE.search(statement.expression)
    return found and found[1]


def kernels(parts: Sequence[Sequence[Statement]]) -> int:
    """Kernels that GPU platforms launch for the statements of native steps.

    Consecutive statements are one kernel, unless the first of two moves the atoms, or their force groups differ. A
    statement without a force counts to the group of the next one that has one, or else to the sum of all.
    """
    following = [""]
    for statement in reversed([statement for part in parts for statement in part]):
        own = group(statement)
        following.append(following[-1] if own is None else own)
    groups, count = reversed(following), 0
    for part in parts:
        before: str | None = None
        for statement in part:
            mine = next(groups)
            is_own = statement.target in OWN
            count += not is_own and mine != before
            before = None if is_own or statement.moves else mine
    return count


def forces(parts: Sequence[Sequence[Statement]]) -> tuple[int, int]:
    """Evaluations of all forces and of single groups in a step that follows another one.

    OpenMM remembers the forces of every group until atoms move, but from one native step to the next only those that
    were computed last.
    """
    last: str | None = None
    for _ in range(2):
        counts = [0, 0]
        for part in parts:
            known = {last}
            for statement in part:
                own = group(statement)
                if own is not None and own not in known:
                    known.add(own)
                    last = own
                    counts[own != ""] += 1
                if statement.moves:
                    known, last = set(), None
    return counts[0], counts[1]


def count(program: Program) -> dict[str, Any]:
    """The row of a program."""
    parts = [[statement for line in part for statement, _ in line.executed()] for part in program.parts]
    targets = [statement.target for part in parts for statement in part]
    whole, alone = forces(parts)
    found = kernels(parts)
    return {
        "scheme": program.name,
        "native_steps": len(parts),
        "statements": sum(target not in OWN for target in targets),
        "constrain_x": targets.count(CONSTRAIN_X),
        "constrain_v": targets.count(CONSTRAIN_V),
        "forces": whole,
        "fast_alone": alone,
        "kernels": found,
        "kernels_per_force": found / whole,
    }


def study(settings: ProgramSettings, report: Report = SILENT) -> Record:
    """Count, and write native-program.json."""
    schemes = chosen(settings.schemes, CATALOGUE, "scheme")
    rows = [
        count(write(scheme, fast_groups=fast)) | {"fast": "in inner steps" if fast else "none"}
        for fast in ((), (FAST,))
        for scheme in schemes
    ]
    found = pd.DataFrame(rows)
    report.table("One step", text.table(found, COLUMNS))
    return Record(settings.recorded(), {"rows": found}, {}).write(settings.out / "native-program.json")


main = command(ProgramSettings, study, __doc__, __name__)
