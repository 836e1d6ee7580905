"""`summary`: means over runs whose statistics are known."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.analysis.statistics import Estimate, over_runs
from openmm_sier.cli.results import Quantity
from tests.support.commands import SMALL, complaint, contents, run
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
    assert f"{Estimate(density['value'], density['error'])} g/ml" in output
    # Findings follow the table, once.
    assert output.count("Rotation: no difference from translation shows within") == 1
    lowest = list(logs)[int(np.argmin(values))].removesuffix(".csv")
    # As many digits as the mean has.
    digits = len(str(Estimate(density["value"], density["error"])).split()[0].partition(".")[2])
    assert f"{min(values):.{digits}f} ({lowest})" in output
    assert "wrote a.json" in output


def test_of_fewer_than_five_runs_the_errors_are_those_of_each(logs):
    run("summary", *list(logs)[:3], "--json", "a.json")
    density = written()[0]["density"]
    assert density["error"] == pytest.approx(math.hypot(*(each["error"] for each in density["runs"])) / 3)


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
    run("summary", "seed1.csv", "seed2.csv", "seed3.csv", "--skip", "2", "--json", "a.json")
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


def test_logs_of_one_run_count_once(capsys):
    """Copies, also of a part of it, with other rows, and a log that continues differently."""
    whole = write_log("a.csv", "npt")
    write_log("other.csv", "npt", seed=2)
    Path("copy.csv").write_bytes(Path("a.csv").read_bytes())
    lines = Path("a.csv").read_text().splitlines(keepends=True)
    Path("part.csv").write_text("".join(lines[:301]))
    Path("seldom.csv").write_text("".join([lines[0], *lines[1::5]]))
    # Three steps that it does not have.
    Path("later.csv").write_text("".join([lines[0], *(f"9{line}" for line in lines[2:5])]))
    run("summary", "part.csv", "copy.csv", "other.csv", "a.csv", "seldom.csv", "--json", "a.json")
    means, rest = written()
    assert rest["runs"] == ["copy.csv", "other.csv"]
    assert means["density"]["runs"][0]["value"] == pytest.approx(whole[DENSITY].mean())
    output = capsys.readouterr().out
    assert "mean over 2 runs" in output
    assert "warning: copy.csv, a.csv, part.csv and seldom.csv are logs of one run, which counts once" in output
    run("plot", "a.csv", "copy.csv")
    assert "warning: a.csv and copy.csv are logs of one run, which counts once" in capsys.readouterr().out
    run("summary", "a.csv", "other.csv", "later.csv", "--json", "a.json")
    assert len(written()[1]["runs"]) == 3


@pytest.mark.thorough
def test_runs_of_one_seed_are_recognized_by_their_checkpoints(box, capsys):
    """The same command twice; with more rows; from another start; with a log that a GPU would round otherwise."""
    command = ["run", box, *SMALL, "--ensemble", "nvt", "--time", "0.2"]
    for out, more in (
        ("a", []),
        ("again", ["--report-every", "0.02"]),
        ("two", ["--seed", "2"]),
        ("on", ["--start", "a.chk", "--equilibrate", "0.02"]),
    ):
        run(*command, *more, "--out", f"{out}.dcd")
    lines = Path("a.csv").read_text().splitlines(keepends=True)
    run(*command, "--out", "gpu.dcd")
    Path("gpu.csv").write_text("".join([*lines[:2], *(line.replace(".", ".0", 2) for line in lines[2:])]))
    capsys.readouterr()
    run("summary", "a.csv", "again.csv", "two.csv", "gpu.csv")
    output = capsys.readouterr().out
    assert "mean over 2 runs" in output
    assert (
        "warning: again.csv, a.csv and gpu.csv are logs of one run, which counts once. Give each run a --seed" in output
    )
    assert "noise" not in output
    run("summary", "a.csv", "on.csv", "two.csv")
    output = capsys.readouterr().out
    assert "mean over 3 runs" in output
    assert (
        "warning: a.csv and on.csv have the same seed, settings and inputs, and so the same noise: give each run"
        in output
    )


def test_numbers_of_a_table_are_written_alike(capsys):
    """A mean without an error has no digits to go by: -2555 stood beside -2.56e+03."""
    for seed in (1, 2):
        write_log(
            f"seed{seed}.csv", "nvt", seed=seed, change=lambda log: log.update({POTENTIAL: 0 * log["Step"] - 2555})
        )
    run("summary", "seed1.csv", "seed2.csv")
    row = next(line for line in capsys.readouterr().out.splitlines() if "potential energy V" in line)
    assert [cell.strip() for cell in row.split("│")[2:5]] == ["-2555 kJ/mol", "-2555 (seed1)", "-2555 (seed2)"]
    assert str(Quantity("fluctuation rms(H)", 2555.4, "kJ/mol")) == "2555 kJ/mol"


def test_numbers_without_errors_have_that_of_their_scatter_over_runs():
    assert over_runs([2.0]) == 2.0
    assert str(over_runs([1.0, 3.0])) == "2.0 ± ≥1.0"
    assert over_runs([Estimate(1, 0.3, 10), Estimate(3, 0.4, 20)]) == (2, 0.25, 30)


def test_a_picture_with_it():
    pytest.importorskip("matplotlib")
    for seed in (1, 2):
        write_log(f"seed{seed}.csv", rows=60, seed=seed)
    run("summary", "seed1.csv", "seed2.csv", "--plot", "a.png")
    assert Path("a.png").read_bytes().startswith(b"\x89PNG")


def test_no_log_is_destroyed(logs, capsys):
    before = contents(Path())
    for name in ("seed2.csv", "none/a.json"):
        complaint(capsys, "summary", *logs, "--json", name)
    complaint(capsys, "summary", *logs, "--plot", "seed2.csv", code=2)
    assert contents(Path()) == before


@pytest.mark.parametrize("name", ["a.chk", "a.dcd", "a.csv", "mine.json"])
def test_numbers_replace_only_earlier_ones(logs, capsys, name):
    """Files of the run too, of which the command knows only the log."""
    Path(name).write_text('{"mine": "openmm_sier"}')
    before = contents(Path())
    message = complaint(capsys, "summary", *logs, "--json", name)
    assert f"{name} exists, and is no earlier file of openmm-sier: give another name, or remove it" in message
    assert contents(Path()) == before
    for _ in range(2):
        run("summary", *logs, "--json", "again.json")
