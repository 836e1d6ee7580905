"""Forces that are expressions or collective variables limit the step as harmonic bonds do: they are measured."""

import math

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import SIER2, SIER4G, RigidBodies, SIERIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.stability.motions import Motions
from openmm_sier.system import measurement
from tests.support.silence import silence
from tests.support.systems import assembled, field, with_forces
from tests.support.waters import cluster_system, context_at, phase_point, platform

#: kJ/mol/nm^2.
K = 1e5


def bond(energy, atoms=(0, 1), **parameters):
    """A CustomBondForce with one term, all of whose parameters are global."""
    force = openmm.CustomBondForce(energy)
    for name, value in parameters.items():
        force.addGlobalParameter(name, value)
    force.addBond(*atoms, [])
    return force


def compound(energy, atoms):
    force = openmm.CustomCompoundBondForce(len(atoms), energy)
    force.addBond(atoms, [])
    return force


def measured(system, positions, bodies=None, **parameters):
    """The motions that are measured at positions (N, 3) in nm, with values of global parameters."""
    bodies = bodies or RigidBodies.from_system(system)
    motions = Motions(system, bodies, bodies.species)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform())
    context.setPositions(np.array(positions, dtype=float))
    for name, value in parameters.items():
        context.setParameter(name, value)
    assert motions.measure(context)
    assert not motions.measure(context)
    return motions.measured


def squares(motions):
    return [(2 * math.pi / motion.period) ** 2 for motion in motions]


@pytest.mark.parametrize("stretch", [-0.003, 0.0, 0.003])
@pytest.mark.parametrize(
    ("energy", "curvature"),
    [
        ("50000*(r-0.1)^2", lambda x: K),
        # As AMOEBA has it.
        ("50000*(d^2-20*d^3); d=r-0.1", lambda x: K * (1 - 60 * x)),
        ("depth*(1-exp(-20*(r-0.1)))^2", lambda x: 2 * 125 * 400 * (2 * math.exp(-40 * x) - math.exp(-20 * x))),
    ],
)
def test_a_bond_has_the_period_of_its_curvature_where_it_is(energy, curvature, stretch):
    system = assembled([1.0, 16.0], bond(energy, **({"depth": 125.0} if "depth" in energy else {})))
    (motions,) = measured(system, [[0, 0, 0], [0, 0.06, 0.08 + stretch * 1.25]])
    x = math.hypot(0.06, 0.08 + stretch * 1.25) - 0.1
    # Displacements of 1e-5 nm leave 1e-6 by the fourth derivative.
    assert squares([motions])[0] == pytest.approx(curvature(x) * (1 + 1 / 16), rel=1e-5)
    assert motions.atoms == (0, 1)


def test_every_term_counts_with_its_own_parameters_and_masses():
    force = openmm.CustomBondForce("k*(r-0.1)^2/2")
    force.addPerBondParameter("k")
    for atoms, k in (((1, 0), K), ((3, 2), 4 * K), ((4, 5), 2 * K)):
        force.addBond(*atoms, [k])
    system = assembled([1.0, 16.0, 12.0, 12.0, 0.0, 4.0], force)
    x = [[0, 0, 0], [0.1, 0, 0], [1, 0, 0], [1, 0.1, 0], [2, 0, 0], [2, 0, 0.1]]
    (motions,) = measured(system, x)
    assert squares([motions])[0] == pytest.approx(K * (1 + 1 / 16), rel=1e-5)
    assert motions.atoms == (1, 0)


def test_parameters_are_those_of_the_context():
    system = assembled([1.0, 1.0], bond("scale*50000*(r-0.1)^2", scale=1.0))
    x = [[0, 0, 0], [0.1, 0, 0]]
    assert squares(measured(system, x, scale=0.25)) == pytest.approx([0.25 * K * 2], rel=1e-5)
    assert measured(system, x, scale=0.0) == []


def test_nearest_images_are_those_of_the_box():
    force = bond("50000*(r-0.1)^2")
    force.setUsesPeriodicBoundaryConditions(True)
    assert squares(measured(assembled([1.0, 1.0], force), [[0, 0, 0], [1.9, 0, 0]])) == pytest.approx([K * 2], rel=1e-5)


def test_bonds_within_a_body_or_held_by_a_constraint_do_not_count():
    system = assembled([1.0, 16.0, 1.0], bond("50000*(r-0.1)^2"))
    x = np.array([[0.1, 0, 0], [0, 0, 0], [0, 0.1, 0]])
    named = RigidBodies.from_system(system, rigid=[[0, 1, 2]], positions=x)
    assert measured(system, x, named) == []
    assert len(measured(system, x)) == 1
    system.addConstraint(0, 1, 0.1)
    assert measured(system, x) == []


def test_a_term_of_three_atoms_has_the_fastest_of_its_modes():
    """The asymmetric stretch of a molecule in line: k (1/m + 2/M); and with one bond held, that of m against m + M."""
    chain = "50000*((distance(p1,p2)-0.1)^2+(distance(p2,p3)-0.1)^2)"
    system = assembled([16.0, 12.0, 16.0], compound(chain, [0, 1, 2]))
    x = [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]]
    (motions,) = measured(system, x)
    assert squares([motions])[0] == pytest.approx(K * (1 / 16 + 2 / 12), rel=1e-5)
    assert motions.atoms == (1,)
    system.addConstraint(0, 1, 0.1)
    assert squares(measured(system, x)) == pytest.approx([K * (1 / 16 + 1 / 28)], rel=1e-5)


def test_what_is_far_from_its_minimum_is_no_vibration():
    """Two atoms that overlap in a start, and a restraint that does not hold yet."""
    # 4 epsilon (s/r)^12 with the curvature 4e6 kJ/mol/nm^2 at 0.2 nm.
    overlap = bond("0.4*4*((0.34/r)^12-(0.34/r)^6)")
    restraint = bond("50000*(r-0.1)^2", (0, 2))
    x = [[0, 0, 0], [0.2, 0, 0], [0, 0.4, 0]]
    assert measured(assembled(3 * [12.0], overlap), x) == []
    # Its atoms swing about each other by its tension, with K (r - 0.1)/r.
    assert squares(measured(assembled(3 * [12.0], restraint), x)) == pytest.approx([0.75 * K / 6], rel=1e-5)
    x[2] = [0, 0.11, 0]
    system = assembled(3 * [12.0], bond("0.4*4*((0.34/r)^12-(0.34/r)^6)"), bond("50000*(r-0.1)^2", (0, 2)))
    assert squares(measured(system, x)) == pytest.approx([K / 6], rel=1e-5)


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_a_step_that_is_too_long_is_refused_when_there_are_positions(engine):
    system = assembled([1.0, 16.0], bond("231375*(r-0.1)^2"))
    integrator = SIERIntegrator(0.006, SIER4G, engine=engine)
    x = np.array([[0, 0, 0], [0.1, 0, 0]])
    context = context_at(system, integrator, (x, 0 * x))
    period = 2 * math.pi / math.sqrt(462750 * (1 + 1 / 16))
    with pytest.raises(openmm.OpenMMException) as refusal:
        integrator.step(1)
    message = (
        "A step of 6 fs is too long: the bond between atoms 0 and 1 by CustomBondForce is not constrained and has a"
    )
    assert f"{message} period of {1000 * period:.3g} fs" in str(refusal.value)
    assert context.getStepCount() == 0
    assert np.array_equal(context.getState(positions=True).getPositions(asNumpy=True)._value, x)
    integrator.setStepSize(0.003)
    with silence():
        integrator.step(1)


def test_a_stiff_restraint_is_refused_by_what_causes_it():
    system = assembled([1.0], field("k*x^2/2", [0], k=1e6))
    integrator = SIERIntegrator(0.006, SIER2)
    context = context_at(system, integrator, (np.zeros((1, 3)), np.zeros((1, 3))))
    with pytest.raises(openmm.OpenMMException, match="atom 0 by CustomExternalForce"):
        integrator.step(1)
    assert context.getStepCount() == 0


def overlapping(pairs, stiffness):
    """One Force of pairs of atoms that overlap, each in its own way, and of a bond; its period, ps."""
    force = openmm.CustomBondForce("depth*((0.34/r)^12-(0.34/r)^6) + k*(r-0.1)^2/2")
    force.addPerBondParameter("depth")
    force.addPerBondParameter("k")
    x = []
    for i in range(pairs):
        force.addBond(2 * i, 2 * i + 1, [1.6 * 1.3**i, 0])
        x += [[i, 0, 0], [i + 0.2, 0, 0]]
    force.addBond(2 * pairs, 2 * pairs + 1, [0, stiffness])
    x += [[0, 1, 0], [0, 1.1, 0]]
    masses = [*(2 * pairs * [12.0]), 1.0, 16.0]
    return assembled(masses, force), x, 2 * math.pi / math.sqrt(stiffness * (1 + 1 / 16))


@pytest.mark.parametrize("pairs", [1, 4])
def test_overlaps_do_not_hide_a_bond(pairs):
    """Each is stiffer than the bond, from 4e6 kJ/mol/nm^2 on."""
    system, x, period = overlapping(pairs, 4e5)
    (motion,) = measured(system, x)
    # The search ends at a residual of 1e-3 of the square.
    assert motion.period == pytest.approx(period, rel=1e-3)
    assert motion.atoms == (2 * pairs, 2 * pairs + 1)


def test_a_force_whose_bonds_many_overlaps_hide_is_named():
    system, x, _ = overlapping(30, 4e5)
    integrator = SIERIntegrator(0.001, "SIER2")
    x = np.array(x)
    context = context_at(system, integrator, (x, 0 * x))
    with pytest.warns(UserWarning, match="1 fs cannot be judged.*CustomBondForce"):
        integrator.impl.engine.step_check(integrator.impl.method(), 1, context)


def test_many_equal_bonds_have_the_period_of_one():
    """The mode is spread over all of them, and one is named."""
    force = openmm.CustomBondForce("231375*(r-0.1)^2")
    for i in range(0, 100, 2):
        force.addBond(i, i + 1)
    system = assembled(50 * [1.0, 16.0], force)
    x = np.zeros((100, 3))
    x[:, 0] = np.arange(100) // 2
    x[1::2, 1] = 0.1
    (motion,) = measured(system, x)
    assert squares([motion])[0] == pytest.approx(462750 * (1 + 1 / 16), rel=1e-5)
    assert motion.atoms[0] % 2 == 0
    assert motion.atoms[1] == motion.atoms[0] + 1


def in_fields():
    """Three waters whose oxygens a field holds, positions and velocities."""
    _, x, system = cluster_system(3)
    held = field("100*(x^2+y^2+z^2)", [0, 3, 6])
    return with_forces(system, held), (x, 0 * x)


def test_a_measurement_changes_no_trajectory(monkeypatch):
    ends = []
    for is_measured in (True, False):
        if not is_measured:
            monkeypatch.setattr(Motions, "measure", lambda *_: False)
        system, point = in_fields()
        integrator = SIERLangevinIntegrator(300, 1, 0.002)
        integrator.setRandomNumberSeed(1)
        ends.append(phase_point(context_at(system, integrator, point, "CPU", steps=3)))
    assert np.array_equal(*ends)


def test_a_measurement_that_is_interrupted_is_made_again(monkeypatch):
    """The Context does not change, and a step that is too long is still refused."""

    def interrupted(*_):
        raise KeyboardInterrupt

    system = assembled([1.0, 16.0], bond("231375*(r-0.1)^2"))
    x = np.array([[0, 0, 0], [0.1, 0, 0]])
    integrator = SIERIntegrator(0.006, SIER4G)
    context = context_at(system, integrator, (x, 0 * x))
    before = phase_point(context)
    with monkeypatch.context() as patch:
        patch.setattr(measurement, "_largest", interrupted)
        with pytest.raises(KeyboardInterrupt):
            integrator.step(1)
    assert np.array_equal(phase_point(context), before)
    with pytest.raises(openmm.OpenMMException, match="bond between atoms 0 and 1"):
        integrator.step(1)
    assert context.getStepCount() == 0


def test_evaluations_are_few(monkeypatch):
    """Two for the atoms that move, one for the slope and two for each vector, at most 20 of them."""
    counts = []
    counted = measurement._forces_of

    def counting(*arguments):
        forces = counted(*arguments)
        return lambda x: counts.append(1) or forces(x)

    monkeypatch.setattr(measurement, "_forces_of", counting)
    system, point = in_fields()
    measured(system, point[0])
    assert len(counts) <= 9
    counts.clear()
    assert measured(*overlapping(30, 4e5)[:2]) == []
    assert len(counts) <= 43


# --- collective variables ---


def variable(energy, **variables):
    force = openmm.CustomCVForce(energy)
    for name, each in variables.items():
        force.addCollectiveVariable(name, each)
    return force


def centroids(energy, *groups):
    force = openmm.CustomCentroidBondForce(len(groups), energy)
    for group in groups:
        force.addGroup(group)
    force.addBond(range(len(groups)), [])
    return force


#: Forces on three atoms of 1, 16 and 12 dalton in a right angle, and the square of the angular frequency.
SPRINGS = {
    "a distance": (variable("50000*(d-0.1)^2", d=bond("r")), K * (1 + 1 / 16)),
    "two distances": (
        variable("50000*((d-0.1)^2+4*(f-0.12)^2)", d=bond("r"), f=bond("r", (1, 2))),
        # Of two springs at a right angle none knows of the other, and the second has 4 K (1/16 + 1/12).
        K * (1 + 1 / 16),
    ),
    "nested": (variable("e", e=variable("50000*(d-0.1)^2", d=bond("r"))), K * (1 + 1 / 16)),
    "centroids": (centroids("50000*(distance(g1,g2)-0.1)^2", [0], [1]), K * (1 + 1 / 16)),
    "centroids as a variable": (
        variable("50000*(d-0.1)^2", d=centroids("distance(g1,g2)", [0], [1])),
        K * (1 + 1 / 16),
    ),
}


@pytest.mark.parametrize("kind", SPRINGS)
def test_a_collective_variable_has_the_period_of_its_curvature(kind):
    force, expected = SPRINGS[kind]
    x = [[0.1, 0, 0], [0, 0, 0], [0, 0.12, 0]]
    (motions,) = measured(assembled([1.0, 16.0, 12.0], force), x)
    # Displacements of 1e-5 nm, as above; transverse motions have no stiffness where springs have their lengths.
    assert squares([motions])[0] == pytest.approx(expected, rel=1e-5)


def test_an_rmsd_has_the_period_of_its_curvature():
    """k N rmsd^2 / 2 pulls each atom to its place but for motions of the whole: k/m for equal masses."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(6, 3))
    force = variable("3*100000*d^2", d=openmm.RMSDForce(x))
    # At the reference the root has no derivative.
    displaced = x + 1e-3 * rng.normal(size=x.shape)
    (motions,) = measured(assembled(6 * [16.0], force), displaced)
    # The best turn changes with the displacement, of which a thousandth remains.
    assert squares([motions])[0] == pytest.approx(K / 16, rel=5e-3)


def test_collective_variables_move_bodies_and_leave_constraints():
    """A point of a body has the mass with which it can move; a distance that is held does not move."""
    system = assembled([1.0, 16.0, 1.0], variable("50000*(d-0.1)^2", d=bond("r")))
    x = np.array([[0.1, 0, 0], [0, 0, 0], [0, 0.1, 0]])
    named = RigidBodies.from_system(system, rigid=[[0, 1, 2]], positions=x)
    assert measured(system, x, named) == []
    partly = RigidBodies.from_system(system, rigid=[[1, 2]], positions=x)
    # Along x the end of the body is turned about its centre: 1/M + r^2/I.
    centre = 0.1 / 17
    inertia = 16 * centre**2 + (0.1 - centre) ** 2
    (motions,) = measured(system, x, partly)
    assert squares([motions])[0] == pytest.approx(K * (1 + 1 / 17 + centre**2 / inertia), rel=1e-5)
    system.addConstraint(0, 1, 0.1)
    assert measured(system, x) == []


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_a_bias_draws_no_word_and_a_stiff_one_is_refused(engine):
    """Metadynamics begins with a table of zeros; at 9 fs its step is that of everything else."""
    table = openmm.Continuous1DFunction(np.zeros(50), 0, 1)
    bias = variable("table(d)", d=bond("r"))
    bias.addTabulatedFunction("table", table)
    x = np.array([[0.1, 0, 0], [0, 0, 0]])
    with silence():
        soft = SIERIntegrator(0.009, SIER2, engine=engine)
        context_at(assembled([12.0, 12.0], bias), soft, (x, 0 * x), steps=1)
    stiff = variable("231375*(d-0.1)^2", d=bond("r"))
    stiff.setName("bias")
    integrator = SIERIntegrator(0.009, SIER2, engine=engine)
    context = context_at(assembled([1.0, 16.0], stiff), integrator, (x, 0 * x))
    with pytest.raises(openmm.OpenMMException, match=r"atom 0 by bias .*8\.96 fs"):
        integrator.step(1)
    assert context.getStepCount() == 0


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_amoebas_flexible_water_is_refused_where_kicks_destroy_it(engine):
    """Prepared, at 6 fs, it reached 2e15 kJ/mol in one step, and OpenMM crashed."""
    topology, positions, _ = cluster_system(2)
    forcefield = app.ForceField("amoeba2018.xml")
    system = forcefield.createSystem(topology, nonbondedMethod=app.NoCutoff, rigidWater=False)
    # OpenMM takes long to make a Context of the others, which do not matter here.
    for i in reversed(range(system.getNumForces())):
        if system.getForce(i).getName() not in ("AmoebaBondForce", "HarmonicBondForce", "AmoebaAngleForce"):
            system.removeForce(i)
    prepare_system(system)
    integrator = SIERIntegrator(0.006, SIER4G, engine=engine, substeps=8)
    context = context_at(system, integrator, (positions, 0 * np.array(positions)))
    with pytest.raises(openmm.OpenMMException, match=r"bond between atoms \d and \d"):
        integrator.step(1)
    assert context.getStepCount() == 0


def test_a_force_of_which_nothing_is_known_is_named_once():
    """A collective variable of all pairs: to measure it would take as long as to compute all forces many times."""
    pairs = openmm.CustomNonbondedForce("r")
    pairs.addParticle([])
    pairs.addParticle([])
    force = variable("50*d^2", d=pairs)
    force.setName("bias")
    system = assembled([1.0, 1.0], force)
    x = np.array([[0, 0, 0], [0.1, 0, 0]])
    integrator = SIERIntegrator(0.002, SIER4G)
    with silence():
        # No bond of a molecule is too fast for this step.
        context = context_at(system, integrator, (x, 0 * x), steps=1)
    integrator.setStepSize(6 * unit.femtoseconds)
    message = r"A step of 6 fs cannot be judged, since the stiffness of bias \(CustomCVForce\)"
    with pytest.warns(UserWarning, match=message) as caught:
        integrator.step(2)
    assert len(caught) == 1
    assert context.getStepCount() == 3
