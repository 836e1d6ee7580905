"""Forces as exact as needed: error and time of a force evaluation by Ewald parameter and mesh.

    python -m studies.mesh [BOX.pdb] [--platform CUDA] [--molecules 512 4096 32768]

The cut-off stays. In the box itself all pairs of an Ewald parameter and a mesh whose sizes have the factors 2, 3, 5 and
7 are tried, against a sum that is much tighter. A repeated box has the same forces in each copy, so that larger boxes
have the same reference, and for each mesh the parameter that was best at its spacing. Force evaluations of all meshes,
of OpenMM's choices by ewaldErrorTolerance and of `balance_pme` take turns. The table has, for each of these choices,
the fastest mesh whose forces are at least as exact. Set OPENMM_CPU_THREADS to 1 for a machine that does other work.
Writes mesh.json.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import openmm
import pandas as pd

from openmm_sier.dynamics.backend import threads
from openmm_sier.inputs import forcefields
from openmm_sier.inputs.starts import make_context
from openmm_sier.prepare.pme import meshed_forces
from studies import boxes, text
from studies.bench.timing import ON_PROCESSORS, interleaved, median_and_error
from studies.command import BoxSettings, command
from studies.records import Record
from studies.report import SILENT, Report
from studies.units import md

#: Prime factors for which Fourier transforms are fast.
FACTORS = (2, 3, 5, 7)

#: Of the reference: a tolerance for the direct sum at the cut-off, and mesh points per nm and per nm^-1 of the Ewald
#: parameter. Doubling the mesh changes forces by less than 1e-6 of their rms in TIP3P, single precision's floor.
TIGHT, DENSITY = 1e-7, 17.0

#: Names of the two ways in which OpenMM's tolerance becomes parameters.
_SPLITS = OPENMM, BALANCED = "OpenMM", "balanced"

COLUMNS = text.columns(
    *("molecules", "tolerance", "split", "mesh", "alpha", "error", "milliseconds"),
    *("best_mesh", "best_alpha", "best_error", "ratio"),
)


@dataclass(frozen=True)
class MeshSettings(BoxSettings):
    """Settings of the scan.

    Attributes:
        molecules: of boxes, cubes of whole numbers times those of `box`, which is cubic.
        cutoff: nm.
        tolerances: OpenMM's ewaldErrorTolerance of the choices.
        spacing: least and largest distance of mesh points that is tried, nm.
        alphas: how many Ewald parameters are tried, from that of the largest tolerance to that of 1e-6.
        meshes: most of them that a box larger than `box` tries.
        rounds: in which all take their turns.
        turn: least seconds of a turn.
    """

    molecules: tuple[int, ...] = (512, 4096, 32768)
    cutoff: float = 0.9
    tolerances: tuple[float, ...] = (5e-4, 1e-4, 1e-5)
    spacing: tuple[float, float] = (0.038, 0.15)
    alphas: int = 24
    meshes: int = 14
    rounds: int = 7
    turn: float = 0.1


class Parameters(NamedTuple):
    """Of PME: the Ewald parameter in 1/nm, and mesh points along each edge, as they are in a Context."""

    alpha: float
    mesh: int


class Forces:
    """A Context that computes forces with some parameters."""

    def __init__(self, replica: boxes.Replica, settings: MeshSettings):
        self.context = make_context(replica.system, openmm.VerletIntegrator(1e-3), settings.platform)
        self.context.setPositions(replica.positions)
        self.positions = replica.positions
        # Before the first forces OpenMM tells the mesh that was asked for, afterwards that which it took.
        self.read()
        (force,) = meshed_forces(replica.system)
        alpha, *mesh = force.getPMEParametersInContext(self.context)
        self.parameters = Parameters(float(md(alpha)), int(mesh[0]))

    def read(self) -> np.ndarray:
        """Forces (N, 3), kJ/mol/nm."""
        return md(self.context.getState(forces=True).getForces(asNumpy=True))

    def again(self, count: int) -> None:
        """Compute forces so many times, of positions that are given each time."""
        for _ in range(count):
            self.context.setPositions(self.positions)
            self.context.getState(forces=True)


def sizes(edge: float, spacing: tuple[float, float]) -> list[int]:
    """Mesh sizes without other factors than `FACTORS` whose points are within these distances of each other, nm."""
    return [n for n in range(math.ceil(edge / spacing[1]), math.floor(edge / spacing[0]) + 1) if _is_smooth(n)]


def _is_smooth(n: int) -> bool:
    for factor in FACTORS:
        while n % factor == 0:
            n //= factor
    return n == 1


def ewald_parameter(tolerance: float, cutoff: float) -> float:
    """1/nm, by the rule of OpenMM's user guide."""
    return math.sqrt(-math.log(2 * tolerance)) / cutoff


def _edge(system: openmm.System) -> float:
    """Edge of a cubic box, nm."""
    edges = [md(vector[i]) for i, vector in enumerate(system.getDefaultPeriodicBoxVectors())]
    if max(edges) - min(edges) > 1e-6:
        raise ValueError(f"the box must be cubic, its edges are {', '.join(f'{edge:g}' for edge in edges)} nm")
    return float(edges[0])


def _with(replica: boxes.Replica, settings: MeshSettings, parameters: Parameters) -> Forces:
    for force in meshed_forces(replica.system):
        force.setPMEParameters(parameters.alpha, *3 * (parameters.mesh,))
    return Forces(replica, settings)


def _by_tolerance(replica: boxes.Replica, settings: MeshSettings, tolerance: float, split: str) -> Forces:
    boxes.with_tolerance(replica.system, tolerance)
    if split == OPENMM:
        boxes.split_by_openmm(replica.system)
    return Forces(replica, settings)


def _replica(settings: MeshSettings, molecules: int) -> tuple[boxes.Replica, int]:
    """The box repeated, with the cut-off of the settings, and how often along each edge."""
    box = forcefields.read_box(settings.box, settings.forcefield)
    there = box.topology.getNumResidues()
    copies = boxes.copies_for(molecules, there)
    if len(set(copies)) > 1:
        raise ValueError(f"{molecules} molecules are no cube of copies of the {there} of the box")
    replica = boxes.repeated(box, settings.box.parent, copies)
    for force in meshed_forces(replica.system):
        force.setCutoffDistance(settings.cutoff)
        force.setSwitchingDistance(settings.cutoff * 5 / 6)
    return replica, copies[0]


def reference(replica: boxes.Replica, settings: MeshSettings) -> np.ndarray:
    """Forces (N, 3) by sums much tighter than those that are compared."""
    alpha = ewald_parameter(TIGHT, settings.cutoff)
    mesh = next(n for n in range(math.ceil(DENSITY * alpha * _edge(replica.system)), 10**6) if _is_smooth(n))
    return _with(replica, settings, Parameters(alpha, mesh)).read()


def error(forces: np.ndarray, exact: np.ndarray) -> float:
    """rms of the errors over the rms of the forces; a box of copies is compared with one of them."""
    copies = len(forces) // len(exact)
    return float(np.sqrt(((forces - np.tile(exact, (copies, 1))) ** 2).mean() / (exact**2).mean()))


def scan(replica: boxes.Replica, exact: np.ndarray, settings: MeshSettings, report: Report) -> pd.DataFrame:
    """Error of the forces for each Ewald parameter and mesh of the box itself."""
    ends = [ewald_parameter(tolerance, settings.cutoff) for tolerance in (max(settings.tolerances), 1e-6)]
    edge, rows = _edge(replica.system), []
    for mesh in sizes(edge, settings.spacing):
        for alpha in np.linspace(ends[0], ends[1], settings.alphas):
            made = _with(replica, settings, Parameters(float(alpha), mesh))
            found = {"alpha": made.parameters.alpha, "mesh": made.parameters.mesh, "spacing": edge / mesh}
            rows.append(found | {"error": error(made.read(), exact)})
        best = min(rows[-settings.alphas :], key=lambda row: row["error"])
        report.note(text.cell("mesh {mesh}: least error {error:.2g} at alpha = {alpha:.2f}/nm", best))
    return pd.DataFrame(rows)


def best_alpha(scanned: pd.DataFrame, spacing: float) -> float:
    """The Ewald parameter with the least error at a spacing of the mesh, between the two nearest that were scanned."""
    best = scanned.loc[scanned.groupby("mesh")["error"].idxmin()].sort_values("spacing")
    return float(np.interp(spacing, best["spacing"], best["alpha"]))


def timed(
    molecules: int, exact: np.ndarray, scanned: pd.DataFrame, settings: MeshSettings, report: Report
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of all meshes of a box, and of all choices by tolerance with the fastest mesh that is as exact."""
    replica, copies = _replica(settings, molecules)
    edge = _edge(replica.system)
    tried = sizes(edge, settings.spacing)
    if copies > 1:
        tried = sorted({tried[round(i)] for i in np.linspace(0, len(tried) - 1, min(settings.meshes, len(tried)))})
    made = [_with(replica, settings, Parameters(best_alpha(scanned, edge / mesh), mesh)) for mesh in tried]
    choices = [(tolerance, split) for tolerance in settings.tolerances for split in _SPLITS]
    made += [_by_tolerance(replica, settings, *choice) for choice in choices]
    errors = [error(forces.read(), exact) for forces in made]
    seconds = _seconds(made, settings)
    rows = [_row(molecules, *each) for each in zip(made, errors, seconds, strict=True)]
    compared = []
    for number, (tolerance, split) in enumerate(choices, start=len(tried)):
        row = {"tolerance": tolerance, "split": split} | rows[number]
        row |= _fastest(rows[: len(tried)], seconds, number, errors[number])
        report.note(text.cell("{molecules} molecules, {split} {tolerance:g}: fastest takes {ratio:.3f} of it", row))
        compared.append(row)
    return rows[: len(tried)], compared


def _seconds(made: Sequence[Forces], settings: MeshSettings) -> list[np.ndarray]:
    """Seconds that a force evaluation of each takes in each round."""
    begun = time.perf_counter()
    made[0].again(1)
    count = max(1, math.ceil(settings.turn / max(time.perf_counter() - begun, 1e-6)))
    on_processor = made[0].context.getPlatform().getName() in ON_PROCESSORS
    actions: dict[str, Callable[[], object]] = {str(i): partial(each.again, count) for i, each in enumerate(made)}
    found = interleaved(actions, settings.rounds, time.process_time if on_processor else time.perf_counter)
    return [each / count for each in found.values()]


def _fastest(
    meshes: Sequence[dict[str, Any]], seconds: Sequence[np.ndarray], choice: int, wanted: float
) -> dict[str, float]:
    """Which of the meshes is fastest among those with an error as small as wanted, and its time over a choice's."""
    exact_enough = [i for i, row in enumerate(meshes) if row["error"] <= wanted]
    if not exact_enough:
        return dict.fromkeys(("best_mesh", "best_alpha", "best_error", "ratio", "ratio_error"), math.nan)
    best = min(exact_enough, key=lambda i: meshes[i]["milliseconds"])
    ratio, ratio_error, _ = median_and_error(seconds[best] / seconds[choice])
    found = {f"best_{name}": meshes[best][name] for name in ("mesh", "alpha", "error")}
    return found | {"ratio": ratio, "ratio_error": ratio_error}


def _row(molecules: int, forces: Forces, its_error: float, seconds: np.ndarray) -> dict[str, Any]:
    middle, middle_error, _ = median_and_error(1e3 * seconds)
    row = {"molecules": molecules, **forces.parameters._asdict(), "error": its_error}
    return row | {"milliseconds": middle, "milliseconds_error": middle_error}


def study(settings: MeshSettings, report: Report = SILENT) -> Record:
    """Scan and time, and write mesh.json.

    Raises:
        ValueError: the box is not cubic, or a number of molecules no cube times that of the box.
    """
    box = forcefields.read_box(settings.box, settings.forcefield)
    base, _ = _replica(settings, box.topology.getNumResidues())
    exact = reference(base, settings)
    scanned = scan(base, exact, settings, report)
    meshes: list[dict[str, Any]] = []
    choices: list[dict[str, Any]] = []
    for molecules in settings.molecules:
        rows, compared = timed(molecules, exact, scanned, settings, report)
        meshes += rows
        choices += compared
    found = {"scan": scanned, "meshes": pd.DataFrame(meshes), "choices": pd.DataFrame(choices)}
    title = f"PME by tolerance, and the fastest mesh as exact, {settings.cutoff:g} nm"
    report.table(title, text.table(found["choices"], COLUMNS))
    return Record(settings.recorded(), found, {"threads": threads.count()}).write(settings.out / "mesh.json")


main = command(MeshSettings, study, __doc__, __name__)
