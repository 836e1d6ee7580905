"""Reading finished runs: what may be pooled, and files that are not as their runs wrote them."""

from __future__ import annotations

import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.cli.files.records import RecordError
from openmm_sier.cli.finished_runs import FREE, FinishedRun, open_runs
from openmm_sier.cli.plan import Options, Plan, RunError, new_plan
from openmm_sier.observe import pressure
from tests.support.canonical import log
from tests.support.finished_runs import note_count, write_rows, write_run

ROWS = 40


def rows_of(name):
    return open_runs([Path(name)])[0].log(0)


def test_a_log_is_read_as_it_was_written():
    values = log(rows=ROWS)
    found = rows_of(write_run("a", values))
    # Logs have twelve digits.
    for name, column in values.items():
        np.testing.assert_allclose(found[name], column, rtol=1e-11)
    assert list(found["Step"][:3]) == [0, 10, 20]
    run = open_runs([Path("a/run.chk")])[0]
    assert list(run.log(10.5)["Time (ps)"]) == list(range(11, ROWS))
    assert run.tensors(0) is None


FAULTS = {
    "repeated": (lambda lines: lines.insert(6, lines[5]), "expected 40 rows, one every 10 steps"),
    "short": (lambda lines: lines.pop(), "expected 40 rows, one every 10 steps"),
    "no number": (lambda lines: lines.__setitem__(3, lines[3].replace("2,", "two,", 1)), "could not convert string"),
    "cut off": (lambda lines: lines.__setitem__(-1, lines[-1][:30]), "number of columns changed"),
    "heading": (lambda lines: lines.pop(0), "expected a heading with Step"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_rows_that_are_not_those_of_the_run_are_refused(fault):
    change, message = FAULTS[fault]
    path = Path(write_run("a", log(rows=ROWS))) / "run.csv"
    lines = path.read_text().splitlines()
    change(lines)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordError, match=f"{path}.*{message}"):
        rows_of("a")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_no_number_is_named(value):
    values = log(rows=ROWS)
    values["Potential Energy (kJ/mole)"][7] = value
    with pytest.raises(RecordError, match=rf"run\.csv: Potential Energy \(kJ/mole\) is {value} in row 8"):
        rows_of(write_run("a", values))
    # Temperatures of motion that there is not are NaN from end to end, energies are not.
    assert np.isnan(rows_of(write_run("b", log(rows=ROWS)))["Flexible Temperature (K)"]).all()
    with pytest.raises(RecordError, match=r"Kinetic Energy .* in row 1"):
        rows_of(write_run("c", log(rows=ROWS) | {"Kinetic Energy (kJ/mole)": np.full(ROWS, np.nan)}))


def test_tensors_begin_one_interval_later():
    write_run("a", log(rows=ROWS), pressure_tensor=Path("a/p.csv"), dt=4.0)
    columns = dict.fromkeys(pressure.COLUMNS, np.ones(ROWS)) | {"Step": 5 * np.arange(1, ROWS + 1)}
    write_rows(Path("a/p.csv"), columns)
    note_count("a/run.chk", "tensors", ROWS)
    assert len(open_runs([Path("a")])[0].tensors(0)["Step"]) == ROWS
    write_rows(Path("a/p.csv"), columns | {"Step": 5 * np.arange(ROWS)})
    with pytest.raises(RecordError, match=r"p\.csv: expected 40 rows"):
        open_runs([Path("a")])[0].tensors(0)


# --- what is pooled ---


def test_settings_are_those_that_define_the_liquid_and_its_state():
    plan = new_plan(Options(Path("box.pdb"), ensemble="nvt"))
    first = FinishedRun(Path("run.chk"), plan, {})
    for field in fields(Plan):
        other = FinishedRun(Path("run.chk"), replace(plan, **{field.name: "changed"}), {})
        assert (other.settings() == first.settings()) == (field.name in FREE), field.name
        assert other.settings(but=field.name) == first.settings(but=field.name)
    assert set(FREE) < {field.name for field in fields(Plan)}


def test_a_box_is_one_by_whatever_path(tmp_path):
    near = new_plan(Options(Path("box.pdb")))
    far = new_plan(Options(tmp_path / "box.pdb"))
    assert FinishedRun(Path("a"), near, {}).settings() == FinishedRun(Path("b"), far, {}).settings()


def test_no_run_counts_twice():
    write_run("a", log(rows=ROWS))
    shutil.copytree("a", "copy")
    for other in ("a", "a/run.chk", "copy"):
        with pytest.raises(RunError, match=r"run\.chk is the same run as a/run\.chk: it would count twice"):
            open_runs([Path("a"), Path(other)])
    write_run("b", log(rows=ROWS, seed=2), seed=2)
    assert len(open_runs([Path("a"), Path("b")])) == 2
