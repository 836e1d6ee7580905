"""Tables, files and figures of the paper's experiments, and the function behind the command."""

from dataclasses import replace

import pandas as pd
import pytest

from studies import records
from studies.paper import dipole, free_rotation, liquids, water, water_runs
from tests.support.paper import runs_of_water

TINY = free_rotation.FreeRotationSettings(span=0.2, bodies=10, exact_bodies=2, timed_bodies=10, timings=2)


def cells(table):
    assert all(len(row) == len(table.columns) for row in table.rows)
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


@pytest.mark.slow
def test_free_rotation_is_told_beside_the_paper():
    record = free_rotation.find(TINY)
    tau = {"MRDL": 8.0, "SEJ4": 2e3, "SIER2": 1e11, "SIER4": 5e10}
    taus = record.tables["taus"]
    taus["tau"] = taus["method"].map(tau)
    taus["tau_error"] = taus["tau"] / 10
    table, costs = free_rotation.tables(record)
    rows = cells(table)
    first = next(row for row in rows if row["method"] == "MRDL" and row["h (fs)"] == "8")
    assert (first["paper"], first["tau"], first["ratio"]) == ("7.6 ps", "8.00 ± 0.80 ps", "1.05")
    assert next(row for row in rows if row["method"] == "SIER4")["paper"] == "as SIER2"
    paper_costs = {row["map"]: row["paper, over MRDL"] for row in cells(costs)}
    assert paper_costs == {"MRDL": "1", "exact": "1.7 - 2", "SEJ4": "2 - 2.4", "exact, Numba": "-"}


def test_the_dipole_is_told_beside_the_paper():
    record = dipole.find(dipole.DipoleSettings(bodies=20, span=0.1))
    energies, momenta = map(cells, dipole.tables(record))
    assert len(energies) == 12
    assert energies[0]["paper"] == "1.80 ± 0.30"
    assert float(energies[0]["ratio"]) == pytest.approx(record.tables["rows"]["energy"][0] / 1.8, abs=0.006)
    assert momenta[1]["paper"] == "1.4e-06"


def test_water_is_told_beside_the_paper(tmp_path):
    settings = replace(water_runs.QUICK, kinds=(liquids.MOLECULAR,))
    record = water.evaluate(settings, 1.9, runs_of_water(settings))
    table, crossing = water.tables(record)
    assert "216 molecules (the paper: 512)" in table.title
    assert [row["SIER4"] for row in cells(table)[1:3]] == ["0.1", "0.3842"]
    (found,) = cells(crossing)
    # Curves of h^2 and h^4 cross at 1 fs.
    assert (found["ours"], found["ratio"]) == ("1", "0.56")
    assert (found["slope SIER2"], found["slope SIER4"]) == ("2.00", "4.00")
    record.write(tmp_path / "water.json")
    again = records.read(tmp_path / "water.json")
    pd.testing.assert_frame_equal(again.tables["points"], record.tables["points"])
    water.figure(again, tmp_path / "water.png")
    assert (tmp_path / "water.png").stat().st_size > 20_000
    broken = water.evaluate(settings, 1.9, runs_of_water(settings, ("SIER4",)))
    assert cells(water.tables(broken)[0])[0]["SIER4"] == "breaks"
    assert cells(water.tables(broken)[1])[0]["ratio"] == "-"
    water.figure(broken, tmp_path / "broken.png")
