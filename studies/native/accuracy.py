"""The native engine compared with the exact one: rms(H)/rms(V) of liquids by scheme, platform and substeps.

    python -m studies.native.accuracy [BOX.pdb] [--time 0.3] [--schemes sier4g ...] [--substeps 2 3 5] [--fs 1 2]
        [--on CPU OpenCL:double OpenCL:mixed]

has a line for each run: the exact engine's on the CPU first, then the native engine's with the ratio of both. All runs
of a box start from one phase point. The step is `--fs` times the force evaluations of the scheme. Writes
native-accuracy.json.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import pandas as pd

from openmm_sier import RigidBodies, SIERIntegrator, prepare_system
from openmm_sier.dynamics.schemes import CATALOGUE, Scheme
from openmm_sier.inputs.equilibration import make_context
from studies import boxes, text
from studies.command import BoxSettings, chosen, command
from studies.methods import of_scheme
from studies.records import Record
from studies.report import SILENT, Report
from studies.sampling import Liquid, conserved, equilibrated

#: ps before the runs.
EQUILIBRATION = 2.0

#: fs between two energies.
INTERVAL = 4.0

COLUMNS = text.columns("scheme", "engine", "platform", "substeps", "fs_per_force", "percent", "ratio", "drift")


@dataclass(frozen=True, kw_only=True)
class NativeSettings(BoxSettings):
    """What is compared.

    Attributes:
        schemes: by name; all unless given.
        substeps: of the native engine; the usual ones unless given.
        fs: simulated time per force evaluation.
        on: platforms of the native engine, and after a colon their precision.
        exact_on: platform of the exact engine.
        time: of each run, ps.
    """

    schemes: tuple[str, ...] = ()
    substeps: tuple[int, ...] = ()
    fs: tuple[float, ...] = (1.0, 2.0)
    on: tuple[str, ...] = ("CPU",)
    exact_on: str = "CPU"
    time: float = 0.3
    seed: int = 7


def start(settings: NativeSettings) -> Liquid:
    """A box, equilibrated; hydrogens of solutes are constrained."""
    box = boxes.read(settings, "hbonds")
    prepare_system(box.system)
    context = make_context(box.system, SIERIntegrator(0.001, "SIER2"), "CPU")
    state = equilibrated(context, box.positions, settings.temperature, settings.seed, EQUILIBRATION)
    return Liquid(box.system, RigidBodies.from_system(box.system, box.topology), state)


def compare(begun: Liquid, scheme: Scheme, settings: NativeSettings, report: Report) -> list[dict[str, Any]]:
    """Rows of one scheme."""
    cases: list[tuple[str, str, int | None]] = [("exact", settings.exact_on, None)]
    cases += [("native", place, k) for place in settings.on for k in settings.substeps or (None,)]
    exact: dict[float, float] = {}
    rows: list[dict[str, Any]] = []
    for (engine, place, k), fs in product(cases, settings.fs):
        method = of_scheme(scheme, engine=engine, substeps=k)
        result, _ = conserved(replace(begun, platform=place), method, fs, settings.time, INTERVAL)
        row = {"scheme": scheme.name, "fs_per_force": fs, "engine": engine, "platform": place, "substeps": k or ""}
        rows.append(row | {"ratio": result["percent"] / exact.setdefault(fs, result["percent"])} | result)
        report.note(text.cell("{scheme} at {fs_per_force:g} fs, {engine} on {platform}: {percent:.5f} %", rows[-1]))
    return rows


def study(settings: NativeSettings, report: Report = SILENT) -> Record:
    """Compare the engines, and write native-accuracy.json."""
    schemes = chosen(settings.schemes, CATALOGUE, "scheme")
    begun = start(settings)
    rows = pd.DataFrame([row for scheme in schemes for row in compare(begun, scheme, settings, report)])
    title = f"{settings.box.stem}, {settings.time:g} ps"
    report.table(title, text.table(rows, COLUMNS))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "native-accuracy.json")


main = command(NativeSettings, study, __doc__, __name__)
