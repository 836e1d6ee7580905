"""The command `openmm-sier validate`: whether runs sampled the ensembles that they were asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from openmm_sier.cli.console import note, table
from openmm_sier.cli.finished_runs import FinishedRun, open_runs
from openmm_sier.cli.plan import RunError
from openmm_sier.measure import validation
from openmm_sier.measure.validation import Sampled, TooFewError, Verdict


class InvalidError(RuntimeError):
    """Runs did not sample what they were meant to."""

    exit_code = 5


class Point:
    """Runs that differ in their seeds alone.

    Attributes:
        first: of the runs.
        plan: of the first.
        logs: columns of the log of each run, without the skipped part.
    """

    def __init__(self, first: FinishedRun) -> None:
        self.first, self.plan = first, first.plan
        self.logs: list[dict[str, np.ndarray]] = []

    @property
    def title(self) -> str:
        number = f", {len(self.logs)} runs" if len(self.logs) > 1 else ""
        return f"{self.plan.title}{number}"

    @cached_property
    def sample(self) -> Sampled:
        """Independent samples of all logs."""
        pressure = self.plan.pressure if self.plan.moves_volume else None
        return validation.sampled(self.logs, self.plan.temperature, pressure)


#: The runs that a check concerns, and what it found.
Checked = tuple[str, Verdict]


def validate(runs: Sequence[Path], skip: float, limit: float) -> None:
    """Run `openmm-sier validate`.

    Args:
        runs: checkpoints, or directories of an ensemble's members.
        skip: ps to leave out at the beginning of each run.
        limit: standard errors beyond which a check fails.

    Raises:
        InvalidError: a check failed.
        RunError: nothing can be checked.
        RecordError, OSError: as their messages say.
    """
    points = _read(runs, skip)
    found = [*_at_constant_temperature(points), *_at_constant_energy(points)]
    if not found:
        raise RunError(
            "nothing can be checked: runs at constant energy need a second one with another step, and all need more "
            "samples"
        )
    rows, failed = [], []
    for title, verdict in found:
        # NaN fails too.
        passes = verdict.distance <= limit
        how_far, outcome = f"{verdict.distance:.1f}", "passes" if passes else "FAILS"
        rows.append([title, verdict.check, str(verdict.samples), verdict.detail, how_far, outcome])
        failed += [] if passes else [(verdict.distance, f"{verdict.check} of {title} by {how_far} standard errors")]
    table("Validation", ("runs", "check", "samples", "found", "standard errors", ""), rows, 2)
    note(f"a check fails beyond {limit:g} standard errors")
    if failed:
        raise InvalidError(f"{len(failed)} of {len(found)} checks failed, {max(failed)[1]}")


def _at_constant_temperature(points: Sequence[Point]) -> Iterator[Checked]:
    warm = [point for point in points if point.plan.ensemble != "nve"]
    for point in warm:
        yield from _tried(point.title, partial(validation.kinetic_verdicts, point.sample))
    pairs = list(_pairs(warm, ("temperature", "pressure")))
    for one, two in pairs:
        title = f"{one.plan.method.name}, {one.plan.ensemble.upper()}{one.plan.hydrogens}, {one.plan.dt:g} fs"
        yield from _tried(title, partial(_compared, one, two))
    if warm and not pairs:
        _tried(warm[0].title, partial(_suggested, warm[0]))


def _compared(one: Point, two: Point) -> list[Verdict]:
    return [validation.ensemble_verdict(one.sample, two.sample)]


def _suggested(point: Point) -> list[Verdict]:
    """Say which second run would add a check; there is no verdict."""
    interval = validation.suggested_interval(point.sample)
    names = {"dT": ("temperature", "K"), "dP": ("pressure", "bar")}
    runs = [f"{names[key][0]} higher by {value:.3g} {names[key][1]}" for key, value in interval.items()]
    if runs:
        note(f"{point.title}: a second run at a {', or one at a '.join(runs)} adds a check")
    return []


def _at_constant_energy(points: Sequence[Point]) -> Iterator[Checked]:
    still = [point for point in points if point.plan.ensemble == "nve"]
    for two, one in _pairs(still, ("dt",)):
        steps = one.plan.dt, two.plan.dt
        found = validation.fluctuation(one.logs), validation.fluctuation(two.logs)
        yield (f"{one.plan.method.name}, NVE", validation.order_verdict(steps, found, one.plan.method.order))


def _tried(title: str, check: Callable[[], list[Verdict]]) -> list[Checked]:
    try:
        return [(title, verdict) for verdict in check()]
    except TooFewError as error:
        note(f"{title}: {error}")
        return []


def _pairs(points: Sequence[Point], names: Sequence[str]) -> Iterator[tuple[Point, Point]]:
    """Pairs of neighbouring points whose plans differ in just one of the settings named."""
    for name in names:
        groups: dict[tuple, list[Point]] = {}
        for point in points:
            groups.setdefault(tuple(point.first.settings(but=name).values()), []).append(point)
        for group in groups.values():
            if getattr(group[0].plan, name) is not None:
                yield from pairwise(sorted(group, key=lambda point: getattr(point.plan, name)))


def _read(runs: Sequence[Path], skip: float) -> list[Point]:
    points: dict[tuple, Point] = {}
    for run in open_runs(runs):
        point = points.setdefault(tuple(run.settings().values()), Point(run))
        point.logs.append(run.log(skip))
    return list(points.values())
