"""Runs of studies in the process of the test, where its patches apply."""

from __future__ import annotations

from studies import records


def make_here(path, tasks, run, processes):
    """In place of `records.make_missing`."""
    kept = records.kept_runs(path)
    for task in tasks:
        if not any(task.point.items() <= each.items() for each in kept):
            records.keep_run(path, made := run(task))
            yield made
