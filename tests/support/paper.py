"""Runs of the paper's experiment on water whose errors are known, in place of those that an ensemble would make."""

from __future__ import annotations

import pandas as pd

from studies import paper, records
from studies.methods import PAPER
from studies.paper import water_runs


def runs_of_water(settings, broken=()):
    """Runs whose errors are powers of the step."""
    return [
        {"kind": kind, "number": number, "method": method.name, "force_step_fs": step}
        | ({} if method.name in broken else {"rms_H": 1e-3 * step**method.order, "rms_V": 1.0, "drift": 0.01})
        for kind in settings.kinds
        for number in (1, 2)
        for method in PAPER
        for step in settings.steps_of(method, water_runs.PhasePoint(kind, number))
    ]


def members_of_water(members, place, processes, report):
    """In place of the ensemble: what its members would write."""
    assert [member.name for member in members] == ["molecular-1", "molecular-2"]
    for member in members:
        settings = water_runs.QUICK
        assert member.module == paper.MEMBER
        assert member.arguments[:3] == ("water", "--phase-point", member.name)
        (place / member.name).mkdir(parents=True)
        kind, number = water_runs.phase_point(member.name, settings)
        runs = [run for run in runs_of_water(settings) if (run["kind"], run["number"]) == (kind, number)]
        records.replace_file(place / member.name / water_runs.FILE, pd.DataFrame(runs).to_json(orient="records"))
