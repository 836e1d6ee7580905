"""Logs of a run, or of several that differ in their seeds: read and compared."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from openmm_sier.analysis import read_log
from openmm_sier.analysis.statistics import over_runs
from openmm_sier.cli import results
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.files.places import same_file
from openmm_sier.cli.planning import noted_settings
from openmm_sier.cli.results import ACCEPTANCE, DENSITY, FEWEST_ROWS, Quantity
from openmm_sier.cli.settings import CONTINUED, RunSettings, checkpoint_of
from openmm_sier.dynamics.correlation import is_constant
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL, TEMPERATURES

#: Columns that grow from row to row, and columns without gaps.
CLOCKS = "Step", "Time (ps)"
ENERGIES = POTENTIAL, "Total Energy (kJ/mole)"

#: Required columns.
NEEDED = (*CLOCKS, *ENERGIES, CONSERVED, *TEMPERATURES)

#: Larger numbers, of which squares are not finite, are none of a run.
LARGEST = 1e100

#: Options in which runs of one kind may differ.
MAY_DIFFER = {
    *("seed", "out", "unwrapped", "report", "pressure_tensor"),
    *("every", "report_every", "checkpoint_every", "pressure_tensor_every"),
}


@dataclass(frozen=True)
class Run:
    """The log of a run.

    Attributes:
        path: of the log.
        log: its columns.
        plan: of the run, by the checkpoint beside the log; None if there is none.
        unsettled: how a doubtful equilibration ended, by that checkpoint; None without one.
    """

    path: Path
    log: dict[str, np.ndarray]
    plan: RunSettings | None = None
    unsettled: str | None = None

    @property
    def has_trials(self) -> bool:
        """Whether the run is of hybrid Monte Carlo."""
        return ACCEPTANCE in self.log

    @property
    def ensemble(self) -> str | None:
        """Ensemble by the checkpoint; without one only hybrid Monte Carlo is recognized, and others are None."""
        if self.plan is not None:
            return self.plan.ensemble
        return "hmc" if self.has_trials else None

    @cached_property
    def moves_volume(self) -> bool:
        """Whether the pressure is constant by the checkpoint; without one, whether the density changes."""
        if self.plan is not None:
            return self.plan.moves_volume
        values = self.log.get(DENSITY, np.array([math.nan]))
        return not np.isnan(values).any() and not is_constant(values)

    @cached_property
    def clock(self) -> np.ndarray:
        """Time of each row since the first row, (n,), ps; with hybrid Monte Carlo the number of trials."""
        column = self.log["Step" if self.has_trials else "Time (ps)"]
        return column - column[0]

    def after(self, begin: float) -> dict[str, np.ndarray]:
        """Return the columns of the log from a time of its clock on."""
        is_later = self.clock >= begin
        return {name: column[is_later] for name, column in self.log.items()}


class Runs(NamedTuple):
    """Runs of one kind.

    Attributes:
        runs: at least one, each by one log.
        begin: time of their clocks from which on means are taken.
        skipped: the part of `begin` that a user chose. The names below are about the time after it.
        moving: names of quantities that settled after a while.
        drifting: names of quantities with a trend up to the end.
        unclear: names of quantities with too few independent values to show a trend.
    """

    runs: list[Run]
    begin: float = 0.0
    skipped: float = 0.0
    moving: tuple[str, ...] = ()
    drifting: tuple[str, ...] = ()
    unclear: tuple[str, ...] = ()

    @property
    def first(self) -> Run:
        """First run, whose kind is that of all."""
        return self.runs[0]

    @property
    def ensemble(self) -> str | None:
        """Ensemble of the runs; None where no checkpoint has it."""
        return next((run.ensemble for run in self.runs if run.ensemble), None)

    @property
    def unit(self) -> str:
        """Unit of the clocks of the runs."""
        return "trials" if self.first.has_trials else "ps"

    @property
    def length(self) -> float:
        """Length of the shortest run."""
        return min(float(run.clock[-1]) for run in self.runs)

    @property
    def title(self) -> str:
        """Number and length of the runs, and methods and ensemble if checkpoints have them."""
        number = self.first.path.name if len(self.runs) == 1 else f"{len(self.runs)} runs"
        plans = " and ".join(dict.fromkeys(run.plan.title for run in self.runs if run.plan))
        return f"{number}, {self.length:g} {self.unit}" + (f", {plans}" if plans else "")

    def means(self) -> list[tuple[Quantity, list[Quantity]]]:
        """Return each quantity over all runs, and in each of them."""
        ensemble = self.ensemble
        lists = [results.quantities(run.after(self.begin), ensemble, run.moves_volume) for run in self.runs]
        return [
            (same[0]._replace(value=over_runs([quantity.value for quantity in same])), list(same))
            for same in zip(*lists, strict=True)
        ]


# --- reading ---


def read_run(path: Path) -> Run:
    """Read the log of a run, which may still be running.

    Raises:
        RunError: it is not a log of a run, or has too few rows.
        RecordError: a row is damaged.
        OSError: it cannot be read.
    """
    try:
        log = read_log(path, whole_lines=True)
    except UnicodeDecodeError:
        raise RunError(f"{path} is not a log of openmm-sier run: give the .csv file that --report wrote") from None
    if missing := [name for name in NEEDED if name not in log]:
        raise RunError(
            f"{path} is not a log of openmm-sier run, since it has no column {missing[0]}: give the file that "
            "--report wrote, or that of a ConservationReporter"
        )
    if (rows := len(log["Step"])) < FEWEST_ROWS:
        raise RunError(f"{path} has {rows} rows so far and needs {FEWEST_ROWS} or more: let the run continue")
    _check_rows(path, log)
    checkpoint = checkpoint_of(path)
    # A log is also read without its checkpoint.
    with suppress(ValueError, LookupError, TypeError, OSError):
        notes = checkpoints.read_notes(checkpoint)
        plan = noted_settings(checkpoint, notes.plan)
        if same_file(plan.report, path):
            return Run(path, log, plan, notes.unsettled)
    return Run(path, log)


def _check_rows(path: Path, log: dict[str, np.ndarray]) -> None:
    """Refuse rows that no run writes.

    Raises:
        RunError: naming the row.
    """
    for name in CLOCKS:
        values = log[name]
        is_wrong = np.concatenate([~(values[:1] >= 0), ~(np.diff(values) > 0)])
        _refuse_row(path, is_wrong, f"{name} is not above that of the row before, or negative")
    for name, values in log.items():
        # Columns without a meaning in a run are NaN.
        is_wrong = ~np.isfinite(values) if name in ENERGIES else np.isinf(values)
        _refuse_row(path, is_wrong | (np.abs(values) > LARGEST), f"{name} is not finite")


def _refuse_row(path: Path, is_wrong: np.ndarray, reason: str) -> None:
    if is_wrong.any():
        row = int(is_wrong.argmax()) + 1
        raise RunError(f"{path} was edited or damaged: in row {row}, {reason}. Give a log as a run writes it")


def read_logs(paths: Sequence[Path]) -> Runs:
    """Return runs of one kind, from their logs.

    Warns of runs whose options differ in more than the seed, and of runs with the same seed.

    Args:
        paths: of the logs.

    Raises:
        Misused: a log is given twice.
        RunError: the logs are not of one kind.
        RecordError, OSError: as for `read_run`.
    """
    runs = [read_run(path) for path in paths]
    for i, path in enumerate(paths):
        if any(same_file(path, other) for other in paths[:i]):
            raise Misused(f"{path} is given twice: each run counts once")
    for run in runs[1:]:
        if not _are_of_one_kind(run, runs[0]):
            raise RunError(f"{run.path} and {runs[0].path} differ in ensemble or columns: give runs of one kind")
    _warn_of_differences(runs)
    _warn_of_copies(runs)
    return Runs(runs)


def _are_of_one_kind(one: Run, other: Run) -> bool:
    """Return whether two runs have the same columns and, as far as that is known, the same ensemble."""
    ensembles = {run.ensemble for run in (one, other) if run.ensemble}
    return len(ensembles) < 2 and one.moves_volume == other.moves_volume and one.log.keys() == other.log.keys()


def _warn_of_differences(runs: Sequence[Run]) -> None:
    first = runs[0].plan
    for run in runs[1:]:
        if first and run.plan and (differing := _differing(run.plan, first)):
            warnings.warn(
                f"{run.path} and {runs[0].path} differ in {', '.join(differing)}: their mean belongs to no ensemble. "
                "Give runs with the same settings",
                stacklevel=3,
            )
            return


def _warn_of_copies(runs: Sequence[Run]) -> None:
    for one, other in combinations(runs, 2):
        if _have_equal_ends(one, other) or _have_same_noise(one, other):
            warnings.warn(
                f"{one.path} and {other.path} are logs of one run, or have the same seed: the error of their mean is "
                "too small. Give each run a --seed of its own",
                stacklevel=3,
            )
            return


def _have_equal_ends(one: Run, other: Run) -> bool:
    """Return whether two logs are equal in the last row with a common step."""
    steps, rows, rows_of_other = np.intersect1d(one.log["Step"], other.log["Step"], return_indices=True)
    if not len(steps):
        return False
    ends = np.array([[one.log[name][rows[-1]], other.log[name][rows_of_other[-1]]] for name in one.log])
    return np.array_equal(ends[:, 0], ends[:, 1], equal_nan=True)


def _have_same_noise(one: Run, other: Run) -> bool:
    """Return whether two runs have the same seed and settings by their checkpoints, if both have one."""
    if one.plan is None or other.plan is None or one.ensemble == "nve":
        return False
    return one.plan.seed == other.plan.seed and not _differing(one.plan, other.plan)


def _differing(one: RunSettings, other: RunSettings) -> list[str]:
    """Return the names of settings that differ, without those in `MAY_DIFFER`."""
    return [name for name in CONTINUED if name not in MAY_DIFFER and getattr(one, name) != getattr(other, name)]
