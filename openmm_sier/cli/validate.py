"""The command `openmm-sier validate`: whether runs sampled the ensembles that they were asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from openmm_sier.cli.console import note, table
from openmm_sier.cli.finished_runs import FinishedRun, open_runs
from openmm_sier.cli.plan import Plan, RunError
from openmm_sier.measure import validation
from openmm_sier.measure.validation import Sampled, TooFewError, Verdict


class InvalidError(RuntimeError):
    """Runs did not sample what they were meant to."""

    exit_code = 5


class Point(NamedTuple):
    """Runs that differ in their seeds alone.

    Attributes:
        first: of the runs.
        logs: columns of the log of each run, without the skipped part.
    """

    first: FinishedRun
    logs: list[dict[str, np.ndarray]]

    @property
    def plan(self) -> Plan:
        return self.first.plan

    @property
    def title(self) -> str:
        number = f", {len(self.logs)} runs" if len(self.logs) > 1 else ""
        return f"{self.plan.title}{number}"


class Checked(NamedTuple):
    """A check and the runs that it concerns."""

    runs: str
    verdict: Verdict


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
    rows = [
        [one.runs, one.verdict.check, str(one.verdict.samples), one.verdict.detail, f"{one.verdict.distance:.1f}",
         "FAILS" if one.verdict.distance > limit else "passes"]
        for one in found
    ]  # fmt: skip
    table("Validation", ("runs", "check", "samples", "found", "standard errors", ""), rows, 2)
    note(f"a check fails beyond {limit:g} standard errors")
    if failed := [one for one in found if not one.verdict.distance <= limit]:
        worst = max(failed, key=lambda one: one.verdict.distance)
        raise InvalidError(
            f"{len(failed)} of {len(found)} checks failed, {worst.verdict.check} of {worst.runs} by "
            f"{worst.verdict.distance:.1f} standard errors"
        )


def _at_constant_temperature(points: Sequence[Point]) -> Iterator[Checked]:
    samples = [
        (point, validation.sampled(point.logs, point.plan.temperature, _pressure(point.plan)))
        for point in points
        if point.plan.ensemble != "nve"
    ]
    for point, sample in samples:
        yield from _tried(point.title, partial(validation.kinetic_verdicts, sample))
    pairs = list(_pairs(samples, lambda pair: pair[0], ("temperature", "pressure")))
    for (one, first), (_, second) in pairs:
        title = f"{one.plan.method.name}, {one.plan.ensemble.upper()}, {one.plan.dt:g} fs"
        yield from _tried(title, partial(_compared, first, second))
    if samples and not pairs:
        _suggest(*samples[0])


def _compared(one: Sampled, two: Sampled) -> list[Verdict]:
    return [validation.ensemble_verdict(one, two)]


def _suggest(point: Point, sample: Sampled) -> None:
    interval = validation.suggested_interval(sample)
    pressure = f", or one of a pressure higher by {interval['dP']:.3g} bar" if "dP" in interval else ""
    note(f"{point.title}: a second run at a temperature higher by {interval['dT']:.3g} K{pressure} adds a check")


def _at_constant_energy(points: Sequence[Point]) -> Iterator[Checked]:
    still = [point for point in points if point.plan.ensemble == "nve"]
    for two, one in _pairs(still, lambda point: point, ("dt",)):
        steps = one.plan.dt, two.plan.dt
        found = validation.fluctuation(one.logs), validation.fluctuation(two.logs)
        yield Checked(f"{one.plan.method.name}, NVE", validation.order_verdict(steps, found, one.plan.method.order))


def _tried(title: str, check: Callable[[], list[Verdict]]) -> list[Checked]:
    try:
        return [Checked(title, verdict) for verdict in check()]
    except TooFewError as error:
        note(f"{title}: {error}")
        return []


def _pressure(plan: Plan) -> float | None:
    return plan.pressure if plan.moves_volume else None


def _pairs(items: Sequence[Any], point_of: Callable[[Any], Point], names: Sequence[str]) -> Iterator[tuple[Any, Any]]:
    """Pairs of neighbouring items whose points differ in just one of the settings named."""
    for name in names:
        groups: dict[tuple, list[Any]] = {}
        for item in items:
            groups.setdefault(tuple(point_of(item).first.settings(but=name).values()), []).append(item)
        for group in groups.values():
            if getattr(point_of(group[0]).plan, name) is not None:
                yield from pairwise(sorted(group, key=lambda item: getattr(point_of(item).plan, name)))


def _read(runs: Sequence[Path], skip: float) -> list[Point]:
    points: dict[tuple, Point] = {}
    for run in open_runs(runs):
        point = points.setdefault(tuple(run.settings().values()), Point(run, []))
        point.logs.append(run.log(skip))
    return list(points.values())
