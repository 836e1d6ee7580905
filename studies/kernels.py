"""The kernels engine beside the exact one: energy by precision, averages in a bath, and bodies without constraints.

    python -m studies.kernels                           all on OpenCL, which may be a CPU
    python -m studies.kernels --platform CUDA --kinds energy --starts 20

needs the package openmm-sier-kernels. Each method makes its runs from the same starts:

energy      1,000 steps at constant energy of 64 molecules of TIP3P, in double, mixed and single precision. The exact
            engine is on the Reference platform, in double precision.
bath        the same box in a bath at 9 fs, and a dipeptide in water, whose bonded forces act in inner steps. The exact
            engine is on the CPU platform.
bodies      a crystal of 32 molecules of C60 at 1 bar, 60 atoms each: as bodies by name, and as frames with the native
            engine.

What a method makes of a box is kept in kernels.jsonl as soon as it is done, and is not repeated. Writes kernels.json.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import openmm
import pandas as pd

from openmm_sier import SIER4G, RigidBodies, SIERLangevinIntegrator, with_frames
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.system import tables
from studies import boxes, frame, records
from studies.command import SYSTEMS, RunsSettings, chosen, command
from studies.domains import fullerenes
from studies.domains.models import Model
from studies.experiment import Experiment
from studies.experiment import Made as Tables
from studies.methods import HEAVY, Bath, Contestant, in_bath, of_scheme
from studies.observers import OfSolution
from studies.records import Task
from studies.units import md

#: Kinds of runs.
KINDS = ENERGY, BATH, BODIES = "energy", "bath", "bodies"

#: K, 1/ps, and bar for crystals.
AT = Bath(300.0, 5.0, 1.0)

#: OpenMM's ewaldErrorTolerance, with balanced sums.
TOLERANCE = 1e-3

#: Steps at constant energy, and fs between samples.
STEPS, EVERY_ENERGY = 1000, 12.0

#: fs between samples in a bath; step and friction of crystals, fs and 1/ps.
EVERY, CRYSTAL_STEP, CRYSTAL_FRICTION = 180.0, 20.0, 2.0

#: Time of LangevinMiddle before the first start, and from one start to the next, ps.
WARM, APART = 5.0, 1.0

#: Cut-off of crystals, and the distance from which it is switched, nm: two thirds of the time of the usual ones.
CONTACTS = 1.0, 0.85

#: In a g/cm^3.
DALTON_PER_NM3 = 602.214076

#: ps before each run of a crystal, by its own integrator.
SETTLE = 5.0

#: What is averaged of each kind.
OF_ENERGY = ("percent", "rms", "drift")
OF_BATH = ("potential", "translation", "rotation", "solute", "bonds", "angles", "torsions")
OF_BODIES = ("potential", "density", "translation", "rotation")

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
    (BODIES, "At 1 bar, kJ/mol, g/cm³ and K", NAMES | {name: f"{{{name}_text}}" for name in OF_BODIES}),
)


class Mover(NamedTuple):
    """An engine on a platform.

    Attributes:
        name: for tables.
        engine: as the argument of integrators.
        precision: on the platform of the settings; None: the host's platform.
        framed: whether frames represent bodies.
    """

    name: str
    engine: str
    precision: str | None = None
    framed: bool = False


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
    BODIES: (EXACT, MIXED, Mover("native, frames, mixed", "native", "mixed", framed=True)),
}

#: Boxes, how long their runs in a bath are, and those of each kind.
WATER, DIPEPTIDE, CRYSTAL = "tip3p-64", "dipeptide", "C60-32"
SHARES = {WATER: 1.0, DIPEPTIDE: 1 / 3, CRYSTAL: 2.0}
BOXES = {ENERGY: (WATER,), BATH: (WATER, DIPEPTIDE), BODIES: (CRYSTAL,)}


@dataclass(frozen=True, kw_only=True)
class KernelsSettings(RunsSettings):
    """What is run.

    Attributes:
        kinds: of runs, energy, bath and bodies; all unless given.
        starts: of each method.
        time: of each run of water in a bath, ps; a dipeptide in water has a third of it, and a crystal twice it.
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
    integrator = method.integrator(AT._replace(pressure=None))
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


# --- C60 ---


def bodies(settings: KernelsSettings, box: str, mover: Mover) -> dict[str, Any]:
    """Return averages of a crystal at constant pressure; each start follows the last run."""
    model = fullerenes.model(2, *CONTACTS)
    system, positions, named = _framed(model) if mover.framed else (model.rigid, model.positions, model.rigid_bodies)
    integrator = _in_crystal(mover.engine, named, settings.seed)
    context = context_of(system, integrator, mover, settings, "CPU")
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10.0, 50)
    observe, samples = _observer(model.rigid), []
    for number in range(settings.starts):
        context.setVelocitiesToTemperature(AT.temperature, settings.seed + number)
        frame.advance(integrator, round(1e3 * SETTLE / CRYSTAL_STEP))
        samples.append(frame.sampled(context, observe, CRYSTAL_STEP, settings.time * SHARES[box], EVERY).table)
    return {"method": f"SIER2, {CRYSTAL_STEP:g} fs"} | averages(samples, settings.time * SHARES[box], OF_BODIES)


def _framed(model: Model) -> tuple[openmm.System, np.ndarray, None]:
    framed = with_frames(model.rigid, model.positions, model.bodies)
    return framed.system, md(framed.positions), None


def _in_crystal(engine: str, named: RigidBodies | None, seed: int) -> SIERLangevinIntegrator:
    step, pressure = 1e-3 * CRYSTAL_STEP, AT.pressure
    integrator = SIERLangevinIntegrator(
        AT.temperature, CRYSTAL_FRICTION, step, pressure=pressure, bodies=named, engine=engine
    )
    integrator.setRandomNumberSeed(seed)
    return integrator


def _observer(system: openmm.System) -> Callable[[openmm.Context], dict[str, float]]:
    """Return an observer of the potential energy, the density and the temperatures of bodies, frames or not."""
    mass = tables.masses(system).sum()

    def observe(context: openmm.Context) -> dict[str, float]:
        state = context.getState(energy=True)
        kelvins = context.getIntegrator().computeTemperatures().in_kelvin()
        return {
            "potential": md(state.getPotentialEnergy()),
            "density": mass / md(state.getPeriodicBoxVolume()) / DALTON_PER_NM3,
            "translation": kelvins.translation,
            "rotation": kelvins.rotation,
        }

    return observe


#: Makes what is kept of the runs of a kind.
MAKE: Mapping[str, Callable[[KernelsSettings, str, Mover], dict[str, Any]]] = {
    ENERGY: energy,
    BATH: bath,
    BODIES: bodies,
}


def made(settings: KernelsSettings, runs: pd.DataFrame) -> Tables:
    """Return a table of each kind."""
    return {kind: runs[runs["kind"] == kind].dropna(axis=1, how="all") for kind in KINDS}, {}


study = Experiment("kernels", tasks, run, "{kind} of {box}: {engine}, done", made, TABLES)

main = command(KernelsSettings, study, __doc__, __name__)
