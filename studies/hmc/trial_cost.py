"""Measure what a trial of hybrid Monte Carlo costs beyond its forces: energies, neighbour lists, the rest.

    OPENMM_CPU_THREADS=1 python -m studies.hmc.trial_cost

Counts what the exact engine asks of OpenMM in trials, and the processor time of it: forces, energies with a force,
energies alone, and neighbour lists that are forgotten. It does so for one call of many trials, for a call for each of
them, and for a checkpoint after each, which a restart repeats bit for bit. Writes trial-cost.json.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import openmm
import pandas as pd

from openmm_sier import SIERHMCIntegrator, prepare_system
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.engines import neighbour_list
from openmm_sier.inputs.starts import make_context
from openmm_sier.system import own_methods
from studies import heat_bath, text
from studies.command import SYSTEMS, Settings, chosen, command
from studies.records import Record
from studies.report import SILENT, Report

#: Of hydrogens, dalton.
HYDROGEN = 4.0

COLUMNS = {
    "scheme": "{scheme}",
    "trials by": "{how}",
    "forces": "{forces:.1f}",
    "energies with one": "{both:.1f}",
    "energies alone": "{energies:.1f}",
    "lists forgotten": "{forgotten:.1f}",
    "ms a trial": "{trial:.1f}",
    "of it forces": "{in_forces:.1f}",
    "energies": "{in_energies:.1f}",
    "lists": "{in_forgotten:.2f}",
}


@dataclass(frozen=True)
class CostSettings(Settings):
    """Settings of the trials.

    Attributes:
        box: PDB file that names its force field.
        schemes: by name.
        trials: of each.
        length: of a trial, fs.
        temperature: K.
        tolerance: OpenMM's ewaldErrorTolerance; the sums of PME are balanced.
    """

    box: Path = SYSTEMS / "tip3p-512.pdb"
    schemes: tuple[str, ...] = ("sier2v2", "sier2p3", "sier4g")
    trials: int = 20
    length: float = 150.0
    temperature: float = 297.0
    tolerance: float = 1e-4

    FIRST = "box"


def at_once(context: openmm.Context, trials: int) -> None:
    context.getIntegrator().step(trials)


def one_by_one(context: openmm.Context, trials: int) -> None:
    for _ in range(trials):
        context.getIntegrator().step(1)


def with_checkpoints(context: openmm.Context, trials: int) -> None:
    for _ in range(trials):
        context.getIntegrator().step(1)
        context.createCheckpoint()


WAYS: dict[str, Callable[[openmm.Context, int], None]] = {
    "one call": at_once,
    "a call each": one_by_one,
    "a checkpoint after each": with_checkpoints,
}


@contextmanager
def counted() -> Iterator[tuple[Counter[str], dict[str, float]]]:
    """Count what engines ask of OpenMM, and its processor time in s."""
    counts, seconds = Counter[str](), defaultdict[str, float](float)
    ask, forget = own_methods.get_state, neighbour_list.forget

    def timed(kind: str, function: Callable, *arguments: Any, **options: Any) -> Any:
        begun = process_time()
        found = function(*arguments, **options)
        counts[kind] += 1
        seconds[kind] += process_time() - begun
        return found

    def asked(context: openmm.Context, **options: Any) -> openmm.State:
        wanted = options.get("forces", False), options.get("energy", False) and options.get("groups") != 0
        kind = {(True, False): "forces", (True, True): "both", (False, True): "energies"}.get(wanted, "others")
        return timed(kind, ask, context, **options)

    def forgotten(context: openmm.Context) -> None:
        # What it asks for itself is not counted twice.
        own_methods.get_state = ask
        try:
            timed("forgotten", forget, context)
        finally:
            own_methods.get_state = asked

    own_methods.get_state, neighbour_list.forget = asked, forgotten
    try:
        yield counts, seconds
    finally:
        own_methods.get_state, neighbour_list.forget = ask, forget


def study(settings: CostSettings, report: Report = SILENT) -> Record:
    """Make the trials, and write trial-cost.json."""
    chosen(settings.schemes, CATALOGUE, "scheme")
    rows = pd.DataFrame([row for scheme in settings.schemes for row in measure(settings, scheme)])
    report.table("What a trial costs", text.table(rows, COLUMNS))
    return Record(settings.recorded(), {"rows": rows}, {}).write(settings.out / "trial-cost.json")


def measure(settings: CostSettings, name: str) -> Iterator[dict[str, Any]]:
    """A row for each way to make trials: counts, and ms of processor time, of one trial."""
    scheme = CATALOGUE[name]
    step = scheme.heavy_trial_step or scheme.trial_step or 0.004
    box = heat_bath.read_box(settings)
    prepare_system(box.system, hydrogenMass=HYDROGEN)
    steps = round(1e-3 * settings.length / step)
    integrator = SIERHMCIntegrator(settings.temperature, step, scheme, steps, extraChances=0)
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(box.system, integrator, "CPU")
    context.setPositions(box.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 300)
    integrator.step(5)
    for how, make in WAYS.items():
        with counted() as (counts, seconds):
            begun = process_time()
            make(context, settings.trials)
            trial = process_time() - begun
        per_trial = {kind: counts[kind] / settings.trials for kind in ("forces", "both", "energies", "forgotten")}
        times = {f"in_{kind}": 1e3 * seconds[kind] / settings.trials for kind in ("forces", "energies", "forgotten")}
        times["in_forces"] += 1e3 * seconds["both"] / settings.trials
        yield {"scheme": scheme.name, "how": how, "step": 1e3 * step, "trial": 1e3 * trial / settings.trials} | (
            per_trial | times
        )


main = command(CostSettings, study, __doc__, __name__)
