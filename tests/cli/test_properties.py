"""Properties of a liquid from finished runs."""

import math
import re
from pathlib import Path

import mdtraj
import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier.cli import properties
from openmm_sier.cli.files.checkpoints import read_checkpoint
from openmm_sier.cli.files.records import read_log
from openmm_sier.cli.main import main
from openmm_sier.cli.plan import Options, new_plan
from openmm_sier.measure import liquid_samples
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.liquid_samples import LiquidSamples, NoLiquidError, read_samples, unwrapped
from openmm_sier.measure.statistics import Estimate
from openmm_sier.observe.conservation import TEMPERATURES
from openmm_sier.observe.pressure import COLUMNS
from tests.support.commands import SMALL, SYSTEMS, complaint, log, run
from tests.support.finished_runs import note_count, write_rows, write_run
from tests.support.series import stresses

SETTINGS = ["--scheme", "sier2", "--dt", "2", "--ensemble", "npt", "--platform", "CPU", "--equilibrate", "0.01"]
SETTINGS += ["--every", "0.004", "--report-every", "0.004"]
BOX = SYSTEMS / "tip4p-512.pdb"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two short runs of water with virtual sites that the trajectory leaves out."""
    place = tmp_path_factory.mktemp("runs")
    for seed in (1, 2):
        run("run", BOX, *SETTINGS, "--time", 0.12, "--seed", seed, "--out", place / f"{seed}.dcd")
    return [place / "1.chk", place / "2.chk"]


@pytest.mark.slow
def test_table_and_figure(runs, tmp_path, capsys):
    assert main(["properties", *map(str, runs), "--out", str(tmp_path / "new")]) == 0
    out = capsys.readouterr().out
    assert (tmp_path / "new" / "properties.png").stat().st_size > 10_000
    density = np.mean([log(path.with_suffix(".csv"))["Density (g/mL)"].mean() for path in runs])
    assert f"{density:.4f}"[:-1] in next(line for line in out.splitlines() if "density" in line)
    for name in (
        "of rotation",
        "heat capacity",
        "dielectric constant",
        "enthalpy of vaporization",
        "pair distribution",
    ):
        assert name in out
    # Too short for these, and it says so.
    assert out.count("1.dcd and 1 more: self-diffusion needs a run of more than 15 ps") == 1
    assert "2.dcd: self-diffusion" not in out
    assert "orientations must lose their correlation" in out
    assert "water, 298.15 K" in out


@pytest.mark.slow
def test_samples_are_those_of_all_charges(runs):
    box = read_box(BOX)
    samples = read_samples(runs[0].with_suffix(".dcd"), box, 0.004)
    state, notes = read_checkpoint(runs[0])
    assert len(samples.dipoles) == notes["trajectory"]["count"] == 30
    force = next(f for f in box.system.getForces() if isinstance(f, openmm.NonbondedForce))
    charges = [force.getParticleParameters(i)[0]._value for i in range(box.system.getNumParticles())]
    # The last frame is at the checkpoint; the trajectory has single precision.
    expected = charges @ np.array(state.getPositions().value_in_unit(unit.nanometer))
    np.testing.assert_allclose(samples.dipoles[-1], expected, atol=1e-5)
    assert samples.volumes[-1] == pytest.approx(state.getPeriodicBoxVolume()._value, rel=1e-5)
    np.testing.assert_allclose(np.linalg.norm(samples.directions, axis=2), 1)
    assert len(read_samples(runs[0].with_suffix(".dcd"), box, 0.004, skip=0.04).volumes) == 20
    with pytest.raises(ValueError, match="no frames after 5 ps"):
        read_samples(runs[0].with_suffix(".dcd"), box, 0.004, skip=5)


@pytest.mark.slow
def test_positions_that_are_no_numbers_are_named(runs, tmp_path):
    data = bytearray(runs[0].with_suffix(".dcd").read_bytes())
    data[-8:-4] = np.float32(np.nan).tobytes()
    (tmp_path / "damaged.dcd").write_bytes(data)
    with pytest.raises(ValueError, match=r"damaged\.dcd, frame 30: a position or an edge of the box is not finite"):
        read_samples(tmp_path / "damaged.dcd", read_box(BOX), 0.004, skip=0.04)


def test_frames_are_those_that_the_checkpoint_notes(runs, tmp_path, capsys):
    note_count(runs[0], "trajectory", 29)
    said = complaint(capsys, "properties", runs[0], "--skip", 0.02, "--out", tmp_path)
    note_count(runs[0], "trajectory", 30)
    assert f"1.dcd has 30 frames, {runs[0]} notes 29" in said


@pytest.mark.slow
def test_every_frame_counts_alike_in_the_pair_distribution(runs, monkeypatch):
    """Frames 1 ps apart and more are all counted, however many the chunks have in which they are read."""
    box, trajectory = read_box(BOX), runs[0].with_suffix(".dcd")
    monkeypatch.setattr(liquid_samples, "CHUNK", 28)  # the last chunk has two frames
    samples = read_samples(trajectory, box, 1.0)
    topology = mdtraj.Topology.from_openmm(box.topology).subset(box.listed)
    pairs = topology.select_pairs("element O", "element O")
    reach = (0.0, samples.distances[-1] + liquid_samples.BIN / 2)
    frames = mdtraj.load(str(trajectory), top=topology)
    _, expected = mdtraj.compute_rdf(frames, pairs, r_range=reach, bin_width=liquid_samples.BIN)
    # Pairs are divided by mean volumes, which move by less than 1e-3 here; the noise of two frames is 0.1.
    np.testing.assert_allclose(samples.pairs, expected, rtol=1e-3)
    # Those 4 fs apart are not: the first alone is.
    _, first = mdtraj.compute_rdf(frames[0], pairs, r_range=reach, bin_width=liquid_samples.BIN)
    monkeypatch.setattr(liquid_samples, "CHUNK", 200)
    np.testing.assert_allclose(read_samples(trajectory, box, 0.004).pairs, first, rtol=1e-3)


@pytest.mark.slow
def test_boxes_that_are_not_rectangular_are_refused(runs):
    box = read_box(BOX)
    box.topology.setPeriodicBoxVectors([[2.5, 0, 0], [0.8, 2.5, 0], [0, 0, 2.5]] * unit.nanometer)
    with pytest.raises(NoLiquidError, match="is not rectangular"):
        read_samples(runs[0].with_suffix(".dcd"), box, 0.004)


def test_a_box_that_is_no_liquid_has_its_density(capsys):
    """It was refused. What belongs to molecules of one kind is left out, and so is the figure."""
    rng = np.random.default_rng(5)
    values = {"Time (ps)": np.arange(100) * 0.1, "Density (g/mL)": rng.normal(1.01, 0.01, 100)}
    values |= {"Potential Energy (kJ/mole)": rng.normal(-2e4, 10, 100), TEMPERATURES[2]: np.full(100, np.nan)}
    for seed in (1, 2):
        write_run(f"{seed}", values, box=SYSTEMS / "tip3p-nacl-512.pdb", ensemble="npt", seed=seed)
    run("properties", "1", "2")
    out = " ".join(capsys.readouterr().out.split())
    assert "properties of molecules and of their motion are left out: the box is not one of one kind of" in out
    assert "but has CL, HOH, NA" in out
    assert f"density, g/cm³ │ {values['Density (g/mL)'].mean():.4f}"[:-1] in out
    assert "potential energy of the box" in out
    for name in ("flexible", "per mol of molecules", "vaporization", "dielectric", "diffusion", "pair distribution"):
        assert name not in out
    assert not Path("out").exists()


def test_places_are_followed_through_faces():
    rng = np.random.default_rng(7)
    edges = np.array([[2.0, 2.5, 3.0]]) * (1 + 0.001 * rng.normal(size=(50, 1)))
    true = rng.uniform(0, 2, (1, 6, 3)) + rng.normal(scale=0.2, size=(50, 6, 3)).cumsum(axis=0)
    true -= true.mean(axis=1, keepdims=True) - true[:1].mean(axis=1, keepdims=True)
    constant = np.repeat(edges[:1], 50, axis=0)
    found = unwrapped(np.mod(true, constant[:, None]), constant)
    np.testing.assert_allclose(found - found[0], true - true[0], atol=1e-12)
    # Where the box changes, each step is still the one that was made: a wrap at the new edge is undone.
    moved = unwrapped(np.mod(true, edges[:, None]), edges)
    assert np.abs(moved - moved[0] - true + true[0]).max() < 0.5


@pytest.mark.slow
def test_wrong_input(runs, tmp_path, capsys):
    assert "1.csv has 0 rows after 5 ps, 20 are needed" in complaint(
        capsys, "properties", runs[0], "--skip", 5, "--out", tmp_path
    )
    other = tmp_path / "other.dcd"
    run("run", BOX, *SETTINGS, "--steps", 4, "--out", other, "--temperature", 310)
    capsys.readouterr()
    said = complaint(capsys, "properties", runs[0], other.with_suffix(".chk"), "--out", tmp_path)
    assert "has temperature 310.0" in said
    assert "differ in their seeds alone" in said


# --- viscosity ---


def write_tensors(path, n, keep, interval=0.02, steps=5):
    """A file of pressure tensors whose shear stresses are independent, of 500 bar and with correlation keep^t."""
    counts, tensors = np.arange(1, n + 1), 500 * stresses(np.random.default_rng(8), n, keep)
    columns = [steps * counts, interval * counts, *tensors.T, np.full(n, 8.0)]
    write_rows(Path(path), dict(zip(COLUMNS, columns, strict=True)))


def viscosity_of(out):
    """Value and error in the printed table."""
    value, error = re.search(r"shear viscosity, mPa s\W+([\d.]+) ± ([\d.]+)", out).groups()
    return float(value), float(error)


@pytest.mark.slow
def test_viscosity_from_the_file_of_a_run(box, capsys, monkeypatch):
    often = ["--every", 0.004, "--report-every", 0.004]
    run("run", box, *SMALL, "--steps", 25, "--ensemble", "nvt", *often, "--pressure-tensor", "p.csv")
    capsys.readouterr()
    write_tensors("p.csv", 20000, 0.95)
    assert "p.csv: expected 5 rows" in complaint(capsys, "properties", "box.chk")
    note_count("box.chk", "tensors", 20000)
    assert main(["properties", "box.chk"]) == 0
    out = capsys.readouterr().out
    # V/kT <P²> times the sum of the correlation: 8 nm³ at 297 K, 500 bar, 0.02 ps (0.5 + 0.95/0.05).
    value, error = viscosity_of(out)
    expected = 8e-27 / (1.380649e-23 * 297) * 5e7**2 * 0.02e-12 * 19.5 * 1e3
    assert abs(value - expected) < 4 * error < expected
    assert "0.890" in out
    assert "relaxes more slowly" not in out
    assert Path("out/properties.png").stat().st_size > 10_000
    monkeypatch.setattr(properties, "can_draw", lambda report: False)
    # Where the correlation lasts, the integral has not come to its end.
    write_tensors("p.csv", 20000, 0.995)
    assert main(["properties", "box.chk"]) == 0
    assert "relaxes more slowly" in capsys.readouterr().out


@pytest.mark.slow
def test_runs_without_a_bath_have_a_mean_temperature(box, capsys, monkeypatch):
    monkeypatch.setattr(properties, "can_draw", lambda report: False)
    often = ["--every", 0.004, "--report-every", 0.004]
    for ensemble, steps in (("nve", 40), ("nvt", 25)):
        run("run", box, *SMALL, "--steps", steps, "--ensemble", ensemble, *often, "--overwrite")
        capsys.readouterr()
        assert main(["properties", "box.chk"]) == 0
        found = re.search(r"temperature, K\W+([\d.]+)", capsys.readouterr().out)
        assert bool(found) == (ensemble == "nve")
        if found:  # in two digits of its error, which is some kelvin
            assert float(found.group(1)) == pytest.approx(log("box.csv")["Temperature (K)"].mean(), abs=1)


@pytest.mark.slow
def test_viscosity_corrects_diffusion(tmp_path):
    """A viscosity that the runs give is taken for the effect of the box, unless another is named."""
    plan = new_plan(Options(Path("box.pdb"), ensemble="nvt", pressure_tensor=tmp_path / "p.csv"))
    write_tensors(tmp_path / "p.csv", 20000, 0.95, plan.interval(plan.pressure_tensor_every) * plan.dt / 1000)
    rng, n = np.random.default_rng(3), 400
    centres = rng.normal(scale=0.05, size=(n, 20, 3)).cumsum(axis=0)
    directions = np.tile([0.0, 0.0, 1.0], (n, 20, 1))
    samples = LiquidSamples(0.1, centres, directions, None, np.full(n, 8.0), np.linspace(0, 0.9, 50), np.ones((4, 50)))
    names = ("Density (g/mL)", "Potential Energy (kJ/mole)", "Total Energy (kJ/mole)")
    log = dict.fromkeys((*names, *TEMPERATURES), np.arange(100.0))
    made = properties.Run(plan, log, samples, 20, read_log(tmp_path / "p.csv"))
    table = {name: value for name, value, _ in properties._rows([made], None)[0]}
    (name,) = [name for name in table if "without the box" in name]
    assert table["shear viscosity, mPa s"] in name
    plain, corrected = (float(table[key].split()[0]) for key in ("self-diffusion in the box, 10⁻⁹ m²/s", name))
    viscosity = float(table["shear viscosity, mPa s"].split()[0])
    # 2.837 kT/(6 pi eta L), in 10⁻⁹ m²/s.
    shift = 2.837297 * 1.380649e-23 * 297 / (6 * math.pi * viscosity * 1e-3 * 2e-9) * 1e9
    assert corrected - plain == pytest.approx(shift, rel=0.2)
    assert any("viscosity 0.9 mPa s" in name for name, *_ in properties._rows([made], Estimate(0.9, 0))[0])
