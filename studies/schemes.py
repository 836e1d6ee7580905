"""Energy conservation of the schemes for a given number of forces: the comparison behind `openmm-sier schemes`."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import openmm

from openmm_sier.dynamics.schemes import CATALOGUE, Scheme, alternating
from openmm_sier.dynamics.stages import DRIFT, GRADIENT_KICK, KICK, Stage
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.measure import sampling
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.observables import energy_drift, energy_error
from openmm_sier.measure.report import SILENT, Report, Table
from openmm_sier.measure.sampling import Method
from openmm_sier.measure.starts import equilibrated, make_context
from openmm_sier.system.find_bodies import RigidBodies
from openmm_sier.version import __version__
from studies import figures, style

#: Time in fs between two samples: a fifth to a half of the periods of librations in water, 35 to 80 fs.
INTERVAL = 12.0

_BLANES_MOAN = "Blanes and Moan, J. Comput. Appl. Math. 142, 313 (2002), "
_OMELYAN_2002 = "Omelyan, Mryglod and Folk, Comput. Phys. Commun. 146, 188 (2002), "
_OMELYAN_2003 = "Omelyan, Mryglod and Folk, Comput. Phys. Commun. 151, 272 (2003), "


def _gradients_outside(share: float) -> tuple[Stage, ...]:
    """The family drift, gradient kick, drift, kick, drift, gradient kick, drift of fourth order."""
    outer = 0.5 - 1 / math.sqrt(24 * share)
    bracket = (1 - math.sqrt(6 * share) * (1 - share)) / 24
    half = (Stage(DRIFT, outer), Stage(GRADIENT_KICK, share, 2 * bracket / share), Stage(DRIFT, 0.5 - outer))
    return (*half, Stage(KICK, 1 - 2 * share), *reversed(half))


#: Published schemes that the catalogue leaves out, because for any number of forces it has one that does as well or
#: better.
OTHERS = {
    "s6": alternating(
        "Blanes-Moan S6",
        DRIFT,
        KICK,
        (
            0.0792036964311957,
            0.209515106613362,
            0.353172906049774,
            -0.143851773179818,
            -0.0420650803577195,
            0.434336666566456,
        ),
        _BLANES_MOAN + "S6",
    ),
    "srkn6b": alternating(
        "Blanes-Moan SRKN6b",
        KICK,
        DRIFT,
        (
            0.0829844064174052,
            0.245298957184271,
            0.396309801498368,
            0.60487266571108,
            -0.0390563049223486,
            -0.350171622895351,
        ),
        _BLANES_MOAN + "SRKN6b",
    ),
    "pefrl": alternating(
        "PEFRL",
        DRIFT,
        KICK,
        (0.1786178958448091, 0.7123418310626054, -0.06626458266981849, -0.2123418310626054),
        _OMELYAN_2002 + "position extended Forest-Ruth-like",
    ),
    "omf3gg": Scheme("OMF, 3 forces and 2 gradients", _gradients_outside(0.3152315246820299), _OMELYAN_2003 + "Eq. 43"),
}


@dataclass(frozen=True)
class SchemesSettings:
    """Settings of the comparison. Times in ps; `dt`, the simulated time per force evaluation, in fs."""

    box: Path
    forcefield: list[str] | None = None
    dt: tuple[float, ...] = (1.0, 1.5, 2.0, 2.5)
    schemes: tuple[str, ...] | None = None
    time: float = 4.0
    equilibrate: float = 4.0
    temperature: float = 297.0
    seed: int = 1
    platform: str | None = None


@dataclass(frozen=True)
class Row:
    """One scheme at one step.

    Attributes:
        scheme: name.
        order: of the scheme.
        force_evaluations: per step.
        step: fs.
        fs_per_force: step over its number of force evaluations.
        time: length of the run, ps.
        error: rms(H)/rms(V), see `openmm_sier.measure.observables.energy_error`.
        drift: of the energy of the whole box, with its standard error, kJ/mol/ps.
        broken: why the run ended early; error and drift are NaN then.
    """

    scheme: str
    order: int
    force_evaluations: int
    step: float
    fs_per_force: float
    time: float
    error: float
    drift: tuple[float, float]
    broken: str = ""

    @property
    def forces_per_ps(self) -> float:
        return 1000 / self.fs_per_force


def known() -> dict[str, tuple[Method, int]]:
    """Method and order of everything that the comparison can measure, by the name that the user gives."""
    methods = {"verlet": (sampling.nve_methods()["verlet"], 2)}
    for name, scheme in {**CATALOGUE, **OTHERS}.items():
        method = Method(scheme.name, scheme.force_evaluations, partial(SIERIntegrator, scheme=scheme))
        methods[name] = (method, scheme.order)
    return methods


def compare(settings: SchemesSettings, report: Report = SILENT) -> list[Row]:
    """Run every scheme at every time per force evaluation from one equilibrated start.

    Raises:
        ValueError: a scheme is unknown.
    """
    chosen = _chosen(settings)
    box = read_box(settings.box, settings.forcefield)
    bodies = RigidBodies.from_system(box.system, box.topology)
    start = equilibrated(box, settings.temperature, settings.seed, settings.equilibrate, settings.platform, report)
    rows = []
    for dt in settings.dt:
        for method, order in chosen:
            rows.append(_run_method(method, order, dt, box.system, bodies, start, settings, report))
            report.note(_line(rows[-1]))
    return rows


def _chosen(settings: SchemesSettings) -> list[tuple[Method, int]]:
    methods = known()
    for name in settings.schemes or ():
        if name not in methods:
            raise ValueError(f"unknown scheme {name!r}; known are {', '.join(methods)}")
    return [methods[name] for name in settings.schemes or methods]


def _run_method(
    method: Method,
    order: int,
    dt: float,
    system: openmm.System,
    bodies: RigidBodies,
    start: openmm.State,
    settings: SchemesSettings,
    report: Report,
) -> Row:
    step = dt * method.force_evaluations
    row = Row(method.name, order, method.force_evaluations, step, dt, settings.time, math.nan, (math.nan, math.nan))
    integrator = method.make(1e-3 * step)
    integrator.setConstraintTolerance(sampling.CONSTRAINT_TOLERANCE)
    context = make_context(system, integrator, settings.platform)
    steps = max(1, round(settings.time * 1e3 / step))
    every = min(steps, max(1, round(INTERVAL / step)))
    try:
        context.setState(start)
        with report.progress(f"{method.name}, {dt:g} fs per force", steps, 1e-3 * step) as show:
            series = sampling.sample(context, bodies, steps, every, show)
    except (sampling.Unstable, openmm.OpenMMException) as error:
        return replace(row, broken=" ".join(str(error).split()))
    found = energy_error(series.time, series.total, series.potential)
    return replace(row, error=found, drift=energy_drift(series.time, series.total))


def best(rows: list[Row]) -> dict[float, Row]:
    """For each time per force evaluation the row with the least energy error; none where every scheme broke down."""
    winners: dict[float, Row] = {}
    for row in rows:
        if math.isnan(row.error):
            continue
        known_best = winners.get(row.fs_per_force)
        if known_best is None or row.error < known_best.error:
            winners[row.fs_per_force] = row
    return winners


def run(settings: SchemesSettings, out: Path, report: Report = SILENT) -> list[Row]:
    """Compare, and write schemes.json and, with matplotlib, schemes.png to a directory.

    Args:
        settings: what is compared.
        out: the directory, which is made if it does not exist.
        report: gets the table, notes and progress.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = compare(settings, report)
    report.table(table(rows, settings))
    for dt, row in best(rows).items():
        report.note(f"least energy error at {dt:g} fs per force: {row.scheme}, {100 * row.error:.3f} %")
    record = {
        "version": __version__,
        "openmm": openmm.__version__,
        "settings": asdict(settings) | {"box": settings.box.name},
        "rows": [asdict(row) for row in rows],
    }
    (out / "schemes.json").write_text(json.dumps(record, indent=1))
    if style.can_draw(report):
        figures.schemes_figure(rows, out / "schemes.png")
    return rows


def load(path: Path) -> list[Row]:
    """Rows that `run` wrote."""
    rows: list[dict[str, Any]] = json.loads(path.read_text())["rows"]
    return [Row(**{**row, "drift": tuple(row["drift"])}) for row in rows]


def _line(row: Row) -> str:
    if row.broken:
        return f"{row.scheme} at {row.fs_per_force:g} fs per force: broke down ({row.broken})"
    return (
        f"{row.scheme} at {row.fs_per_force:g} fs per force: rms(H)/rms(V) = {100 * row.error:.3f} %, "
        f"drift {row.drift[0]:+.2f} ± {row.drift[1]:.2f} kJ/mol/ps"
    )


def table(rows: list[Row], settings: SchemesSettings) -> Table:
    """The rows as text."""

    def cell(value: float, digits: int) -> str:
        return "-" if math.isnan(value) else f"{value:.{digits}f}"

    return Table(
        f"Conservation of energy, {settings.time:g} ps each",
        [
            "scheme",
            "order",
            "forces a step",
            "step/fs",
            "fs per force",
            "forces/ps",
            "rms(H)/rms(V)/%",
            "drift of the box/kJ/mol/ps",
        ],
        [
            [
                row.scheme,
                str(row.order),
                str(row.force_evaluations),
                f"{row.step:g}",
                f"{row.fs_per_force:g}",
                f"{row.forces_per_ps:.0f}",
                cell(100 * row.error, 3),
                "broke down" if row.broken else f"{cell(row.drift[0], 3)} ± {cell(row.drift[1], 3)}",
            ]
            for row in rows
        ],
    )
