"""Acceptance of hybrid Monte Carlo against the number of molecules: the measurement behind `openmm-sier acceptance`.

All schemes follow trajectories of the same length from the same boxes, Verlet among them: kick, drift, kick with a
step of RATTLE that is solved to rounding, so that it is reversible and can be accepted or rejected exactly.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import openmm

from openmm_sier.measure.acceptance import Spread, largest_box, pooled
from openmm_sier.measure.forcefields import Box, read_box
from openmm_sier.measure.report import SILENT, Report, Table
from openmm_sier.version import __version__
from studies import acceptance_trials as trials
from studies import figures, style
from studies.acceptance_trials import METHODS, AcceptanceSettings, Member
from studies.bench.replicas import Replica, of_size

#: The file of the numbers, and the directory of intermediate results.
FILE, KEPT = "acceptance.json", "trials"

#: Settings that all files of a directory must share.
SHARED = ("box", "forcefield", "time", "temperature", "equilibrate", "seed", "platform")

#: Spreads of boxes below this size are not pooled with those of larger ones, since cut-offs are shorter in boxes that
#: are narrower than twice the usual cut-off.
SMALLEST_POOLED = 512


@dataclass(frozen=True)
class Row:
    """One method at one step in one box. Energies in kT, values with their standard errors.

    Attributes:
        length: of a trajectory, fs.
        trials: how many.
        acceptance: mean of min(1, exp(-error)).
        spread: standard deviation of the energy error.
        mean: of the energy error, half the square of the spread if errors are normal.
        noise: standard deviation of the energy from rounding, which enters each trial twice.
    """

    molecules: int
    method: str
    fs_per_force: float
    step: float
    length: float
    trials: int
    acceptance: tuple[float, float]
    spread: tuple[float, float]
    mean: tuple[float, float]
    noise: float
    broken: str = ""

    @classmethod
    def of(cls, member: Member) -> Row:
        """The row for the trials of a member."""
        errors = np.array([math.inf if error is None else error for error in member.errors])
        followed, none = errors[np.isfinite(errors)], (math.nan, math.nan)
        accepted, mean, spread = none, none, none
        if len(errors) > 1:
            chances = np.exp(-np.maximum(errors, 0))
            accepted = float(chances.mean()), float(chances.std(ddof=1) / math.sqrt(len(errors)))
        if len(followed) > 1:
            sd = float(followed.std(ddof=1))
            spread = sd, sd / math.sqrt(2 * (len(followed) - 1))
            mean = float(followed.mean()), sd / math.sqrt(len(followed))
        noise = math.nan if member.noise is None else member.noise
        place = (member.molecules, member.method, member.fs_per_force, member.step, member.step * member.steps)
        return cls(*place, len(errors), accepted, spread, mean, noise, member.broken)


@dataclass(frozen=True)
class Limit:
    """How large a box may be with half of the trials accepted.

    Attributes:
        spread: of the energy error for one molecule, kT, from all boxes of 512 molecules and more; for n it is sqrt(n)
            times as large.
        measured: the largest box that was measured with an acceptance above one half; 0 if there is none.
        extrapolated: number of molecules with an acceptance of one half by that law, with its standard error.
    """

    method: str
    fs_per_force: float
    spread: tuple[float, float]
    measured: int
    extrapolated: tuple[float, float]


def run(settings: AcceptanceSettings, out: Path, report: Report = SILENT) -> list[Row]:
    """Measure, and write acceptance.json and, with matplotlib, acceptance.png to a directory.

    Boxes and trials are kept there as soon as they are done: a stopped run goes on where it was, and a run with further
    sizes, schemes or steps adds to them. All results in the directory are written and returned.

    Args:
        settings: what is measured.
        out: the directory, which is made if it does not exist.
        report: gets tables, notes and progress.

    Raises:
        ValueError: a scheme is unknown, a size does not fit the box, or the directory has results of other settings.
    """
    _check(settings)
    box = read_box(settings.box, settings.forcefield)
    kept = out / KEPT
    kept.mkdir(parents=True, exist_ok=True)
    _share(settings, kept / "settings.json")
    for molecules in settings.sizes:
        _measure_size(settings, of_size(box, settings.box.parent, molecules), box, kept, report)
    rows = sorted(map(Row.of, trials.read_all(kept)), key=_place)
    _publish(rows, settings, out, report)
    return rows


def _measure_size(settings: AcceptanceSettings, replica: Replica, box: Box, kept: Path, report: Report) -> None:
    """Make those trials of all methods in one box that are not on disk yet."""
    molecules = replica.molecules
    wanted, begun = settings.trials_of(molecules), None
    for name, dt in itertools.product(settings.schemes or METHODS, settings.dt):
        path = kept / f"{molecules}-{name}-{dt:g}.json"
        if (member := _known(path, wanted)) is None:
            # A cropped box has new faces, so it is equilibrated until it has settled.
            time = None if molecules < box.topology.getNumResidues() else settings.equilibrate
            begun = begun or trials.start(replica, kept / f"{molecules}.npz", settings, time, report)
            member = trials.measure(begun, METHODS[name], dt, wanted, settings, report)
            trials.keep(member, path)
        report.note(_line(Row.of(member)))


def _place(row: Row) -> tuple[int, float, int]:
    """Where a row stands in the table."""
    names = [method.name for method in METHODS.values()]
    return row.molecules, row.fs_per_force, names.index(row.method)


def _check(settings: AcceptanceSettings) -> None:
    for name in settings.schemes or ():
        if name not in METHODS:
            raise ValueError(f"unknown scheme {name!r}; known are {', '.join(METHODS)}")
    if settings.trials is not None and len(settings.trials) not in (1, len(settings.sizes)):
        raise ValueError(f"trials must be one number or one for each of {len(settings.sizes)} sizes")
    if settings.trials is not None and min(settings.trials) < 2:
        raise ValueError(f"trials must be at least 2, got {min(settings.trials)}")


def _shared(settings: AcceptanceSettings) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in SHARED} | {"box": settings.box.name}


def _share(settings: AcceptanceSettings, path: Path) -> None:
    """Note the settings of a directory's files, or refuse settings that differ from those noted."""
    mine = _shared(settings)
    if not path.exists():
        path.write_text(json.dumps(mine, indent=1))
        return
    theirs = json.loads(path.read_text())
    for name, value in mine.items():
        if theirs[name] != value:
            raise ValueError(
                f"{path.parent} has trials with {name} {theirs[name]}, got {value}: take another directory for --out"
            )


def _known(path: Path, wanted: int) -> Member | None:
    """Trials that are on disk, if they are enough."""
    if not path.exists():
        return None
    found = trials.read(path)
    return found if found.broken or len(found.errors) >= wanted else None


def limits(rows: Sequence[Row], accepted: float = 0.5) -> list[Limit]:
    """How large a box may be, for each method and step with trials in boxes of 512 molecules or more."""
    groups: dict[tuple[str, float], list[Row]] = {}
    for row in rows:
        if not row.broken and row.spread[0] > 0:
            groups.setdefault((row.method, row.fs_per_force), []).append(row)
    found = []
    for (method, dt), mine in groups.items():
        if not (large := [row for row in mine if row.molecules >= SMALLEST_POOLED]):
            continue
        spread = pooled(*zip(*[(row.molecules, row.trials, row.spread[0]) for row in large], strict=True))
        measured = max((row.molecules for row in mine if row.acceptance[0] > accepted), default=0)
        found.append(Limit(method, dt, spread, measured, largest_box(spread, accepted)))
    return found


def _publish(rows: list[Row], settings: AcceptanceSettings, out: Path, report: Report) -> None:
    found = limits(rows)
    report.table(table(rows))
    report.table(table_of_limits(found, max(row.molecules for row in rows)))
    record = {
        "version": __version__,
        "openmm": openmm.__version__,
        "settings": _shared(settings),
        "rows": [asdict(row) for row in rows],
        "limits": [asdict(limit) for limit in found],
    }
    (out / FILE).write_text(json.dumps(record, indent=1))
    if style.can_draw(report):
        lines = [(each.method, each.fs_per_force, Spread(*each.spread)) for each in found]
        figures.acceptance_figure(rows, lines, out / "acceptance.png")


def load(path: Path) -> list[Row]:
    """Rows that `run` wrote."""
    rows: list[dict[str, Any]] = json.loads(path.read_text())["rows"]
    return [Row(**dict[str, Any]((k, tuple(v) if isinstance(v, list) else v) for k, v in row.items())) for row in rows]


def _line(row: Row) -> str:
    what = f"{row.method} at {row.fs_per_force:g} fs per force, {row.molecules} molecules"
    if row.broken:
        return f"{what}: {row.broken}"
    return f"{what}: acceptance {_with_error(row.acceptance, 3)}, sd {_with_error(row.spread, 4)} kT"


def _with_error(value: tuple[float, float], digits: int) -> str:
    return "-" if math.isnan(value[0]) else f"{value[0]:.{digits}f} ± {value[1]:.{digits}f}"


def table(rows: Sequence[Row]) -> Table:
    """The rows as text."""
    columns = ("molecules", "scheme", "fs per force", "trajectory/fs", "trials", "acceptance", "sd/kT", "mean/kT")
    return Table(
        "Energy error of trajectories, and acceptance",
        [*columns, "noise of the energy/kT"],
        [
            [
                str(row.molecules),
                row.method,
                f"{row.fs_per_force:g}",
                f"{row.length:g}",
                "refused" if row.broken else str(row.trials),
                _with_error(row.acceptance, 3),
                _with_error(row.spread, 4),
                _with_error(row.mean, 4),
                "-" if math.isnan(row.noise) else f"{row.noise:.1g}",
            ]
            for row in rows
        ],
        left=2,
    )


def table_of_limits(found: Sequence[Limit], largest: int) -> Table:
    """The limits as text."""
    return Table(
        "Largest box with an acceptance above 0.5",
        ["scheme", "fs per force", "sd for one molecule/kT", f"measured, up to {largest}", "by sd ~ sqrt(N)"],
        [
            [
                limit.method,
                f"{limit.fs_per_force:g}",
                _with_error(limit.spread, 5),
                str(limit.measured or "none"),
                f"{float(f'{limit.extrapolated[0]:.2g}'):.0f} ± {float(f'{limit.extrapolated[1]:.1g}'):.0f}",
            ]
            for limit in found
        ],
    )
