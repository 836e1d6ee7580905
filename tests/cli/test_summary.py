"""`summary`: means over runs whose statistics are known."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.analysis.statistics import Estimate, over_runs
from openmm_sier.cli import run as run_command
from openmm_sier.cli.logged_runs import read_run
from openmm_sier.cli.results import Quantity
from tests.support.commands import complaint, contents, run
from tests.support.logs import write_log, write_notes

POTENTIAL, DENSITY = "Potential Energy (kJ/mole)", "Density (g/mL)"


def written(name="a.json"):
    """The means of a file by their names, and the rest of it."""
    read = json.loads(Path(name).read_text())
    return {each["name"]: each for each in read.pop("means")}, read


@pytest.fixture
def logs():
    names = [f"seed{seed}.csv" for seed in range(1, 9)]
    return {name: write_log(name, "npt", seed=seed) for seed, name in enumerate(names, 1)}


def test_means_are_over_runs_and_errors_from_their_scatter(logs, capsys):
    run("summary", *logs, "--json", "a.json")
    means, rest = written()
    values = [log[DENSITY].mean() for log in logs.values()]
    density = means["density"]
    assert density["unit"] == "g/ml"
    assert [each["value"] for each in density["runs"]] == pytest.approx(values)
    assert density["value"] == pytest.approx(np.mean(values))
    assert density["error"] == pytest.approx(np.std(values, ddof=1) / math.sqrt(8))
    assert (rest["runs"], rest["length"], rest["left_out"], rest["settled"]) == (list(logs), 20, 0, True)
    output = capsys.readouterr().out
    assert "8 runs, 20 ps" in output
    assert "mean over 8 runs" in output
    assert f"{Estimate(density['value'], density['error'], 8)} g/ml" in output
    assert output.count("20 ps without a trend of energy, temperatures or density") == 1
    assert "wrote a.json" in output


def test_of_fewer_than_five_runs_the_errors_are_those_of_each(logs):
    run("summary", *list(logs)[:3], "--json", "a.json")
    density = written()[0]["density"]
    assert density["error"] == pytest.approx(math.hypot(*(each["error"] for each in density["runs"])) / 3)


def test_a_short_run_whose_volume_never_moved_is_of_the_same_kind():
    """Its checkpoint says that its pressure is constant."""
    write_log("moved.csv", "npt", seed=1)
    log = write_log("still.csv", "npt", seed=2, change=lambda log: log.update({DENSITY: np.full(501, 0.997)}))
    for seed, name in enumerate(("moved.csv", "still.csv"), 1):
        write_notes(name, "npt", seed)
    run("summary", "moved.csv", "still.csv", "--json", "a.json")
    assert [each["value"] for each in written()[0]["density"]["runs"]][1] == pytest.approx(log[DENSITY].mean())


def test_unsettled_beginnings_are_left_out_and_reported(capsys):
    def warm(log):
        log[POTENTIAL] = log[POTENTIAL] + 300 * np.exp(-log["Time (ps)"])

    for seed in (1, 2, 3):
        write_log(f"seed{seed}.csv", "nvt", seed=seed, change=warm)
    run("summary", "seed1.csv", "seed2.csv", "seed3.csv", "--json", "a.json")
    _, rest = written()
    assert rest["moved_before"] == ["potential energy"]
    message = f"Settled after {rest['left_out']:.4g} ps: potential energy. Means are of the rest"
    assert message in capsys.readouterr().out
    run("summary", "seed1.csv", "seed2.csv", "seed3.csv", "--skip", "2", "--json", "a.json", "--overwrite")
    means, rest = written()
    assert rest["left_out"] == 2
    assert "the first 2 ps" in capsys.readouterr().out
    # Rows come every 0.04 ps.
    kept = np.loadtxt("seed1.csv", delimiter=",", skiprows=1)[50:, 2]
    assert means["potential energy V"]["runs"][0]["value"] == pytest.approx(kept.mean())


@pytest.mark.parametrize("ensemble", ["nve", "nvt", "npt", "hmc"])
def test_every_ensemble_and_a_single_run(ensemble):
    """JSON has no NaN, which is what most readers refuse."""
    for seed in (1, 2):
        write_log(f"seed{seed}.csv", ensemble, seed=seed)
        write_notes(f"seed{seed}.csv", ensemble, seed)
    run("summary", "seed1.csv", "--json", "one.json")
    run("summary", "seed1.csv", "seed2.csv", "--json", "two.json")
    one, two = written("one.json")[0], written("two.json")[0]
    assert list(one) == list(two)
    for name, mean in two.items():
        first, second = (each["value"] for each in mean["runs"])
        assert one[name]["value"] == first
        assert mean["value"] == pytest.approx((first + second) / 2)
    assert ("trials accepted" in two) == (ensemble == "hmc")
    assert ("rms(H)/rms(V)" in two) == (ensemble == "nve")
    assert ("density" in two) == (ensemble == "npt")


@pytest.mark.parametrize("rows", [slice(1, None), slice(1, 301), slice(1, None, 5)])
def test_logs_of_one_run_draw_a_warning(rows, capsys):
    """A copy, a part of it, and one with fewer rows."""
    write_log("a.csv", "npt")
    write_log("other.csv", "npt", seed=2)
    heading, *lines = Path("a.csv").read_text().splitlines(keepends=True)
    Path("copy.csv").write_text("".join([heading, *lines[rows]]))
    run("summary", "a.csv", "other.csv")
    assert "warning" not in capsys.readouterr().out
    run("summary", "a.csv", "other.csv", "copy.csv")
    output = capsys.readouterr().out
    assert output.count("warning: a.csv and copy.csv are logs of one run, or have the same seed") == 1


def test_logs_without_a_common_step_are_of_different_runs(capsys):
    write_log("a.csv", "npt")
    heading, *lines = Path("a.csv").read_text().splitlines(keepends=True)
    Path("later.csv").write_text("".join([heading, *(f"9{line}" for line in lines[2:5])]))
    run("summary", "a.csv", "later.csv")
    assert "warning" not in capsys.readouterr().out


@pytest.mark.parametrize(("ensemble", "warns"), [("nvt", True), ("nve", False)])
def test_runs_with_one_seed_have_the_same_noise(ensemble, warns, capsys):
    """By their checkpoints, as forces of a GPU are rounded differently in each run."""
    for name, seed in (("a.csv", 1), ("b.csv", 2), ("c.csv", 1)):
        write_log(name, ensemble, seed=len(name) + ord(name[0]))
        write_notes(name, ensemble, seed)
    run("summary", "a.csv", "b.csv")
    assert "warning" not in capsys.readouterr().out
    run("summary", "a.csv", "b.csv", "c.csv")
    assert ("warning: a.csv and c.csv are logs of one run, or have the same seed" in capsys.readouterr().out) == warns


def test_numbers_of_a_table():
    assert str(Quantity("potential energy V", Estimate(-2555.0, 0.0), "kJ/mol")) == "-2555 kJ/mol"
    assert str(Quantity("fluctuation rms(H)", 2555.4, "kJ/mol")) == "2555 kJ/mol"
    assert str(Quantity("trials accepted", 98.76, "%", ".1f")) == "98.8 %"
    assert str(Quantity("rms(H)/rms(V)", math.nan, "%")) == "-"


def test_numbers_without_errors_have_that_of_their_scatter_over_runs():
    assert over_runs([2.0]) == 2.0
    assert str(over_runs([1.0, 3.0])) == "2.0 ± ≥1.0"
    assert over_runs([Estimate(1, 0.3, 10), Estimate(3, 0.4, 20)]) == (2, 0.25, 30)


def test_no_log_is_destroyed(logs, capsys):
    before = contents(Path())
    for name in ("seed2.csv", "none/a.json"):
        complaint(capsys, "summary", *logs, "--json", name)
    complaint(capsys, "summary", *logs, "--plot", "seed2.csv", code=2)
    assert contents(Path()) == before


@pytest.mark.parametrize("name", ["a.chk", "a.dcd", "a.csv", "mine.json"])
def test_numbers_in_the_way_are_refused(logs, capsys, name):
    """Files of the run too, of which the command knows only the log."""
    Path(name).write_text("mine")
    before = contents(Path())
    message = complaint(capsys, "summary", *logs, "--json", name)
    assert f"{name} exists: give another name, or replace it with --overwrite" in message
    assert contents(Path()) == before
    run("summary", *logs, "--json", name, "--overwrite")
    assert "means" in Path(name).read_text()


@pytest.mark.parametrize(
    ("column", "row", "value", "said"),
    [
        ("Step", 100, 50, "in row 101, Step is not above that of the row before"),
        ("Step", 100, 99, "in row 101, Step is not above"),
        ("Step", 0, -50, "in row 1, Step is not above that of the row before, or negative"),
        ("Time (ps)", 7, math.nan, "in row 8, Time (ps) is not above"),
        ("Time (ps)", 500, math.inf, "in row 501, Time (ps) is not finite"),
        (POTENTIAL, 3, math.nan, "in row 4, Potential Energy (kJ/mole) is not finite"),
        (POTENTIAL, 3, 1e308, "in row 4, Potential Energy (kJ/mole) is not finite"),
        ("Conserved Energy (kJ/mole)", 3, math.inf, "in row 4, Conserved Energy (kJ/mole) is not finite"),
    ],
)
def test_rows_that_no_run_writes_are_refused(capsys, column, row, value, said):
    def change(log):
        log[column] = log[column].astype(float)
        log[column][row] = value

    write_log("a.csv", change=change)
    assert f"a.csv was edited or damaged: {said}" in complaint(capsys, "summary", "a.csv")


def test_the_table_of_a_run_is_of_the_part_of_its_summary(capsys):
    """The beginning, which had not settled, is left out of both."""

    def warm(log):
        log[DENSITY] = log[DENSITY] - 0.3 * np.exp(-log["Time (ps)"])

    write_log("a.csv", "npt", change=warm)
    write_notes("a.csv", "npt")
    densities = []
    for report in (
        lambda: run_command._report(read_run(Path("a.csv")).plan, [], None),
        lambda: run("summary", "a.csv"),
    ):
        report()
        output = capsys.readouterr().out
        assert "Means are of the rest" in output
        densities += re.findall(r"density +│ +(.*g/ml)", output)
    assert len(densities) == 2
    assert densities[0] == densities[1]
