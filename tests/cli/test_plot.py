"""`plot`: what the titles of a picture say of logs whose statistics are known, and what is refused."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.cli.logged_runs import finding, read_run, read_runs
from openmm_sier.cli.pictures import drawing, series
from openmm_sier.inputs import equilibration
from tests.support.commands import SMALL, SYSTEMS, complaint, contents, run
from tests.support.logs import NOISE, write_log
from tests.support.matrices import representatives
from tests.support.series import correlated

pytest.importorskip("matplotlib")

POTENTIAL, DENSITY = "Potential Energy (kJ/mole)", "Density (g/mL)"
TRANSLATION, ROTATION = "Translational Temperature (K)", "Rotational Temperature (K)"


def findings(*paths, skip=None):
    """The title of the picture of some logs, and those of its panels."""
    runs = read_runs([Path(path) for path in paths], skip)
    return finding(runs), [panel.finding for panel in drawing.panels(runs)]


def eight(ensemble, **options):
    names = [f"seed{seed}.csv" for seed in range(1, 9)]
    for seed, name in enumerate(names, 1):
        write_log(name, ensemble, seed=seed, **options)
    return names


# --- what is told ---


@pytest.mark.parametrize(
    ("ensemble", "begins"),
    [
        ("nve", ["The energy is held to", "The potential energy is", "Rotation: no difference from translation shows"]),
        ("nvt", ["The potential energy is", "No heat of the steps shows", "Rotation: no"]),
        ("npt", ["The potential energy is", "No heat of the steps shows", "Rotation: no", "The density is 0."]),
        ("hmc", ["The potential energy is", "Rotation: no", ""]),
    ],
)
def test_each_ensemble_has_its_panels(ensemble, begins):
    write_log("a.csv", ensemble)
    title, found = findings("a.csv")
    clock = "500 trials" if ensemble == "hmc" else "20 ps"
    assert title.startswith(f"{clock} without a trend of energy")
    assert len(found) == len(begins)
    for text, begin in zip(found, begins, strict=True):
        assert text.startswith(begin)
    if ensemble == "hmc":
        # 0.9 and 0.3 kT, each within some standard errors of 501 trials: 0.013 and 0.01.
        assert float(found[-1].split()[0]) == pytest.approx(90, abs=5)
        assert "% of the trials are accepted; the sd of their energy errors is 0.3" in found[-1]


@pytest.mark.parametrize("ensemble", ["nve", "nvt", "npt", "hmc"])
def test_the_ensemble_is_known_by_the_heat_alone(ensemble):
    """Also where the kinetic energy of a scheme is that of other times than its positions: it differs at random."""

    def of_other_times(log):
        log["Total Energy (kJ/mole)"] += 5 * np.random.default_rng(9).normal(size=len(log["Step"]))

    write_log("a.csv", ensemble)
    write_log("b.csv", ensemble, change=of_other_times)
    # Without a checkpoint beside the log any bath is "nvt".
    known = ensemble if ensemble in ("nve", "hmc") else "nvt"
    assert [read_run(Path(name)).ensemble for name in ("a.csv", "b.csv")] == [known, known]


def test_a_drift_is_told_with_its_error():
    """From 20 ps, the slope of white noise of 0.5 kJ/mol has an error of 0.004 kJ/mol/ps."""
    write_log("a.csv", drift=0.1)
    _, (energy, *_) = findings("a.csv")
    # Within three errors, as the slopes below.
    assert float(energy.split("drifts by ")[1].split()[0]) == pytest.approx(0.1, abs=0.012)
    # rms(H) is that of the drift, 0.1*20/sqrt(12), and of the noise; rms(V) is 50 to some per cent.
    share = float(energy.split("held to ")[1].split(" %")[0])
    assert share == pytest.approx(100 * np.hypot(2 / np.sqrt(12), NOISE) / 50, rel=0.2)
    for drift, verb in ((0.1, "heat"), (-0.1, "cool")):
        write_log("b.csv", "nvt", drift=drift)
        heat = findings("b.csv")[1][1]
        assert heat.startswith(f"The steps {verb} by ")
        assert float(heat.split(" by ")[1].split()[0]) == pytest.approx(0.1, abs=0.012)


def test_a_cold_rotation_is_told():
    """The error of a mean of 501 temperatures of which three are worth one is 0.9 K; that of a difference 1.3 K."""
    write_log("a.csv", change=lambda log: log.update({ROTATION: log[ROTATION] - 15}))
    said = re.fullmatch(r"Rotation is (.+) ± .+ K colder than translation", findings("a.csv")[1][-1])
    assert float(said[1]) == pytest.approx(15, abs=4)


def test_what_had_not_settled_is_left_out_of_means():
    """Six standard deviations off at first, which fade within 1 ps of 20."""

    def warm(log):
        log[POTENTIAL] = log[POTENTIAL] + 300 * np.exp(-log["Time (ps)"])

    write_log("a.csv", "nvt", change=warm)
    runs = read_runs([Path("a.csv")])
    assert runs.moving == ("potential energy",)
    assert (runs.drifting, runs.unclear) == ((), ())
    assert 1 < runs.begin < 6
    title, (energy, *_) = findings("a.csv")
    assert title == f"Settled after {runs.begin:.4g} ps: potential energy. Means are of the rest"
    # The mean of the whole is off by 300/20 = 15. The error of the mean of the rest is 4.4, and its transient below 6.
    assert float(energy.split("is ")[1].split()[0]) == pytest.approx(-5000, abs=16)
    # What is left out can be chosen.
    title = "12 ps without a trend of energy or temperatures. Means leave out the first 8 ps"
    assert findings("a.csv", skip=8.0)[0] == title
    # What then drifts is said.
    assert read_runs([Path("a.csv")], 0).begin == 0
    assert findings("a.csv", skip=0)[0] == "Not settled in 20 ps: potential energy"


def test_a_short_log_tells_no_trend():
    """Of 24 rows every third is independent."""
    write_log("a.csv", rows=24)
    title, found = findings("a.csv")
    assert title == "0.92 ps: too short to tell a trend of potential energy, translation and rotation"
    assert all("≥" in text or text.startswith(("The energy", "Rotation: no difference")) for text in found)


def test_a_quantity_with_a_long_memory_is_not_settled_by_the_others():
    """The density rises with a time of 2.5 ps in runs of 8 ps, and the rest is white or settles within a picosecond."""

    def compress(log):
        time = log["Time (ps)"]
        log[DENSITY] = 0.99 + 0.1 * (log[DENSITY] - 0.99) - 0.063 * np.exp(-time / 2.5)
        log[POTENTIAL] = log[POTENTIAL] + 500 * np.exp(-time / 0.2)

    names = eight("npt", rows=201, change=compress)[:3]
    runs = read_runs([Path(name) for name in names])
    assert "density" in (*runs.drifting, *runs.unclear)
    title, (*_, density) = findings(*names)
    assert re.match(r"(8 ps: too short to tell a trend of|Not settled in 8 ps:) .*density", title)
    assert re.match(r"The density (may still drift|still drifts), around", density)
    # The mean of the whole is 0.971, and that of its second half 0.982.
    assert runs.begin > 3
    assert float(density.split("around ")[1].split()[0]) > 0.98


def test_a_title_claims_no_more_of_temperatures_than_their_errors_allow():
    """Rotation keeps 0.97 of its deviations, so that 66 of 1001 rows are worth one."""

    def slow(log):
        log[ROTATION] = 297 + 12 * correlated(np.random.default_rng(2), len(log[ROTATION]), 0.97)

    log = write_log("a.csv", rows=1001, change=slow)
    _, (*_, temperatures) = findings("a.csv", skip=0)
    within = re.fullmatch(r"Rotation: no difference from translation shows within (\S+) K", temperatures)
    # Written with two digits.
    off = mean_and_error(log[ROTATION] - log[TRANSLATION])
    assert float(within[1]) == pytest.approx(3 * off.error * (2 if off.samples < 20 else 1), rel=0.05)


def test_what_never_settles_is_told():
    write_log("a.csv", "npt", change=lambda log: log.update({DENSITY: log[DENSITY] + 0.01 * log["Time (ps)"]}))
    title, found = findings("a.csv")
    assert title == "Not settled in 20 ps: density. Means leave out the first 10 ps"
    assert found[-1].startswith("The density still drifts")


def test_means_over_equal_times_are_those_of_their_rows():
    write_log("a.csv")
    runs = read_runs([Path("a.csv")])
    means = series.means_of(runs, POTENTIAL)
    width, rows = series.width_of_means(runs)
    values = runs.first.log[POTENTIAL]
    # Every 0.5 ps would be 12.5 rows.
    assert (width, rows) == (pytest.approx(0.48), 12)
    assert means.values[0] == pytest.approx([values[:13].mean(), *values[13:493].reshape(-1, 12).mean(axis=1)])
    assert means.scatter[0][1:] == pytest.approx(values[13:493].reshape(-1, 12).std(axis=1))
    assert means.error is None


def test_the_band_of_eight_runs_is_their_standard_error():
    runs = read_runs([Path(name) for name in eight("npt")])
    means = series.means_of(runs, DENSITY)
    assert means.values.shape[0] == 8
    np.testing.assert_allclose(means.error, means.values.std(axis=0, ddof=1) / np.sqrt(8))
    # 12 values, of which three are worth one, with a standard deviation of 0.01. Over 41 times, of which each error is
    # known to 27 %, the mean is known to 4 %, and the memory of 12 values is shorter than that of many.
    assert means.error.mean() == pytest.approx(0.01 / np.sqrt(4 * 8), rel=0.3)
    assert read_runs(runs_of_four(runs)).first.path == Path("seed1.csv")
    assert series.means_of(read_runs(runs_of_four(runs)), DENSITY).error is None


def runs_of_four(runs):
    return [run.path for run in runs.runs[:4]]


# --- files ---


@pytest.mark.parametrize(
    ("ensemble", "ending"),
    representatives([("npt", ".png"), ("hmc", ".svg")], ("npt", ".png")),
)
def test_pictures_of_one_and_of_eight(ensemble, ending, capsys):
    names = eight(ensemble, rows=101)
    logs = contents(Path())
    drawn = []
    # Drawn again, a picture takes the place of the first, to the byte.
    for paths in (names[:1], names, names):
        run("plot", *paths, "--out", f"a{ending}")
        drawn.append(Path(f"a{ending}").read_bytes())
        assert drawn[-1].startswith(b"\x89PNG" if ending == ".png" else b"<?xml")
    assert drawn[0] != drawn[1] == drawn[2]
    assert f"wrote a{ending}" in capsys.readouterr().out
    Path(f"a{ending}").unlink()
    assert contents(Path()) == logs


def test_the_picture_lies_beside_the_first_log():
    Path("there").mkdir()
    write_log("there/a.csv", rows=50)
    run("plot", "there/a.csv")
    assert sorted(contents(Path())) == ["there/a.csv", "there/a.png"]


def test_a_run_draws_at_its_end(box, capsys):
    short = ["run", box, *SMALL, "--report-every", "0.004", "--steps", "10", "--plot", "a.svg"]
    run(*short)
    assert "wrote box.chk, box.dcd, box.csv, a.svg" in capsys.readouterr().out
    # The title of the run is that of its checkpoint.
    assert read_run(Path("box.csv")).plan.title == "SIER2, NVE, 4 fs"
    before = contents(Path())
    for name in ("box.chk", "box.dcd", "box.csv"):
        Path(name).unlink()
    before = contents(Path())
    assert "a.svg exists: give another name with --plot, or replace it with --overwrite" in complaint(capsys, *short)
    assert contents(Path()) == before
    run(*short, "--overwrite")


def test_a_run_too_short_for_a_picture_is_refused_before_it(box, capsys):
    command = ["run", box, *SMALL, "--steps", "10", "--plot", "a.png"]
    assert "--plot needs a log of 3 rows or more, and this one would have 2: lower" in complaint(
        capsys, *command, code=2
    )
    assert not contents(Path())


def test_a_molecule_alone(capsys):
    """Its potential energy is constant, and it has no box."""
    molecule = SYSTEMS / "tip4p-1.pdb"
    run("run", molecule, "--time", "2", "--equilibrate", "0.1", "--platform", "Reference", "--plot", "a.png")
    assert Path("a.png").exists()
    _, found = findings("tip4p-1.csv")
    assert re.match(r"The energy is held to \S+ kJ/mol; ", found[0])
    assert found[1] == "The potential energy is 0 kJ/mol"


def test_a_log_that_is_being_written_is_drawn():
    write_log("a.csv")
    with open("a.csv", "a") as file:
        file.write("501,20.04,-50")
    assert len(read_run(Path("a.csv")).log["Step"]) == 501


# --- refusals ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.csv", "--out", "a.jpg"], "the name of a picture must end in .png, .svg, .html, got a.jpg"),
        (["a.csv", "--out", "none/a.png"], "there is no directory none for a.png"),
        (["none.csv"], "none.csv: No such file or directory"),
        (["a.csv", "a.csv"], "a.csv is given twice: each run counts once"),
        (
            ["a.csv", "bath.csv"],
            "bath.csv is a run in a heat bath, at constant volume, but a.csv is a run at constant energy, at",
        ),
        (
            ["tensor.csv"],
            "tensor.csv is not a log of openmm-sier run, since it has no column Potential Energy (kJ/mole)",
        ),
        (["a.dcd"], "a.dcd is not a log of openmm-sier run: give the .csv file that --report wrote"),
        (["short.csv"], "short.csv has 2 rows so far and needs 3 or more: let the run continue"),
        (["a.csv", "--skip", "20"], "--skip 20 leaves nothing: the shortest run has 20 ps"),
    ],
)
def test_wrong_logs_are_refused_in_one_line(capsys, arguments, message):
    write_log("a.csv")
    write_log("bath.csv", "nvt")
    write_log("short.csv", rows=2)
    write_log("tensor.csv", columns=["Step", "Time (ps)"])
    Path("a.dcd").write_bytes(bytes(range(256)))
    before = contents(Path())
    code = 2 if "must end in" in message or "given twice" in message else 1
    assert message in complaint(capsys, "plot", *arguments, code=code)
    assert contents(Path()) == before


def test_a_picture_destroys_no_log(capsys):
    write_log("a.png")
    before = contents(Path())
    assert "a.png would overwrite the input a.png: give another name" in complaint(
        capsys, "plot", "a.png", "--out", "a.png"
    )
    assert contents(Path()) == before


@pytest.mark.parametrize("ending", representatives(["png", "svg", "html"], "png"))
def test_a_picture_replaces_only_an_earlier_one(capsys, ending):
    write_log("a.csv")
    name = f"a.{ending}"
    for _ in range(2):
        run("plot", "a.csv", "--out", name)
    for text in (b"\x89PNG\r\n", b"<svg>openmm-sier</svg>", b""):
        Path(name).write_bytes(text)
        assert f"{name} exists, and is no earlier file of openmm-sier" in complaint(
            capsys, "plot", "a.csv", "--out", name
        )
        assert Path(name).read_bytes() == text


def test_missing_matplotlib_names_the_extra(box, capsys, monkeypatch):
    """Before a run begins, not at its end."""
    write_log("a.csv")
    before = contents(Path())
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    picture = ["--plot", "a.png"]
    for command in (["plot", "a.csv"], ["summary", "a.csv", *picture], ["run", box, *SMALL, *picture]):
        message = complaint(capsys, *command)
        assert "pictures need matplotlib; install it with: pip install 'openmm-sier[plot]'" in message
    assert contents(Path()) == before


@pytest.mark.thorough
def test_runs_that_differ_in_more_than_the_seed_draw_a_warning(box, capsys, monkeypatch):
    # Whatever a lattice of water does in 0.1 ps, it is not equilibrated.
    monkeypatch.setattr(equilibration, "_are_within_bounds", lambda *_: False)
    for out, options in (("a", []), ("b", ["--seed", "2"]), ("c", ["--seed", "2", "--dt", "2"])):
        run("run", box, *SMALL, "--steps", "20", "--report-every", "0.004", *options, "--out", f"{out}.dcd")
    capsys.readouterr()
    run("plot", "a.csv", "b.csv")
    said = capsys.readouterr().out
    assert "differ in" not in said
    assert "ends after" not in said
    # Nor does a picture hide how they began.
    assert "Not equilibrated at the start: 2 of 2 runs" in said
    assert "warning: a.csv: not equilibrated, after 0.1" in said
    run("plot", "a.csv", "b.csv", "c.csv")
    said = capsys.readouterr().out
    assert "warning: c.csv and a.csv differ in dt: their mean belongs to no ensemble" in said
    assert "warning: c.csv ends after 0.04 ps, and a.csv after 0.08 ps: means give both the same weight" in said
