"""The reporters that know of rigid bodies."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIER2, SIER2Integrator, SIERLangevinIntegrator
from openmm_sier.context.reporters import BodyStateReporter, ConservationReporter
from tests.support.restarts import simulation_of
from tests.support.waters import periodic_system, relaxed

h5py = pytest.importorskip("h5py")


@pytest.fixture(scope="module")
def box():
    topology, positions, system = periodic_system()
    return topology, system, relaxed(topology, positions, system)


def simulation_at(box, integrator):
    topology, system, point = box
    return simulation_of(topology, system, integrator, "CPU", point)


@pytest.mark.slow
def test_conservation_report(tmp_path, box):
    integrator = SIERLangevinIntegrator(297, 5, 0.001, scheme=SIER2)
    simulation = simulation_at(box, integrator)
    path = tmp_path / "log.csv"
    simulation.reporters.append(ConservationReporter(path, 5))
    simulation.step(10)
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    header = path.read_text().splitlines()[0].split(",")
    assert rows.shape == (2, len(header))
    assert rows[:, 0].tolist() == [5, 10]
    state = simulation.context.getState(energy=True)
    energy = (state.getPotentialEnergy() + state.getKineticEnergy()).value_in_unit(unit.kilojoule_per_mole)
    heat = integrator.getHeat().value_in_unit(unit.kilojoule_per_mole)
    last = dict(zip(header, rows[-1], strict=True))
    # Single-precision forces of the CPU platform give an energy that differs from call to call in the seventh digit.
    assert last["Total Energy (kJ/mol)"] == pytest.approx(energy, rel=1e-6)
    assert last["Conserved Energy (kJ/mol)"] == pytest.approx(energy - heat, rel=1e-6)
    motion = integrator.getBodyState()
    assert last["Translational Temperature (K)"] == integrator.bodies.temperatures(motion, 3)[0]
    assert last["Rotational Temperature (K)"] == integrator.bodies.temperatures(motion, 3)[1]
    assert last["Momentum x (dalton nm/ps)"] == motion.p[0].sum()
    volume = state.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3)
    assert last["Box Volume (nm^3)"] == pytest.approx(volume)


def test_conservation_report_is_continued(tmp_path, box):
    path = tmp_path / "log.csv"
    for append in (False, True):
        simulation = simulation_at(box, SIER2Integrator(0.001))
        simulation.reporters.append(ConservationReporter(path, 2, append=append))
        simulation.step(4)
        simulation.reporters.pop().close()
    lines = path.read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["Step", "2", "4", "2", "4"]


def test_body_states(tmp_path, box):
    integrator = SIER2Integrator(0.001)
    simulation = simulation_at(box, integrator)
    path = tmp_path / "bodies.h5"
    simulation.reporters.append(BodyStateReporter(path, 3))
    simulation.step(9)
    motion = integrator.getBodyState()
    # Read while the reporter still has it open, as after a kill.
    with h5py.File(path, "r") as file:
        assert file["step"][:].tolist() == [3, 6, 9]
        assert file["time"][-1] == pytest.approx(0.009)
        for name, values in (("q", motion.q), ("p", motion.p), ("L", motion.L)):
            assert np.array_equal(file[name][-1], values.T)
        assert np.array_equal(file["moments"][:], integrator.bodies.moments.T)
        assert file["L"].attrs["unit"] == "dalton nm^2/ps"
        w, x, y, z = file["quaternion"][-1].T
    # The rotation A^T written out from its quaternion; rounding of products of numbers below 1.
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    assert np.abs(turn - motion.A.transpose(1, 0, 2)).max() < 1e-14
    simulation.reporters[0].close()


KILLED = """
import sys
from openmm import app
from openmm_sier import SIER2Integrator
from openmm_sier.context.reporters import BodyStateReporter
from tests.support.restarts import simulation_of
from tests.support.waters import cluster_system
topology, positions, system = cluster_system(8)
simulation = simulation_of(topology, system, SIER2Integrator(0.0005), "CPU", (positions, 0 * positions))
simulation.reporters.append(BodyStateReporter(sys.argv[1], 1))
simulation.step(5)
print("ready", flush=True)
simulation.step(10**6)
"""


@pytest.mark.slow
def test_body_states_survive_a_kill(tmp_path):
    path = tmp_path / "bodies.h5"
    with subprocess.Popen([sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, cwd=os.getcwd()) as run:
        assert run.stdout.readline()
        time.sleep(0.5)
        run.send_signal(signal.SIGKILL)
    with h5py.File(path, "r") as file:
        steps = file["step"][:]
        assert len(steps) > 1
        assert np.array_equal(steps[:-1], np.arange(1, len(steps)))
        # The last frame may be cut off in the middle; those before it are whole.
        assert np.isfinite(file["q"][:-1]).all()
        assert (np.linalg.norm(file["quaternion"][: len(steps) - 1], axis=2) > 0.999).all()


@pytest.mark.parametrize("make", [ConservationReporter, BodyStateReporter])
def test_other_integrators_are_refused(tmp_path, box, make):
    simulation = simulation_at(box, openmm.VerletIntegrator(0.001))
    simulation.reporters.append(make(tmp_path / "file", 1))
    with pytest.raises(TypeError, match="needs a SIER integrator"):
        simulation.step(1)


@pytest.mark.parametrize("make", [ConservationReporter, BodyStateReporter])
def test_impossible_intervals(tmp_path, make):
    with pytest.raises(ValueError, match="reportInterval"):
        make(tmp_path / "file", 0)
