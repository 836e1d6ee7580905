"""Cost of a step by the native engine over that by the exact one, on the CPU or Reference platform.

    python -m studies.native.cost [BOX.pdb] [--platform CPU] [--rounds 20]

Both take turns of 12 force evaluations in one process; ratios are those within a round, shown as their median and its
standard error. Times are processor times of the process, so other work on the machine counts little.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from time import process_time
from typing import Any

import openmm
import pandas as pd

from openmm_sier import SIERIntegrator
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.inputs.equilibration import make_context
from studies import boxes, text
from studies.command import BoxSettings, chosen, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.timing import median_and_error, turns

#: ps for each force evaluation, and force evaluations in a turn.
STEP, EVALUATIONS = 0.002, 12

VERLET = "Verlet"


@dataclass(frozen=True, kw_only=True)
class CostSettings(BoxSettings):
    """What takes turns.

    Attributes:
        rounds: how many.
        schemes: by name.
    """

    rounds: int = 20
    schemes: tuple[str, ...] = ("sier2", "sier4g", "sier4p")
    platform: str | None = "CPU"


def study(settings: CostSettings, report: Report = SILENT) -> Record:
    """Take turns, and write native-cost.json."""
    schemes = chosen(settings.schemes, CATALOGUE, "scheme")
    box = boxes.read(settings)
    integrators: dict[str, tuple[int, openmm.Integrator]] = {VERLET: (1, openmm.VerletIntegrator(STEP))}
    for scheme in schemes:
        n = scheme.force_evaluations
        for engine in ("exact", "native"):
            integrators[f"{scheme.name} {engine}"] = n, SIERIntegrator(n * STEP, scheme, engine=engine)
    contexts, actions = [], {}
    for name, (n, integrator) in integrators.items():
        context = make_context(box.system, integrator, settings.platform)
        context.setPositions(box.positions)
        context.applyConstraints(1e-6)
        context.setVelocitiesToTemperature(settings.temperature, settings.seed)
        contexts.append(context)
        actions[name] = partial(_seconds, integrator, EVALUATIONS // n)
    seconds = turns(actions, settings.rounds)
    rows: list[dict[str, Any]] = []
    for scheme in schemes:
        native = seconds[f"{scheme.name} native"]
        for what, other in (("native / exact", f"{scheme.name} exact"), ("native / Verlet", VERLET)):
            ratio, error, _ = median_and_error(native / seconds[other])
            rows.append({"scheme": scheme.name, "what": what, "ratio": ratio, "ratio_error": error})
    table = pd.DataFrame(rows)
    shown = text.table(table, text.columns("scheme", "what", "ratio"))
    report.table(f"{settings.box.stem} on {settings.platform}", shown)
    return Record(settings.recorded(), {"rows": table}, {}).write(settings.out / "native-cost.json")


def _seconds(integrator: openmm.Integrator, steps: int) -> float:
    """Make steps, and return the processor time that they take."""
    begin = process_time()
    integrator.step(steps)
    return process_time() - begin


main = command(CostSettings, study, __doc__, __name__)
