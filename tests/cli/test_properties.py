"""Properties of a liquid from finished runs."""

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier.cli.main import main
from openmm_sier.cli.records import read_checkpoint
from openmm_sier.measure.forcefields import read_box
from openmm_sier.measure.liquid_samples import NoLiquidError, read_samples, unwrapped
from tests.support.commands import SYSTEMS, complaint, log, run

pytest.importorskip("pymbar")

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


def test_table_and_figure(runs, tmp_path, capsys):
    assert main(["properties", *map(str, runs), "--out", str(tmp_path / "new")]) == 0
    out = capsys.readouterr().out
    assert (tmp_path / "new" / "properties.png").stat().st_size > 10_000
    density = np.mean([log(path.with_suffix(".csv"))["Density (g/mL)"].mean() for path in runs])
    assert f"{density:.4f}"[:-1] in next(line for line in out.splitlines() if "density" in line)
    for name in ("heat capacity", "dielectric constant", "enthalpy of vaporization", "pair distribution"):
        assert name in out
    # Too short for these, and it says so.
    assert "self-diffusion needs a run of more than 10 ps" in out
    assert "orientations must lose their correlation" in out
    assert "water, 298.15 K" in out


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


def test_boxes_that_are_not_rectangular_are_refused(runs):
    box = read_box(BOX)
    box.topology.setPeriodicBoxVectors([[2.5, 0, 0], [0.8, 2.5, 0], [0, 0, 2.5]] * unit.nanometer)
    with pytest.raises(NoLiquidError, match="is not rectangular"):
        read_samples(runs[0].with_suffix(".dcd"), box, 0.004)


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


def test_wrong_input(runs, tmp_path, capsys):
    assert "no frames after 5 ps" in complaint(capsys, "properties", runs[0], "--skip", 5, "--out", tmp_path)
    other = tmp_path / "other.dcd"
    run("run", BOX, *SETTINGS, "--steps", 4, "--out", other, "--temperature", 310)
    capsys.readouterr()
    said = complaint(capsys, "properties", runs[0], other.with_suffix(".chk"), "--out", tmp_path)
    assert "has temperature 310.0" in said
    assert "differ in their seeds alone" in said
