"""The kernels engine beside the exact one: energy by precision, and averages in a bath.

    python -m studies.kernels                           all on OpenCL, which may be a CPU
    python -m studies.kernels --platform CUDA --kinds energy --starts 20

needs the package openmm-sier-kernels. Each method makes its runs from the same starts:

energy      1,000 steps at constant energy of 64 molecules of TIP3P, in double, mixed and single precision. The exact
            engine is on the Reference platform, in double precision.
bath        the same box in a bath at 9 fs, and a dipeptide in water, whose bonded forces act in inner steps. The exact
            engine is on the CPU platform.

What a method makes of a box is kept in kernels.jsonl as soon as it is done, and is not repeated. Writes kernels.json.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import openmm
import pandas as pd

from openmm_sier import SIER4G
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.equilibration import make_context
from studies import boxes, frame, records
from studies.command import SYSTEMS, RunsSettings, chosen, command
from studies.experiment import Experiment
from studies.experiment import Made as Tables
from studies.methods import HEAVY, Bath, Contestant, in_bath, of_scheme
from studies.observers import OfSolution
from studies.records import Task
from studies.units import md

#: Kinds of runs.
KINDS = ENERGY, BATH = "energy", "bath"

#: K and 1/ps.
AT = Bath(300.0, 5.0)

#: OpenMM's ewaldErrorTolerance, with balanced sums.
TOLERANCE = 1e-3

#: Steps at constant energy, and fs between samples.
STEPS, EVERY_ENERGY = 1000, 12.0

#: fs between samples in a bath.
EVERY = 180.0

#: Time of LangevinMiddle before the first start, and from one start to the next, ps.
WARM, APART = 5.0, 1.0

#: What is averaged of each kind.
OF_ENERGY = ("percent", "rms", "drift")
OF_BATH = ("potential", "translation", "rotation", "solute", "bonds", "angles", "torsions")

NAMES = {"box": "{box}", "engine": "{engine}"}

#: Names, titles and columns of the tables of a record.
TABLES = (
    (
        ENERGY,
        "At constant energy",
        NAMES
        | {
            "method": "{method}",
            "rms(H)/rms(V), %": "{percent_text}",
            "rms(H), kJ/mol": "{rms_text}",
            "drift, kJ/mol/ps": "{drift_text}",
        },
    ),
    (BATH, "In a bath, kJ/mol and K", NAMES | {name: f"{{{name}_text}}" for name in OF_BATH}),
)


class Mover(NamedTuple):
    """An engine on a platform.

    Attributes:
        name: for tables.
        engine: as the argument of integrators.
        precision: on the platform of the settings; None: the host's platform.
    """

    name: str
    engine: str
    precision: str | None = None


EXACT = Mover("exact", "exact")
MIXED = Mover("kernels, mixed", "kernels", "mixed")

#: What moves the boxes of each kind.
MOVERS = {
    ENERGY: (
        EXACT,
        Mover("kernels, double", "kernels", "double"),
        MIXED,
        Mover("kernels, single", "kernels", "single"),
    ),
    BATH: (EXACT, MIXED),
}

#: Boxes, how long their runs in a bath are, and those of each kind.
WATER, DIPEPTIDE = "tip3p-64", "dipeptide"
SHARES = {WATER: 1.0, DIPEPTIDE: 1 / 3}
BOXES = {ENERGY: (WATER,), BATH: (WATER, DIPEPTIDE)}


@dataclass(frozen=True, kw_only=True)
class KernelsSettings(RunsSettings):
    """What is run.

    Attributes:
        kinds: of runs, energy and bath; all unless given.
        starts: of each method.
        time: of each run of water in a bath, ps; a dipeptide in water has a third of it.
        platform: of the kernels.
    """

    kinds: tuple[str, ...] = ()
    starts: int = 6
    time: float = 27.0
    platform: str = "OpenCL"

    SHARED: ClassVar[tuple[str, ...]] = ("platform", "seed")


def tasks(settings: KernelsSettings) -> Iterator[Task]:
    """Return all runs that the settings ask for: those of a method in a box are one task, with one Context."""
    chosen(settings.kinds, dict.fromkeys(KINDS), "kind")
    for kind in settings.kinds or KINDS:
        for box in BOXES[kind]:
            for mover in MOVERS[kind]:
                yield Task(settings, {"kind": kind, "box": box, "engine": mover.name})


def run(task: Task) -> dict[str, Any]:
    """Return what is kept of the runs of a method in a box."""
    kind, box = task.point["kind"], task.point["box"]
    mover = next(each for each in MOVERS[kind] if each.name == task.point["engine"])
    return task.point | MAKE[kind](task.settings, box, mover)


def context_of(
    system: openmm.System, integrator: openmm.Integrator, mover: Mover, settings: KernelsSettings, host: str
) -> openmm.Context:
    """Return a Context where a mover is, which the platform `host` is for the exact engine."""
    if mover.precision is None:
        return make_context(system, integrator, host)
    platform = openmm.Platform.getPlatformByName(settings.platform)
    return openmm.Context(system, integrator, platform, {"Precision": mover.precision})


# --- water and a dipeptide ---


def read(box: str, method: Contestant) -> boxes.BoxSystem:
    """Return a box by its name, as a method is given it."""
    if box == WATER:
        whole = forcefields.read_box(SYSTEMS / "tip3p-512.pdb")
        found = boxes.of_size(whole, SYSTEMS, int(box.partition("-")[2]))
    else:
        whole = forcefields.read_box(SYSTEMS / f"{box}.pdb", None, "hbonds")
        found = boxes.BoxSystem(whole.topology.getNumResidues(), md(whole.positions), whole.system, box, True)
    boxes.with_tolerance(found.system, TOLERANCE)
    method.fit(found.system)
    return found


def starts(box: str, found: boxes.BoxSystem, method: Contestant, settings: KernelsSettings) -> Iterator[openmm.State]:
    """Yield the starts of all engines, which are kept in files: points of a trajectory on the CPU platform."""
    state = None
    for number in range(settings.starts):
        path = settings.out / f"start {number} of {box}, {method.name}, seed {settings.seed}.xml"
        if path.exists():
            state = openmm.XmlSerializer.deserialize(path.read_text())
        else:
            where = found.positions if state is None else state.getPositions()
            time, iterations = (WARM, 100) if state is None else (APART, 0)
            state = frame.warmed(
                found.system, where, AT.temperature, settings.seed + number, time, "CPU", iterations=iterations
            )
            records.replace_file(path, openmm.XmlSerializer.serialize(state))
        yield state


def energy(settings: KernelsSettings, box: str, mover: Mover) -> dict[str, Any]:
    """Return how well runs at constant energy conserve it."""
    method = of_scheme(SIER4G, engine=mover.engine).at(4, prepared=True)
    found, rows = read(box, method), []
    context = context_of(found.system, method.integrator(AT), mover, settings, "Reference")
    for state in starts(box, found, method, settings):
        context.setState(state)
        frame.advance(context.getIntegrator(), frame.WARM_UP)
        table = frame.sampled(context, frame.energies, method.step, 1e-3 * STEPS * method.step, EVERY_ENERGY).table
        rows.append(frame.conservation(table) | {"broken": ""})
    return {"method": method.name, "steps": STEPS} | frame.over_starts(pd.DataFrame(rows), OF_ENERGY)


def bath(settings: KernelsSettings, box: str, mover: Mover) -> dict[str, Any]:
    """Return averages at constant volume."""
    method = in_bath(engine=mover.engine).at(9, **HEAVY)
    found = read(box, method)
    integrator = method.integrator(AT)
    integrator.setRandomNumberSeed(settings.seed)
    context = context_of(found.system, integrator, mover, settings, "CPU")
    observe = OfSolution(found.system, platform="CPU")
    samples = []
    for state in starts(box, found, method, settings):
        context.setState(state)
        frame.advance(integrator, round(1e3 * APART / method.step))
        samples.append(frame.sampled(context, observe, method.step, settings.time * SHARES[box], EVERY).table)
    return {"method": method.name} | averages(samples, settings.time * SHARES[box], OF_BATH)


def averages(samples: list[pd.DataFrame], time: float, names: tuple[str, ...]) -> dict[str, Any]:
    """Return means over runs of a time in ps with errors, of the names that they have."""
    found = pd.DataFrame([frame.means(table[["time", *(set(names) & set(table))]]) for table in samples])
    return {"starts": len(samples), "time": time} | records.pooled(found, names)


#: Makes what is kept of the runs of a kind.
MAKE: Mapping[str, Callable[[KernelsSettings, str, Mover], dict[str, Any]]] = {
    ENERGY: energy,
    BATH: bath,
}


def made(settings: KernelsSettings, runs: pd.DataFrame) -> Tables:
    """Return a table of each kind."""
    return {kind: runs[runs["kind"] == kind].dropna(axis=1, how="all") for kind in KINDS}, {}


study = Experiment("kernels", tasks, run, "{kind} of {box}: {engine}, done", made, TABLES)

main = command(KernelsSettings, study, __doc__, __name__)
