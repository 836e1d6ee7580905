"""Steps that are too long for the librations of molecules: warnings of inaccurate ones, refusals of hopeless ones."""

import openmm
import pytest

from openmm_sier import (
    SIER2V2,
    SIER4G,
    RigidBodies,
    SIERHMCIntegrator,
    SIERIntegrator,
    SIERLangevinIntegrator,
)
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.stability.step_rules import HOPELESS
from tests.support.silence import silence
from tests.support.systems import assembled, with_forces
from tests.support.waters import cluster_system, context_at, energies, judged

ENGINES = ("exact", "native")


def silently(system, integrator):
    with silence():
        return judged(system, integrator)


def longest(system, scheme=SIER4G):
    return StepCheck(system, RigidBodies.from_system(system)).longest_step(scheme, 1, 0)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("model", ["tip3p", "spce", "tip4pew", "tip5p"])
def test_steps_in_use_are_taken(model, engine):
    """The usual step, in a bath 9 fs, of SIER2 6 fs, and Verlet's 3 fs draw no warning; 4 and 12 fs do."""
    _, _, system = cluster_system(3, model)
    for integrator in (
        SIERIntegrator(SIER4G.constant_energy_step, engine=engine),
        SIERLangevinIntegrator(297, 1, 0.009, SIER4G, engine=engine),
        SIERLangevinIntegrator(297, 1, 0.006, engine=engine),
        SIERIntegrator(0.003, "SIER2", engine=engine),
    ):
        silently(system, integrator)
    for integrator in (SIERIntegrator(0.012, engine=engine), SIERIntegrator(0.004, "SIER2", engine=engine)):
        with pytest.warns(
            UserWarning,
            match=r"is long: .*31\.5 fs",
        ):
            judged(system, integrator)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_step_at_which_the_energy_walks(engine):
    """One warning with the expected error and a step; none where the energy is not conserved anyway."""
    _, positions, system = cluster_system(3)
    message = r"With steps of 6 fs the total energy wanders: .* is about 0\.[67] %, and 0\.0\d+ % with SIER4G at 4 fs"
    integrator = SIERIntegrator(0.006, engine=engine)
    with pytest.warns(UserWarning, match=message):
        context = context_at(system, integrator, (positions, 0 * positions), steps=1)
    with silence():
        integrator.setStepSize(0.007)
        integrator.step(1)
    assert context.getStepCount() == 2
    silently(system, SIERLangevinIntegrator(297, 1, 0.006, SIER4G, engine=engine))
    silently(system, SIERHMCIntegrator(297, 0.006, engine=engine))
    silently(system, SIERIntegrator(0.006, SIER2V2, engine=engine))
    if engine == "exact":  # the native one takes no AndersenThermostat
        with_collisions = with_forces(system, openmm.AndersenThermostat(297, 1))
        silently(with_collisions, SIERIntegrator(0.006, engine=engine))
    for i in range(9):
        system.setParticleMass(i, 4 * system.getParticleMass(i))
    silently(system, SIERIntegrator(0.008, engine=engine))


@pytest.mark.parametrize("engine", ENGINES)
def test_picoseconds_in_place_of_femtoseconds(engine):
    _, positions, system = cluster_system(3)
    with pytest.raises(openmm.OpenMMException, match=r"6\*unit\.femtoseconds"):
        judged(system, SIERIntegrator(6, engine=engine))
    integrator = SIERIntegrator(0.006, engine=engine)
    context = context_at(system, integrator, (positions, 0 * positions))
    integrator.setStepSize(6)
    with pytest.raises(openmm.OpenMMException, match="is too long"):
        integrator.step(1)
    assert context.getStepCount() == 0


@pytest.mark.parametrize("scheme", CATALOGUE.values(), ids=lambda scheme: scheme.name)
def test_refused_steps_are_hopeless(box, scheme):
    """Just below the refusal the energy of a liquid grows without end, here by a third of its kinetic energy."""
    _, system, point = box
    h = 0.999 * HOPELESS * longest(system, scheme) * scheme.stability_limit / scheme.accuracy_limit
    integrator = SIERIntegrator(h, scheme)
    with pytest.warns(UserWarning, match="is long"):
        context = context_at(system, integrator, point, "CPU", steps=0)
    (potential, kinetic), gain, time = energies(context), 0.0, 0.0
    # SIER4V, the slowest to do so, gains twice as much within 1.2 ps, and ten times as long is left to each of them. It
    # changes by less than 0.01 with SIER4G at 6 fs.
    while gain < kinetic / 3 and time < 12:
        integrator.step(2)
        gain, time = sum(energies(context)) - potential - kinetic, time + 2 * h
    assert gain >= kinetic / 3
    integrator.setStepSize(h / 0.998)
    with pytest.raises(openmm.OpenMMException, match="is too long"):
        integrator.step(1)


def test_heavier_hydrogens_are_slower():
    """Masses times four: half the frequency, and twice the step, whatever the model."""
    _, _, light = cluster_system(3)
    _, _, heavy = cluster_system(3)
    for i in range(9):
        heavy.setParticleMass(i, 4 * light.getParticleMass(i))
    assert longest(heavy) == pytest.approx(2 * longest(light), rel=1e-12)


def behind_hydrogens(count):
    """Two TIP3P waters after hydrogens without charges, whose mass is that of the hydrogens of water."""
    force = openmm.NonbondedForce()
    for _ in range(count):
        force.addParticle(0.0, 0.2, 0.01)
    for charge, sigma, epsilon in 2 * [(-0.834, 0.315, 0.636), (0.417, 0.1, 0.0), (0.417, 0.1, 0.0)]:
        force.addParticle(charge, sigma, epsilon)
    lengths = ((0, 1, 0.09572), (0, 2, 0.09572), (1, 2, 0.15139))
    constraints = [(start + i, start + j, length) for start in (count, count + 3) for i, j, length in lengths]
    return assembled([1.008] * count + 2 * [15.9994, 1.008, 1.008], force, constraints=constraints)


@pytest.mark.parametrize("engine", ENGINES)
def test_every_atom_counts(engine):
    """Charges of one atom of a mass say nothing of the others: those of water may come after a large solute."""
    with pytest.warns(UserWarning, match=r"is long: .*31\.5 fs"):
        judged(behind_hydrogens(200), SIERIntegrator(0.012, engine=engine))


def gas(charge=0.0, epsilon=0.0):
    """Two rigid dumbbells of hydrogens in a NonbondedForce."""
    force = openmm.NonbondedForce()
    for i in range(4):
        force.addParticle((-1) ** i * charge, 0.3, epsilon)
    return assembled(4 * [1.0], force, constraints=((0, 1, 0.1), (2, 3, 0.1)))


@pytest.mark.parametrize("engine", ENGINES)
def test_what_nothing_holds_takes_any_step(engine):
    alone, with_frozen = cluster_system(1)[2], cluster_system(2)[2]

    def long():
        return SIERIntegrator(6, engine=engine)

    bend = openmm.HarmonicAngleForce()
    bend.addAngle(1, 0, 2, 1.9, 300)
    for system in (assembled([18.0, 18.0]), alone, with_forces(gas(charge=0.5), bend)):
        silently(system, long())
    for i in range(3):
        with_frozen.setParticleMass(i, 0)
    for system in (gas(charge=0.5), gas(epsilon=1.0), with_frozen):
        with pytest.raises(openmm.OpenMMException, match="is too long"):
            judged(system, long())
    silently(gas(charge=0.5), SIERIntegrator(0, engine=engine))
    ignored = long()
    ignored.setIntegrationForceGroups({1})
    silently(gas(charge=0.5), ignored)
