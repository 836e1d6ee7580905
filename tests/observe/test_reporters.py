"""The reporters that know of rigid bodies."""

import numpy as np
import openmm
import pytest
from openmm import app, unit
from scipy.spatial.transform import Rotation

from openmm_sier import SIER2, RigidBodies, SIERIntegrator, SIERLangevinIntegrator, select_bodies
from openmm_sier.observe import conservation
from openmm_sier.observe.reporters import BodyStateReporter, ConservationReporter, PressureReporter
from tests.support.domains import domain_system, folded, topology_of
from tests.support.restarts import simulation_of
from tests.support.seeded import seeded
from tests.support.systems import with_forces
from tests.support.waters import cluster_system, periodic_system

h5py = pytest.importorskip("h5py")


def simulation_at(box, integrator):
    topology, system, point = box
    return simulation_of(topology, system, integrator, "CPU", point)


def test_conservation_report(tmp_path, box):
    integrator = seeded(SIERLangevinIntegrator(297, 5, 0.001, scheme=SIER2), 1)
    simulation = simulation_at(box, integrator)
    path = tmp_path / "log.csv"
    simulation.reporters.append(ConservationReporter(path, 5))
    simulation.step(10)
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    header = path.read_text().splitlines()[0].split(",")
    assert rows.shape == (2, len(header))
    assert rows[:, 0].tolist() == [5, 10]
    last = dict(zip(header, rows[-1], strict=True))
    heat = integrator.getHeat().value_in_unit(unit.kilojoule_per_mole)
    # Velocities after the bath lag half a kick behind those at which the energy is conserved.
    kinetic = sum(integrator.bodies.kinetic_energies(integrator.getWholeStepState()))
    conserved = last["Potential Energy (kJ/mole)"] + kinetic - heat
    assert last["Conserved Energy (kJ/mole)"] == pytest.approx(conserved, rel=1e-12)
    assert kinetic != pytest.approx(last["Kinetic Energy (kJ/mole)"], rel=1e-12)
    motion = integrator.getBodyState()
    names = ("Temperature (K)", "Translational Temperature (K)", "Rotational Temperature (K)")
    assert [last[name] for name in names] == list(integrator.computeTemperatures().in_kelvin()[:3])
    assert np.isnan(last["Flexible Temperature (K)"])
    assert last["Momentum x (dalton nm/ps)"] == motion.p[0].sum()


def test_columns_that_openmm_reports_too_have_its_names(tmp_path, box):
    columns = ["step", "time", "potentialEnergy", "kineticEnergy", "totalEnergy", "temperature", "volume", "density"]
    theirs = app.StateDataReporter(str(tmp_path / "theirs.csv"), 1, **dict.fromkeys(columns, True))
    simulation = simulation_at(box, SIERIntegrator(0.001, "SIER2"))
    simulation.reporters += [theirs, ConservationReporter(tmp_path / "ours.csv", 1)]
    simulation.step(1)
    names, values = (tmp_path / "theirs.csv").read_text().splitlines()
    ours = [line.split(",") for line in (tmp_path / "ours.csv").read_text().splitlines()]
    results = dict(zip(ours[0], map(float, ours[1]), strict=True))
    for name, value in zip(names.lstrip("#").replace('"', "").split(","), map(float, values.split(",")), strict=True):
        assert results[name] == pytest.approx(value, rel=1e-6)


def flexible_barostat():
    barostat = openmm.MonteCarloFlexibleBarostat(1, 297, 1)
    barostat.setScaleMoleculesAsRigid(True)
    return barostat


OF_OPENMM = {
    "isotropic": lambda: openmm.MonteCarloBarostat(1, 297, 1),
    "anisotropic": lambda: openmm.MonteCarloAnisotropicBarostat([1, 1, 1], 297, True, True, True, 1),
    "membrane": lambda: openmm.MonteCarloMembraneBarostat(
        1, 0, 297, openmm.MonteCarloMembraneBarostat.XYIsotropic, openmm.MonteCarloMembraneBarostat.ZFree, 1
    ),
    "flexible": flexible_barostat,
    "thermostat": lambda: openmm.AndersenThermostat(297, 1),
}


def conserved(tmp_path, box, integrator, *forces, drift=0.0, steps=4):
    """The column of the conserved energy over some steps of a box to which Forces are added."""
    topology, system, (positions, velocities) = box
    system = with_forces(system, *forces)
    simulation = simulation_at((topology, system, (positions, velocities + drift)), integrator)
    reporter = ConservationReporter(tmp_path / "log.csv", 1)
    simulation.reporters.append(reporter)
    simulation.step(steps)
    reporter.close()
    return np.genfromtxt(tmp_path / "log.csv", delimiter=",", names=True)["Conserved_Energy_kJmole"]


@pytest.mark.parametrize("engine", ["exact", "native"])
@pytest.mark.parametrize("kind", OF_OPENMM)
def test_the_conserved_energy_is_unknown_where_openmm_gives_heat(tmp_path, box, kind, engine):
    if (kind, engine) == ("thermostat", "native"):
        pytest.skip("refused")
    result = conserved(tmp_path, box, SIERIntegrator(0.001, "SIER2", engine=engine), OF_OPENMM[kind]())
    assert np.isnan(result).all()


@pytest.mark.parametrize("engine", ["exact", "native"])
@pytest.mark.parametrize(
    ("pressure", "forces"),
    [
        (None, list),
        (None, lambda: [openmm.MonteCarloBarostat(1, 297, 0)]),
        (None, lambda: [openmm.CMMotionRemover(2)]),
        (1.0, list),
    ],
    ids=["bath", "a barostat that does not act", "motion that is removed", "pressure="],
)
def test_the_conserved_energy_is_conserved_where_all_heat_is_counted(tmp_path, box, pressure, forces, engine):
    """Of 177 atoms at 1 fs it oscillates by less than 1 kJ/mol; the motion of the box that is removed has 570.

    With rigid waters a bath of 5/ps gives some 10 kJ/mol a step.
    """
    integrator = SIERLangevinIntegrator(297, 5, 0.001, pressure=pressure, barostatInterval=1, engine=engine)
    result = conserved(tmp_path, box, seeded(integrator, 1), *forces(), drift=0.6 if forces() else 0.0, steps=8)
    assert np.isfinite(result).all()
    assert np.ptp(result) < 2.0


def test_without_periodic_boundaries_there_is_no_density(tmp_path):
    topology, positions, system = cluster_system(4)
    simulation = simulation_of(
        topology, system, SIERIntegrator(0.0005, "SIER2"), "Reference", (positions, 0 * positions)
    )
    simulation.reporters.append(ConservationReporter(tmp_path / "log.csv", 1))
    simulation.step(1)
    assert (tmp_path / "log.csv").read_text().splitlines()[1].endswith("nan,nan")


def test_a_log_with_other_columns_is_not_continued(tmp_path):
    (tmp_path / "old.csv").write_text("Step,Time (ps),Total Energy (kJ/mol)\n")
    with pytest.raises(ValueError, match=r"old\.csv .*3 columns"):
        ConservationReporter(tmp_path / "old.csv", 1, append=True)


@pytest.mark.parametrize("make", [ConservationReporter, PressureReporter])
def test_tables_are_continued(tmp_path, box, make):
    path = tmp_path / "log.csv"
    for append in (False, True):
        simulation = simulation_at(box, SIERIntegrator(0.001, "SIER2"))
        simulation.reporters.append(make(path, 2, append=append))
        simulation.step(4)
        simulation.reporters.pop().close()
    lines = path.read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["Step", "2", "4", "2", "4"]


@pytest.mark.parametrize("make", [ConservationReporter, PressureReporter])
@pytest.mark.parametrize("lost", [1, 5])
def test_a_row_that_was_cut_is_not_continued(tmp_path, box, make, lost):
    """As after a kill or on a full disk: without its end a row of step 1 and one of step 10 would be one of 110."""
    path = tmp_path / "log.csv"
    simulation = simulation_at(box, SIERIntegrator(0.001, "SIER2"))
    simulation.reporters.append(make(path, 2))
    simulation.step(4)
    simulation.reporters.pop().close()
    whole = path.read_bytes()
    kept = whole[: whole.rindex(b"\n", 0, -1) + 1]
    path.write_bytes(whole[:-lost])
    with pytest.warns(UserWarning, match=r"log\.csv .*\d+ bytes"):
        reporter = make(path, 2, append=True)
    assert path.read_bytes() == kept
    simulation.reporters.append(reporter)
    simulation.step(2)
    reporter.close()
    assert path.read_bytes().startswith(kept)
    assert [line.split(",")[0] for line in path.read_text().splitlines()] == ["Step", "2", "6"]


def test_a_heading_that_was_cut_is_refused(tmp_path):
    path, heading = tmp_path / "log.csv", ",".join(conservation.COLUMNS)
    path.write_text(heading)
    with pytest.raises(ValueError, match=r"log\.csv cannot be continued"):
        ConservationReporter(path, 1, append=True)
    assert path.read_text() == heading


def test_body_states(tmp_path, box):
    integrator = SIERIntegrator(0.001, "SIER2")
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
        assert "L in dalton nm^2/ps" in file.attrs["units"]
    simulation.reporters[0].close()


def test_body_states_have_the_names_of_domains(tmp_path):
    """Bodies are numbered as they were listed, not in the order of their names."""
    topology, positions, system = topology_of(), folded(), domain_system()
    domains = select_bodies(topology, {"head": "A:2-13", "tail": "A:24-37"})
    bodies = RigidBodies.from_system(system, topology, domains, positions)
    for number, names in enumerate((domains, {"tail": domains[1]}, {"both": range(30)}, {"none": [0, 100]})):
        simulation = simulation_of(
            topology, system, SIERIntegrator(0.001, "SIER2", bodies=bodies), "Reference", (positions, 0 * positions)
        )
        path = tmp_path / f"{number}.h5"
        simulation.reporters.append(BodyStateReporter(path, 1, names=names))
        if number > 1:
            with pytest.raises(ValueError, match=f"{number}.h5 cannot be begun"):
                simulation.step(1)
            continue
        simulation.step(1)
        owners = simulation.integrator.bodies.owners
        with h5py.File(path, "r") as file:
            result = file["name"].asstr()[:].tolist()
        assert result[owners[25]] == "tail"
        assert result[owners[5]] == ("head" if number == 0 else "")
        assert sum(map(bool, result)) == 2 - number


def test_body_states_determine_the_atoms(tmp_path):
    """Atoms rebuilt from nothing but the file, of a salt solution whose box changes, against those of the Context."""
    topology, positions, system = periodic_system(ions=True)
    simulation = simulation_of(
        topology, system, SIERIntegrator(0.001, "SIER2"), "Reference", (positions, 0 * positions)
    )
    path = tmp_path / "bodies.h5"
    simulation.minimizeEnergy(maxIterations=20)
    simulation.reporters.append(BodyStateReporter(path, 20))
    simulation.step(20)
    box = simulation.context.getState().getPeriodicBoxVectors(asNumpy=True)
    simulation.context.setPeriodicBoxVectors(*(1.01 * box))
    simulation.step(20)
    state = simulation.context.getState(positions=True)
    with h5py.File(path, "r") as file:
        assert [file.attrs[name][:3] for name in ("frame", "quaternion")] == ["lab", "(w,"]
        rebuilt = np.full((system.getNumParticles(), 3), np.nan)
        species = file["species"][:]
        for number in range(species.max() + 1):
            group = file[f"species_{number}"]
            is_of_species = species == number
            q, quaternion = file["q"][-1][is_of_species], file["quaternion"][-1][is_of_species]
            rotated = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix() @ group["sites"][:].T
            rebuilt[group["atoms"][:]] = q[:, None] + rotated.transpose(0, 2, 1)
            np.testing.assert_array_equal(file["masses"][:][is_of_species], group["masses"][:].sum())
            masses = [system.getParticleMass(int(i))._value for i in group["atoms"][0]]
            np.testing.assert_array_equal(group["masses"], masses)
        boxes = file["box"][:]
    # Quaternions and back: rounding of positions of 2 nm.
    assert np.abs(rebuilt - state.getPositions(asNumpy=True)._value).max() < 1e-13
    np.testing.assert_array_equal(boxes[-1], state.getPeriodicBoxVectors(asNumpy=True)._value)
    assert not np.array_equal(boxes[0], boxes[1])


def test_centres_are_wrapped_on_demand(tmp_path, box):
    topology, system, (positions, velocities) = box
    edge = system.getDefaultPeriodicBoxVectors()[0][0]._value
    far = positions + edge * np.array([2, -3, 0.0])
    results = {}
    for unwrapped in (True, False):
        simulation = simulation_of(topology, system, SIERIntegrator(0.001, "SIER2"), "CPU", (far, velocities))
        path = tmp_path / f"{unwrapped}.h5"
        simulation.reporters.append(BodyStateReporter(path, 1, unwrapped=unwrapped))
        simulation.step(1)
        with h5py.File(path, "r") as file:
            results[file.attrs["wrapped"]] = file["q"][0]
    continuous, wrapped = results["no"], results["into the box"]
    assert continuous[:, 0].min() > edge
    assert wrapped.min() >= 0
    assert wrapped.max() <= edge
    images = (continuous - wrapped) / edge
    # Two runs on the CPU platform differ by rounding in single precision.
    assert np.abs(images - np.round(images)).max() < 1e-5


def test_body_states_are_continued(tmp_path, box):
    path = tmp_path / "bodies.h5"
    # A run that ended before its first report.
    BodyStateReporter(path, 2)
    for _ in range(2):
        simulation = simulation_at(box, SIERIntegrator(0.001, "SIER2"))
        reporter = BodyStateReporter(path, 2, append=True)
        simulation.reporters.append(reporter)
        simulation.step(4)
        reporter.close()
    with h5py.File(path, "r") as file:
        assert file["step"][:].tolist() == [2, 4, 2, 4]
        assert file["q"].shape == (4, 59, 3)
    topology, positions, system = cluster_system(4)
    other = simulation_of(topology, system, SIERIntegrator(0.001, "SIER2"), "Reference", (positions, 0 * positions))
    other.reporters.append(BodyStateReporter(path, 1, append=True))
    with pytest.raises(ValueError, match=r"bodies\.h5 cannot be continued"):
        other.step(1)


@pytest.mark.parametrize("make", [ConservationReporter, BodyStateReporter])
def test_other_integrators_are_refused(tmp_path, box, make):
    simulation = simulation_at(box, openmm.VerletIntegrator(0.001))
    simulation.reporters.append(make(tmp_path / "file", 1))
    with pytest.raises(TypeError, match="SIER integrator"):
        simulation.step(1)


@pytest.mark.parametrize("interval", [0, 2.5, float("nan"), "10"])
@pytest.mark.parametrize("make", [ConservationReporter, PressureReporter, BodyStateReporter])
def test_impossible_intervals(tmp_path, make, interval):
    with pytest.raises(ValueError, match=f"reportInterval .*{interval!r}$"):
        make(tmp_path / "file", interval)
    assert not any(tmp_path.iterdir())
