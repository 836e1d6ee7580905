"""Atoms frozen by the mass 0: they exert forces and stay where they are, and their constraints are ignored."""

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier import (
    RigidBodies,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
    SIERThermostatIntegrator,
)
from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.ensembles import VelocityRescaling
from openmm_sier.inputs.equilibration import stop_centre_of_mass
from openmm_sier.observe.reporters import BodyStateReporter, ConservationReporter
from tests.support.peptides import capped_alanine, capped_alanine_box
from tests.support.restarts import simulation_of
from tests.support.seeded import seeded
from tests.support.silence import silence
from tests.support.waters import (
    cluster_system,
    context_at,
    energies,
    periodic_system,
    phase_point,
    settled,
)

ENGINES = ("exact", "native")


def freeze(system, atoms):
    for atom in atoms:
        if not system.isVirtualSite(atom):
            system.setParticleMass(atom, 0)
    return list(atoms)


def frozen_water(model):
    topology, positions, system = cluster_system(4, model)
    return topology, positions, system, freeze(system, range(system.getNumParticles() // 4))


def frozen_peptide(*residues):
    """A peptide in water with residues frozen; if it is one of three, bonded forces join frozen atoms to others."""
    system, positions = capped_alanine(4)
    topology, _ = capped_alanine_box(4)
    atoms = [atom.index for atom in topology.atoms() if atom.residue.name in residues]
    return topology, positions, system, freeze(system, atoms)


CASES = {
    "tip3p": lambda: frozen_water("tip3p"),
    "tip4pew": lambda: frozen_water("tip4pew"),
    "peptide": lambda: frozen_peptide("ACE", "ALA", "NME"),
    "residue": lambda: frozen_peptide("ALA"),
}


@pytest.fixture(scope="module", params=CASES)
def frozen(request):
    *made, atoms = CASES[request.param]()
    _, system, point = settled(f"frozen-{request.param}", *made, steps=100)
    return system, point, atoms


@pytest.mark.parametrize("engine", ENGINES)
def test_frozen_atoms_hold_no_heat(frozen, engine):
    system, point, atoms = frozen
    integrator = SIERIntegrator(0.0005, engine=engine)
    context = context_at(system, integrator, point)
    context.setVelocitiesToTemperature(300, 1)
    assert not phase_point(context)[1][atoms].any()
    massive = [i for i in range(system.getNumParticles()) if system.getParticleMass(i)._value > 0]
    pairs = (system.getConstraintParameters(i)[:2] for i in range(system.getNumConstraints()))
    dof = 3 * len(massive) - sum(a in massive for a, _ in pairs)
    assert not integrator.conservesMomentum
    _, kinetic = energies(context)
    # OpenMM's SETTLE leaves velocities off their constraints by 1e-9, see the table of its facts.
    expected = 2 * kinetic / (dof * GAS_CONSTANT)
    assert integrator.computeSystemTemperature()._value == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("engine", ENGINES)
def test_baths_trials_and_minimizer_leave_them(engine):
    *water, atoms = frozen_water("tip3p")
    _, system, point = settled("frozen-tip3p", *water, steps=100)
    for integrator in (
        SIERLangevinIntegrator(300, 5, 0.004, engine=engine),
        SIERHMCIntegrator(300, 0.004, stepsPerTrial=5, engine=engine),
    ):
        context = context_at(system, integrator, point, steps=20)
        openmm.LocalEnergyMinimizer.minimize(context, maxIterations=5)
        assert np.array_equal(phase_point(context)[0][atoms], point[0][atoms])
        assert np.abs(phase_point(context)[0] - point[0]).max() > 1e-3


def test_a_constraint_between_a_frozen_atom_and_another_is_refused_as_by_openmm():
    _, _, system = cluster_system(2)
    system.setParticleMass(1, 0)
    for integrator in (openmm.VerletIntegrator(0.001), SIERIntegrator(0.001)):
        with pytest.raises(openmm.OpenMMException, match="massless particle"):
            openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))


INTEGRATORS = {
    "constant energy": lambda engine: SIERIntegrator(0.001, engine=engine),
    "Langevin": lambda engine: SIERLangevinIntegrator(300, 1, 0.001, engine=engine),
    "trials": lambda engine: SIERHMCIntegrator(300, 0.001, engine=engine),
    "rescaling": lambda engine: SIERThermostatIntegrator(VelocityRescaling(300, 0.1), 0.001, engine=engine),
}


@pytest.mark.parametrize("remover", [False, True])
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("make", INTEGRATORS.values(), ids=INTEGRATORS)
def test_where_all_atoms_are_frozen_steps_and_reports_draw_no_warning(tmp_path, make, engine, remover):
    """Nothing moves, no degree of freedom has a temperature, and the centre of mass is at rest."""
    topology, positions, system = cluster_system(2)
    freeze(system, range(system.getNumParticles()))
    if remover:
        system.addForce(openmm.CMMotionRemover())
    integrator = make(engine)
    with silence():
        simulation = simulation_of(topology, system, integrator, "Reference", (positions, 0 * positions))
        simulation.reporters += [
            ConservationReporter(tmp_path / "log.csv", 1),
            app.StateDataReporter(str(tmp_path / "theirs.csv"), 1, temperature=True, totalEnergy=True),
        ]
        simulation.step(2)
        simulation.minimizeEnergy(maxIterations=2)
        simulation.context.setVelocitiesToTemperature(300)
        stop_centre_of_mass(simulation.context)
        simulation.step(1)
    np.testing.assert_array_equal(phase_point(simulation.context)[0], positions)
    assert all(np.isnan(each) for each in integrator.computeTemperatures().in_kelvin())
    rows = np.genfromtxt(tmp_path / "log.csv", delimiter=",", names=True)
    assert (rows["Kinetic_Energy_kJmole"] == 0).all()
    for reporter in simulation.reporters[:1]:
        reporter.close()


def test_body_states_of_a_system_without_bodies(tmp_path):
    h5py = pytest.importorskip("h5py")
    topology, positions, system = cluster_system(2)
    freeze(system, range(system.getNumParticles()))
    for append in (False, True):
        simulation = simulation_of(topology, system, SIERIntegrator(0.001), "Reference", (positions, 0 * positions))
        simulation.reporters.append(BodyStateReporter(tmp_path / "bodies.h5", 1, append=append))
        simulation.step(2)
        simulation.reporters[0].close()
    with h5py.File(tmp_path / "bodies.h5") as file:
        assert file["q"].shape == (4, 0, 3)
        assert file["step"][:].tolist() == [1, 2, 1, 2]


def test_named_bodies_may_be_frozen_as_wholes():
    topology, positions, system = cluster_system(3, rigidWater=False)
    freeze(system, range(3))
    bodies = RigidBodies.from_system(system, topology, np.arange(9).reshape(3, 3), positions)
    assert (bodies.owners >= 0).tolist() == 3 * [False] + 6 * [True]
    assert RigidBodies.from_system(system, rigid=[[0, 1, 2], [3, 4, 5]], positions=positions).n == 4
    system.setParticleMass(4, 0)
    with pytest.raises(RigidityError, match="atom 4 "):
        RigidBodies.from_system(system, rigid=[[3, 4, 5]], positions=positions)


@pytest.mark.parametrize("engine", ENGINES)
def test_barostats_move_frozen_atoms_as_with_integrators_of_openmm(engine):
    _, system, (positions, velocities) = settled("box-59", *periodic_system())
    atoms = freeze(system, range(3))
    with pytest.raises(openmm.OpenMMException, match="particle 0 "):
        context_at(system, SIERLangevinIntegrator(300, 1, 0.002, pressure=1), (positions, 0 * positions))
    # At 10^5 bar each move to a smaller box is accepted.
    system.addForce(openmm.MonteCarloBarostat(1e5, 300, 1))
    integrator = seeded(SIERLangevinIntegrator(300, 1, 0.002, engine=engine))
    context = context_at(system, integrator, (positions, velocities))
    integrator.step(20)
    x = phase_point(context)[0]
    # As with OpenMM's own integrators, the frozen molecule keeps its shape and moves with the box.
    assert np.ptp(x[atoms] - positions[atoms], axis=0).max() < 1e-6
    assert np.abs(x[atoms] - positions[atoms]).max() > 1e-6
