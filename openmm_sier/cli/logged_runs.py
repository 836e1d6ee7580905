"""Logs of a run, or of several that differ in their seeds: read, compared, and cut where they settled."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from openmm_sier.analysis import read_log
from openmm_sier.analysis.observables import blocks
from openmm_sier.analysis.statistics import FEWEST, over_runs, rms, settling
from openmm_sier.cli import results
from openmm_sier.cli.errors import Misused, RunError
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.files.outputs import same_file
from openmm_sier.cli.planning import noted_settings
from openmm_sier.cli.results import DENSITY, Quantity
from openmm_sier.cli.settings import CONTINUED, RunSettings, checkpoint_of
from openmm_sier.dynamics.correlation import is_constant
from openmm_sier.observe.conservation import CONSERVED, POTENTIAL, TEMPERATURES

#: Columns without which there is nothing to tell.
NEEDED = ("Step", "Time (ps)", POTENTIAL, "Total Energy (kJ/mole)", CONSERVED, *TEMPERATURES)

#: Fewest rows of a log from which anything is told.
FEWEST_ROWS = 3

#: Options in which runs of one kind may differ.
MAY_DIFFER = {
    *("seed", "out", "unwrapped", "report", "pressure_tensor"),
    *("every", "report_every", "checkpoint_every", "pressure_tensor_every"),
}

#: Heat that a bath gave, in means over 1 ps, over the fluctuation of the potential energy, above which there is a bath.
#: At constant energy what is left are errors of the integrator, some hundredths.
HEAT = 0.1

#: Relative error of energies.
ROUNDING = 1e-9

#: Bins of time in which it is looked for where runs settled.
BINS = 400

#: Of a run that has not settled, the part that means leave out.
LEFT_OUT = 0.5

#: What settles, in words, by its column.
SETTLES = {
    POTENTIAL: "potential energy",
    **dict(zip(TEMPERATURES, ("translation", "rotation", "temperature of flexible molecules"), strict=True)),
    DENSITY: "density",
}


class Run(NamedTuple):
    """The log of a run.

    Attributes:
        path: of the log.
        log: its columns.
        plan: of the run, by the checkpoint beside the log; None if there is none.
        unsettled: how a doubtful equilibration ended, by that checkpoint; None without one.
        inputs: fingerprints of the files of its System, by that checkpoint.
    """

    path: Path
    log: dict[str, np.ndarray]
    plan: RunSettings | None = None
    unsettled: str | None = None
    inputs: dict[str, str] | None = None

    @property
    def ensemble(self) -> str:
        """Return the ensemble as far as the log tells it: "hmc", "nve" or, with any bath, "nvt"."""
        if "Acceptance" in self.log:
            return "hmc"
        time, total, conserved = (self.log[name] for name in ("Time (ps)", "Total Energy (kJ/mole)", CONSERVED))
        if np.isnan(conserved).any():
            return "nvt"
        parts = blocks(time, total - conserved)
        parts = parts if len(parts) >= FEWEST_ROWS else np.array_split(total - conserved, FEWEST_ROWS)
        heat = rms(np.array([part.mean() for part in parts]))
        # The potential energy of a molecule alone is constant.
        return "nvt" if heat > HEAT * rms(self.log[POTENTIAL]) + ROUNDING * np.abs(total).max() else "nve"

    @property
    def moves_volume(self) -> bool:
        """Return whether the density changes."""
        values = self.log.get(DENSITY, np.array([math.nan]))
        return not np.isnan(values).any() and not is_constant(values)

    @property
    def clock(self) -> np.ndarray:
        """Return the time of each row since the first row, (n,), ps; with hybrid Monte Carlo the number of trials."""
        column = self.log["Step" if self.ensemble == "hmc" else "Time (ps)"]
        return column - column[0]

    def after(self, begin: float) -> dict[str, np.ndarray]:
        """Columns of the log from a time of its clock on."""
        kept = self.clock >= begin
        return {name: column[kept] for name, column in self.log.items()}

    def quantities(self, begin: float) -> list[Quantity]:
        """Return all that the log tells from a time of its clock on."""
        log = self.after(begin)
        found = results.energies(log, self.ensemble)
        if self.ensemble == "nve":
            found.insert(0, results.potential_energy(log))
        found += results.temperatures(log)
        return found + ([results.density(log)] if self.moves_volume else []) + results.trials(log)


class Runs(NamedTuple):
    """Runs of one kind.

    Attributes:
        runs: at least one, each by one log.
        begin: time of their clocks from which on means are taken.
        skipped: the part of `begin` that a user chose. The names below are about the time after it.
        moving: names of quantities that settled after a while.
        drifting: names of quantities with a trend up to the end.
        unclear: names of quantities with too few independent values to show a trend.
        copies: of each run with several logs their paths, that of the log that counts first.
    """

    runs: list[Run]
    begin: float = 0.0
    skipped: float = 0.0
    moving: tuple[str, ...] = ()
    drifting: tuple[str, ...] = ()
    unclear: tuple[str, ...] = ()
    copies: tuple[list[Path], ...] = ()

    @property
    def first(self) -> Run:
        """Return the first run, which shows of what kind they are."""
        return self.runs[0]

    @property
    def unit(self) -> str:
        """Return what the clocks of the runs count."""
        return "trials" if self.first.ensemble == "hmc" else "ps"

    @property
    def length(self) -> float:
        """Return how far all runs go."""
        return min(float(run.clock[-1]) for run in self.runs)

    @property
    def title(self) -> str:
        """Return number and length of the runs, and method and ensemble where a checkpoint tells them."""
        plan = self.first.plan
        number = self.first.path.name if len(self.runs) == 1 else f"{len(self.runs)} runs"
        return f"{number}, {self.length:g} {self.unit}" + (f", {plan.title}" if plan else "")

    def means(self) -> list[tuple[Quantity, list[Quantity]]]:
        """Each quantity over all runs, and in each of them."""
        each = zip(*(run.quantities(self.begin) for run in self.runs), strict=True)
        return [(mine[0]._replace(value=over_runs([one.value for one in mine])), list(mine)) for mine in each]


def finding(runs: Runs) -> str:
    """Say whether the runs had settled, and from which part of them all means are taken."""
    length, begin = (f"{value:.4g} {runs.unit}" for value in (runs.length - runs.skipped, runs.begin))
    left_out = f"Means leave out the first {begin}"
    if runs.drifting:
        verdict = f"Not settled in {length}: {listed(runs.drifting)}"
    elif runs.unclear:
        verdict = f"{length}: too short to tell a trend of {listed(runs.unclear)}"
    elif runs.moving:
        verdict = f"Settled after {begin}: {listed(runs.moving)}"
        left_out = "Means are of the rest"
    else:
        steady = "energy, temperatures or density" if runs.first.moves_volume else "energy or temperatures"
        verdict = f"{length} without a trend of {steady}"
    sentences = [verdict, left_out] if runs.begin else [verdict]
    if doubtful := sum(run.unsettled is not None for run in runs.runs):
        of_all = f": {doubtful} of {len(runs.runs)} runs" if len(runs.runs) > 1 else ""
        sentences.append(f"Not equilibrated at the start{of_all}")
    return ". ".join(sentences)


def remarks(runs: Runs) -> list[str]:
    """Return warnings about runs that count once, have the same noise, or were not equilibrated."""
    warned = [
        f"warning: {listed(list(map(str, paths)))} are logs of one run, which counts once. Give each run a --seed of "
        "its own"
        for paths in runs.copies
    ]
    warned += [
        f"warning: {listed(list(map(str, paths)))} have the same seed, settings and inputs, and so the same noise: "
        "give each run a --seed of its own"
        for paths in _groups(runs.runs, _has_the_noise_of)
    ]
    doubtful = [run for run in runs.runs if run.unsettled]
    return warned + [f"warning: {run.path}: not equilibrated, after {run.unsettled}" for run in doubtful]


def listed(names: Sequence[str]) -> str:
    """Names in a sentence."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


# --- to read them ---


def read_run(path: Path) -> Run:
    """Read the log of a run, which may still be going on.

    Raises:
        RunError: it is no log of a run, or has hardly begun.
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
    checkpoint = checkpoint_of(path)
    # The checkpoint tells no more than names, which are not needed.
    with suppress(ValueError, LookupError, TypeError, OSError):
        notes = checkpoints.read_notes(checkpoint)
        plan = noted_settings(checkpoint, notes["plan"])
        if same_file(plan.report, path):
            return Run(path, log, plan, notes["unsettled"], notes["inputs"])
    return Run(path, log)


def read_runs(paths: Sequence[Path], skip: float | None = None) -> Runs:
    """Runs of one kind, from their logs, and where they settled.

    Logs of one run count once. Warns of runs that are shorter than others, or whose options differ in more than the
    seed.

    Args:
        paths: of the logs.
        skip: what to leave out of each in any case, ps or trials; None for what had not settled.

    Raises:
        Misused: a log is given twice.
        RunError: the logs are not of one kind, or nothing is left.
        RecordError, OSError: as for `read_run`.
    """
    found = [read_run(path) for path in paths]
    for i, path in enumerate(paths):
        if any(same_file(path, other) for other in paths[:i]):
            raise Misused(f"{path} is given twice: each run counts once")
    first, *others = found
    for run in others:
        if (run.ensemble, run.moves_volume, run.log.keys()) != (first.ensemble, first.moves_volume, first.log.keys()):
            raise RunError(
                f"{run.path} is {_described(run)}, but {first.path} is {_described(first)}: give runs of one kind"
            )
    # Of logs of one length, one with its checkpoint tells more.
    longest_first = sorted(found, key=lambda run: (-len(run.log["Step"]), run.plan is None))
    copies = _groups(longest_first, _is_log_of)
    left_out = {path for _, *others in copies for path in others}
    runs = Runs([run for run in found if run.path not in left_out], copies=copies)
    _warn_of_differences(runs.runs)
    if skip is not None and skip >= runs.length:
        raise RunError(f"--skip {skip:g} leaves nothing: the shortest run has {runs.length:g} {runs.unit}")
    return _with_settling(runs, skip)


def _described(run: Run) -> str:
    kind = {"nve": "a run at constant energy", "nvt": "a run in a heat bath", "hmc": "a run of hybrid Monte Carlo"}[
        run.ensemble
    ]
    return f"{kind}, {'at constant pressure' if run.moves_volume else 'at constant volume'}"


def _warn_of_differences(runs: Sequence[Run]) -> None:
    ends = [float(run.clock[-1]) for run in runs]
    shortest, longest = int(np.argmin(ends)), int(np.argmax(ends))
    if ends[shortest] < 0.99 * ends[longest]:
        unit = Runs(list(runs)).unit
        warnings.warn(
            f"{runs[shortest].path} ends after {ends[shortest]:g} {unit}, and {runs[longest].path} after "
            f"{ends[longest]:g} {unit}: means give both the same weight. Give runs of one length",
            stacklevel=3,
        )
    first = runs[0].plan
    for run in runs[1:]:
        if first is None or run.plan is None:
            continue
        if differing := _differing(run.plan, first):
            warnings.warn(
                f"{run.path} and {runs[0].path} differ in {', '.join(differing)}: their mean belongs to no ensemble. "
                "Give runs with the same settings",
                stacklevel=3,
            )
            return


# --- which of them are one ---


def _groups(runs: Sequence[Run], is_alike: Callable[[Run, Run], bool]) -> tuple[list[Path], ...]:
    """Return the paths of runs that are alike, for each group of several."""
    groups: list[list[Run]] = []
    for run in runs:
        alike = next((group for group in groups if is_alike(run, group[0])), None)
        if alike is None:
            groups.append([run])
        else:
            alike.append(run)
    return tuple([run.path for run in group] for group in groups if len(group) > 1)


def _is_log_of(one: Run, other: Run) -> bool:
    """Return whether two logs are of one run: by their common rows, or by a common start, seed and settings."""
    steps, rows, rows_of_other = np.intersect1d(one.log["Step"], other.log["Step"], return_indices=True)
    if not len(steps):
        return False
    columns = np.array([[one.log[name][rows], other.log[name][rows_of_other]] for name in one.log])
    is_equal: np.ndarray = np.isclose(columns[:, 0], columns[:, 1], rtol=0, atol=0, equal_nan=True).all(axis=0)
    if is_equal.all() and len(steps) > 1:
        return True
    # Where forces are not repeated to the bit, as on a GPU, later rows differ.
    return bool(is_equal[0]) and _are_alike(one, other)


def _has_the_noise_of(one: Run, other: Run) -> bool:
    return one.ensemble != "nve" and _are_alike(one, other)


def _are_alike(one: Run, other: Run) -> bool:
    """Return whether two runs have the same seed, settings and inputs by their checkpoints, if both have one."""
    if one.plan is None or other.plan is None:
        return False
    return one.plan.seed == other.plan.seed and one.inputs == other.inputs and not _differing(one.plan, other.plan)


def _differing(one: RunSettings, other: RunSettings) -> list[str]:
    """Return the names of settings that differ, without those in which runs of one kind may."""
    return [name for name in CONTINUED if name not in MAY_DIFFER and getattr(one, name) != getattr(other, name)]


# --- where they settled ---


def binned(clock: np.ndarray, values: np.ndarray, width: float, count: int) -> np.ndarray:
    """Means (count,) of values in bins of a clock; NaN where a bin has none. What comes after the last bin is left out.

    Args:
        clock, values: (n,).
        width: of a bin, which includes its end; the first includes 0 too.
        count: number of bins.
    """
    # Times are sums of steps, whose rounding must not move a row into the next bin.
    places = np.maximum(np.ceil(np.round(clock / width, 6)).astype(int) - 1, 0)
    kept = (places < count) & np.isfinite(values)
    numbers = np.bincount(places[kept], minlength=count)
    sums = np.bincount(places[kept], values[kept], minlength=count)
    return np.divide(sums, numbers, out=np.full(count, math.nan), where=numbers > 0)


def _with_settling(runs: Runs, skip: float | None) -> Runs:
    """Return runs with the time from which the means over all of them have settled, and the quantities that have not.

    Args:
        runs: none of whose quantities was looked at.
        skip: time of their clocks that is left out in any case; None leaves out what had not settled.
    """
    begin = skip or 0.0
    logs = [run.after(begin) for run in runs.runs]
    clocks = [run.clock[run.clock >= begin] - begin for run in runs.runs]
    count = max(1, min(*map(len, clocks), BINS + 1) - 1)
    width = (runs.length - begin) / count
    begins = [0.0]
    moving: list[str] = []
    drifting: list[str] = []
    unclear: list[str] = []
    for column, name in SETTLES.items():
        if column == DENSITY and not runs.first.moves_volume:
            continue
        series = np.mean([binned(c, log[column], width, count) for c, log in zip(clocks, logs, strict=True)], axis=0)
        (kept,) = np.nonzero(np.isfinite(series))
        if not len(kept):
            continue
        found = settling(series[kept])
        if found.begin == len(kept):
            drifting.append(name)
            continue
        begins.append(float(kept[found.begin]) * width if found.begin else 0.0)
        if found.samples < FEWEST:
            unclear.append(name)
        elif found.begin:
            moving.append(name)
    if skip is not None:
        # Quantities that settle later have a trend in the means.
        drifting += moving
        moving = []
        begins = [skip]
    elif drifting:
        begins.append(LEFT_OUT * runs.length)
    return runs._replace(
        begin=max(begins),
        skipped=begin,
        moving=tuple(moving),
        drifting=tuple(drifting),
        unclear=tuple(unclear),
    )
