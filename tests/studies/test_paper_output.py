"""Tables, files and figures of the paper's experiments, and the function behind the command."""

from __future__ import annotations

import csv
import json
import math
import sys
from dataclasses import replace

import pytest

from openmm_sier.cli.main import build_parser
from studies import paper
from studies.paper import dipole, figures, free_rotation, liquids, output, published, tables, water_runs
from studies.paper.free_rotation import Cost, Curve, FreeRotation
from studies.paper.methods import METHODS
from studies.paper.water import Crossing, Point, Water
from tests.support.reports import Told

PNG = b"\x89PNG"


def rotation_result():
    def curve(method, step, tau):
        times = (0.1, 1.0, 10.0)
        delta = tuple(t / 10 / tau for t in times)
        return Curve(method, step, times, delta, delta, 1e-6, tau, 0.1 * tau, 2 * tau, 1.0, tau)

    taus = {"MRDL": 8.0, "SEJ4": 2e3, "SIER2": 1e11, "SIER4": 5e10}
    curves = tuple(curve(method, step, tau) for step in (1.66, 8.0) for method, tau in taus.items())
    costs = tuple(Cost(method, 8.0, 200.0, ratio, ratio, ratio) for method, ratio in (("MRDL", 1.0), ("SIER2", 1.8)))
    return FreeRotation(free_rotation.FreeRotationSettings(seed=77), (1.0, 2.0, 3.0), curves, costs)


def water_result(runs=2):
    points = [
        Point(liquids.MOLECULAR, method, step, 1e-3 * step**2, 1e-4, 0.1, 50.0, 0.01, runs)
        for method in ("MRDL", "SEJ4", "SIER2", "SIER4")
        for step in (1.0, 2.0)
    ]
    crossing = Crossing(liquids.MOLECULAR, 2.0, 0.1, {"SIER2": 2.03, "SIER4": 4.0})
    return Water(water_runs.QUICK, "made", 1.9, tuple(points), (crossing,))


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (1.8, 0.3, "1.80 ± 0.30"),
        (0.0035, 0.0005, "0.00350 ± 0.00050"),
        (51.0, 7.0, "51.0 ± 7.0"),
        (1234.0, 56.0, "1234 ± 56"),
        (2.2e-5, 1e-6, "(2.20 ± 0.10)e-5"),
        (2.5e6, 3e5, "(2.50 ± 0.30)e6"),
        (0.12345, None, "0.123"),
        (0.12345, math.nan, "0.123"),
        (math.nan, 1.0, "-"),
    ],
)
def test_numbers(value, error, text):
    assert tables.number(value, error) == text


@pytest.mark.parametrize(
    ("value", "text"), [(117.0, "117 ps"), (0.91e6, "910 ns"), (2.1e3, "2.1 ns"), (16e9, "16 ms"), (math.inf, "-")]
)
def test_times(value, text):
    assert tables.picoseconds(value) == text


def test_times_to_be_compared_have_one_unit():
    assert tables.picoseconds(0.91e6, like=1.1e6) == "0.91 µs"
    assert tables.picoseconds(48e9, like=1.2e12) == "0.048 s"


def cells(table):
    assert all(len(row) == len(table.columns) for row in table.rows)
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def test_tables_have_the_papers_values_beside_ours():
    rows = cells(tables.tau_table(rotation_result()))
    first = next(row for row in rows if row["method"] == "MRDL" and row["h (fs)"] == "8")
    assert first["paper"] == "7.6 ps"
    assert first["tau"] == "8.00 ± 0.80 ps"
    assert first["ratio"] == "1.05"
    assert next(row for row in rows if row["method"] == "SIER4")["paper"] == "as SIER2"

    small = dipole.turn_in_field(dipole.DipoleSettings(bodies=20, span=0.1))
    energies = cells(tables.dipole_energy_table(small))
    assert len(energies) == 12
    assert energies[0]["paper"] == "1.80 ± 0.30"
    assert float(energies[0]["ratio"]) == pytest.approx(100 * small.entries[0].energy / 1.8, abs=0.006)
    momenta = cells(tables.dipole_momentum_table(small))
    assert momenta[1]["paper"] == "1.4e-06"

    table = tables.water_table(water_result(), liquids.MOLECULAR)
    assert "216 molecules (the paper: 512)" in table.title
    assert cells(table)[1] == {"h/f (fs)": "2", **dict.fromkeys(("MRDL", "SEJ4", "SIER2", "SIER4"), "0.400 ± 0.010")}
    crossing = cells(tables.crossing_table(water_result()))[0]
    assert crossing["ratio"] == "1.11"
    assert (crossing["slope SIER2"], crossing["slope SIER4"]) == ("2.03", "4.00")
    assert cells(tables.water_table(water_result(0), liquids.MOLECULAR))[0]["SIER4"] == "breaks"
    assert cells(tables.cost_table(rotation_result()))[1]["paper, over MRDL"] == "1.7 - 2"


def test_published_values_are_complete():
    """All twelve entries of both halves of Table 1, and tau for three methods at two steps."""
    assert len(published.ENERGY) == len(published.MOMENTUM) == 12
    assert len(published.TAU) == 6


def test_json_has_everything(tmp_path):
    result = replace(water_result(), crossings=(Crossing(liquids.PME, math.nan, math.nan, {"SIER2": 2.0}),))
    output.write_json(tmp_path / "water.json", result, 12.34)
    content = json.loads((tmp_path / "water.json").read_text())
    assert content["versions"]["numpy"]
    assert content["versions"]["openmm-sier"]
    assert content["seconds"] == 12.3
    settings = content["result"]["settings"]
    assert settings["seed"] == 1
    assert settings["cutoffs"]["molecular_off"] == 0.9
    assert content["result"]["crossings"][0]["force_step_fs"] is None
    assert content["result"]["points"][0]["energy"] == 1e-3


def test_csv_has_a_row_for_each_point(tmp_path):
    output.write_csv(tmp_path / "a.csv", rotation_result().curves)
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8 * 3
    assert float(rows[2]["times"]) == 10
    assert float(rows[2]["delta"]) == pytest.approx(10 / 80)
    assert rows[2]["method"] == "MRDL"


def test_figures(tmp_path):
    figures.free_rotation(rotation_result(), tmp_path / "a.png")
    figures.dipole(dipole.turn_in_field(dipole.DipoleSettings(bodies=20, span=0.1)), tmp_path / "b.png")
    figures.water(water_result(), tmp_path / "c.png")
    no_crossing = replace(water_result(0), crossings=(Crossing(liquids.MOLECULAR, math.nan, math.nan, {}),))
    figures.water(no_crossing, tmp_path / "d.png")
    for name in "abcd":
        data = (tmp_path / f"{name}.png").read_bytes()
        assert data.startswith(PNG)
        assert len(data) > 20_000


def test_run_writes_and_reports(tmp_path, monkeypatch):
    """The function behind `openmm-sier paper`, for two small experiments."""
    monkeypatch.setattr(dipole, "QUICK", dipole.DipoleSettings(bodies=20, span=0.1))
    tiny = free_rotation.FreeRotationSettings(span=0.2, bodies=10, exact_bodies=2, timed_bodies=10, timings=2)
    monkeypatch.setattr(free_rotation, "QUICK", tiny)
    for name in ("dipole", "free-rotation"):
        told = Told()
        found = paper.run(name, quick=True, out=tmp_path / "deep" / "er", seed=9, report=told)
        assert "expected to take about" in told.notes[0]
        assert told.tables == found[name].tables
        assert all({"ratio", "paper"} & set(table.columns) for table in told.tables[:1])
        ((_, fractions),) = told.runs
        assert fractions == sorted(fractions)
        assert fractions[-1] == pytest.approx(1)
        for ending in ("json", "csv", "png"):
            assert (tmp_path / "deep" / "er" / f"{name}.{ending}").stat().st_size > 0
        content = json.loads((tmp_path / "deep" / "er" / f"{name}.json").read_text())
        assert content["result"]["settings"]["seed"] == 9


def runs_of_water(members, place, processes, report):
    """In place of the ensemble: what its members would write."""
    assert [member.name for member in members] == ["molecular-1", "molecular-2"]
    for member in members:
        assert build_parser().parse_args(member.arguments).phase_point == member.name
        (place / member.name).mkdir(parents=True)
        point = water_runs.phase_point(member.name, water_runs.QUICK)
        runs = [
            water_runs.Run(method.name, step, (1e-3 * step**order, 1.0, 0.01))
            for method, order in zip(METHODS, (2, 2, 2, 4), strict=True)
            for step in water_runs.QUICK.steps_of(method, point)
        ]
        water_runs.keep_runs(runs, place / member.name)


def test_all_runs_every_experiment(tmp_path, monkeypatch):
    monkeypatch.setattr(free_rotation, "rotate_freely", lambda settings, show: rotation_result())
    monkeypatch.setattr(dipole, "QUICK", dipole.DipoleSettings(bodies=20, span=0.1))
    monkeypatch.setattr(water_runs, "QUICK", replace(water_runs.QUICK, kinds=(liquids.MOLECULAR,)))
    monkeypatch.setattr(paper, "ensemble", runs_of_water)
    told = Told()
    paper.run("all", quick=True, out=tmp_path, report=told)
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == {
        f"{name}.{ending}" for name in paper.EXPERIMENTS for ending in ("json", "csv", "png")
    }
    (table,) = [table for table in told.tables if table.title.startswith("Liquid water, molecular")]
    assert cells(table)[2]["SIER4"] == "0.384"


def test_unknown_experiment(tmp_path):
    with pytest.raises(ValueError, match="must be one of free-rotation"):
        paper.run("ice", out=tmp_path)


@pytest.mark.parametrize(("missing", "message"), [("matplotlib", r"openmm-sier\[plots\]"), ("mpmath", "needs mpmath")])
def test_missing_extras_are_named_before_anything_is_computed(tmp_path, monkeypatch, missing, message):
    """One sentence with the remedy."""
    monkeypatch.setattr(free_rotation, "rotate_freely", lambda *_: pytest.fail("computed"))
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ModuleNotFoundError, match=message):
        paper.run("free-rotation", quick=True, out=tmp_path / "none")
    assert not (tmp_path / "none").exists()
