"""Frequencies of vibrations at constant energy, by integrator and step: stretches of C=O, and librations of water.

    python -m studies.vibrations                         N-methylacetamide in water, 2 starts of 3 ps
    python -m studies.vibrations --starts 1 --time 2.1   the same, shorter

A leapfrog moves a harmonic vibration of angular frequency ω with (2/h) arcsin(ωh/2), so that lines of a spectrum are
too high. All methods run on the prepared System from the same starts, with unchanged masses. A frequency is the mean of
a band of the power spectrum: of lengths of C=O, and of the velocities at which the water's axes turn. Each run is kept
in vibrations.jsonl as soon as it is done, and is not repeated. Writes vibrations.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import openmm
import pandas as pd
from openmm import app

from openmm_sier import prepare_system
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.observe import openmm_integrators
from studies import boxes, frame
from studies.command import SYSTEMS, RunsSettings, command
from studies.experiment import Experiment, Made
from studies.methods import CONSTANT_ENERGY
from studies.records import Task
from studies.units import md

#: fs between two samples, a multiple of all steps: 5 in the period of a C=O.
INTERVAL = 4.0

#: Samples in a window of the spectra, which overlap by half.
WINDOW = 512

#: cm/fs.
LIGHT = 2.99792458e-5

#: Bands in 1/cm whose mean is the frequency.
BANDS = {"carbonyl": (1550.0, 1900.0), "libration": (250.0, 1100.0)}

#: Methods by name, each with its steps in fs. The first is what the others are compared with; a shorter one checks it.
STEPS = (("verlet", 1.0), ("sier4g", 4.0), ("verlet", 2.0), ("verlet", 0.5))

COLUMNS = {
    "method": "{method}",
    "step/fs": "{step:.3g}",
    "starts": "{starts}",
    "C=O, 1/cm": "{carbonyl_text}",
    "off": "{carbonyl_off:+.1f} ± {carbonyl_off_error:.1f}",
    "expected": "{carbonyl_expected:+.1f}",
    "librations, 1/cm": "{libration_text}",
    "off ": "{libration_off:+.1f} ± {libration_off_error:.1f}",
    "expected ": "{libration_expected:+.1f}",
    "rms(H)/rms(V)/%": "{percent:.3g} ± {percent_error:.1g}",
    "processor time of a ps/s": "{seconds:.2f} ± {seconds_error:.1g}",
}


@dataclass(frozen=True, kw_only=True)
class VibrationSettings(RunsSettings):
    """Settings of the comparison; the seeds of the starts follow `seed`.

    Attributes:
        box: PDB file that names its force field.
        starts: equilibrated phase points, from which all methods start.
        time: of each run, ps.
        equilibrate: before them, ps.
        temperature: K.
        tolerance: OpenMM's ewaldErrorTolerance.
        platform: of OpenMM.
    """

    box: Path = field(default=SYSTEMS / "mixture.pdb", kw_only=False)
    starts: int = 2
    time: float = 3.1
    equilibrate: float = 5.0
    temperature: float = 297.0
    tolerance: float = 1e-4
    platform: str = "CPU"

    SHARED: ClassVar[tuple[str, ...]] = ("box", "time", "equilibrate", "temperature", "tolerance", "platform")


def tasks(settings: VibrationSettings) -> Iterator[Task]:
    """Yield all runs that the settings ask for, seed by seed."""
    for seed, (name, step) in product(range(settings.seed, settings.seed + settings.starts), STEPS):
        point = {"method": CONSTANT_ENERGY[name].name, "step": round(step, 6), "seed": seed}
        yield Task(settings, point, name)


class OfVibrations:
    """Observes energies, and keeps lengths of C=O in nm and vectors between atoms of water in nm."""

    def __init__(self, topology: app.Topology):
        self._carbonyls = np.array(list(_carbonyls(topology)))
        self._waters = np.array(list(_waters(topology)))
        self.lengths: list[np.ndarray] = []
        self.axes: list[np.ndarray] = []

    def __call__(self, context: openmm.Context) -> dict[str, float]:
        positions = md(context.getState(positions=True).getPositions(asNumpy=True))
        carbons, oxygens = positions[self._carbonyls.T]
        self.lengths.append(np.linalg.norm(carbons - oxygens, axis=1))
        oxygen, first, second = positions[self._waters.T]
        self.axes.append(np.concatenate([first - oxygen, second - oxygen]).ravel())
        return frame.energies(context)


def _carbonyls(topology: app.Topology) -> Iterator[tuple[int, int]]:
    for bond in topology.bonds():
        names = {atom.name: atom.index for atom in bond}
        if set(names) == {"C", "O"}:
            yield names["C"], names["O"]


def _waters(topology: app.Topology) -> Iterator[tuple[int, int, int]]:
    for residue in topology.residues():
        if residue.name in boxes.WATERS:
            atoms = {atom.name: atom.index for atom in residue.atoms()}
            yield atoms["O"], atoms["H1"], atoms["H2"]


def run(task: Task) -> dict[str, Any]:
    """Return the frequencies of a run in 1/cm, its energy error, and processor time."""
    settings, method = task.settings, CONSTANT_ENERGY[task.method]
    box = forcefields.read_box(settings.box, None, "hbonds")
    boxes.with_tolerance(box.system, settings.tolerance)
    prepare_system(box.system)
    kept = settings.out / f"start of {settings.box.stem}, seed {task.point['seed']}.xml"
    own = make_context(box.system, CONSTANT_ENERGY["sier4g"].make(0.003), settings.platform)
    start = frame.equilibrated(own, box.positions, settings.temperature, task.point["seed"], settings.equilibrate, kept)
    integrator = method.make(1e-3 * task.point["step"])
    integrator.setConstraintTolerance(openmm_integrators.CONSTRAINT_TOLERANCE)
    context = make_context(box.system, integrator, settings.platform)
    context.setState(start)
    observe = OfVibrations(box.topology)
    samples = frame.sampled(context, observe, task.point["step"], settings.time, INTERVAL)
    motions = {"carbonyl": np.array(observe.lengths), "libration": np.array(observe.axes)}
    found = {name: frequency(motion, BANDS[name]) for name, motion in motions.items()}
    seconds = 1e3 / samples.fs_per_processor_second
    return task.point | found | frame.conservation(samples.table) | {"seconds": seconds, "broken": ""}


def spectrum(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return wave numbers in 1/cm and the power of velocities there, mean over all columns and windows.

    Args:
        motion: (samples, columns).
    """
    window = np.hanning(WINDOW)[:, None]
    starts = range(0, len(motion) - WINDOW + 1, WINDOW // 2)
    parts = [motion[start : start + WINDOW] - motion[start : start + WINDOW].mean(axis=0) for start in starts]
    power = np.mean([(np.abs(np.fft.rfft(window * part, axis=0)) ** 2).mean(axis=1) for part in parts], axis=0)
    numbers = np.fft.rfftfreq(WINDOW, INTERVAL) / LIGHT
    return numbers, numbers**2 * power


def frequency(motion: np.ndarray, band: tuple[float, float]) -> float:
    """Return the mean wave number of a band of the spectrum of a motion, 1/cm.

    Args:
        motion: (samples, columns).
        band: 1/cm.
    """
    numbers, power = spectrum(motion)
    inside = (band[0] <= numbers) & (numbers <= band[1])
    return float(np.average(numbers[inside], weights=power[inside]))


def leapfrog(number: float, step: float) -> float:
    """Return by how much a leapfrog moves a harmonic vibration too fast, 1/cm.

    Args:
        number: wave number of the vibration, 1/cm.
        step: fs.
    """
    half = math.pi * LIGHT * number * step
    return number * (math.asin(half) / half - 1)


def made(settings: VibrationSettings, runs: pd.DataFrame) -> Made:
    """Return a row for each method and step: means over the starts, and how far they are from exact frequencies.

    These are those of the first of `STEPS` from the same start, less what a leapfrog of this step adds.
    """
    name, step = STEPS[0]
    leapfrogs = CONSTANT_ENERGY[name].name
    reference = runs[(runs["method"] == leapfrogs) & (runs["step"] == step)].set_index("seed")
    for band in BANDS:
        exact = reference[band] - reference[band].map(lambda number: leapfrog(number, step))
        runs = runs.assign(**{f"{band}_off": runs[band] - exact.reindex(runs["seed"]).to_numpy()})
    names = [*BANDS, *(f"{band}_off" for band in BANDS), "percent", "seconds"]
    rows = []
    for (method, step), group in runs.groupby(["method", "step"]):
        row = {"method": method, "step": step} | frame.over_starts(group, names)
        if method == leapfrogs:
            row |= {f"{band}_expected": leapfrog(reference[band].mean(), step) for band in BANDS}
        rows.append(row)
    return {"rows": pd.DataFrame(rows), "runs": runs}, {}


study = Experiment(
    "vibrations",
    tasks,
    run,
    "{method}, {step:.3g} fs, seed {seed}: C=O {carbonyl:.1f} 1/cm, librations {libration:.1f}",
    made,
    (("rows", "Frequencies at constant energy", COLUMNS),),
)

main = command(VibrationSettings, study, __doc__, __name__)
