"""Fast forces in the drift, by both engines on Reference, and what can be fast in the native one."""

import numpy as np
import openmm
import pytest

from openmm_sier import SIER4G, SIERIntegrator, SIERLangevinIntegrator
from openmm_sier.engines.native import program as native_program
from openmm_sier.engines.native.refusals import refuse_fast_forces as refuse
from tests.support.flexible import Points, chains
from tests.support.flexible_systems import FAST, system_of
from tests.support.systems import assembled
from tests.support.waters import context_at, phase_point, water_box

both_engines = pytest.mark.parametrize("engine", ["exact", "native"])


def start_of(points: Points, seed=4):
    state = points.start(np.random.default_rng(seed), 300.0)
    return state, (state.q.T, (state.p / points.masses).T)


def end_of(system, start, h, steps, engine, scheme=SIER4G, groups=(FAST,)):
    integrator = SIERIntegrator(h, scheme, engine=engine, fastForceGroups=groups, substeps=1)
    integrator.setConstraintTolerance(1e-12)
    return phase_point(context_at(system, integrator, start, steps=steps))[0]


@both_engines
def test_fast_forces_may_be_in_several_groups(engine):
    points = chains()
    system, _ = system_of(points)
    _, start = start_of(points)
    split = openmm.XmlSerializer.clone(system)
    springs = split.getForce(0)
    others = openmm.XmlSerializer.clone(springs)
    others.setForceGroup(7)
    for i in range(springs.getNumBonds()):
        a, b, length, constant = springs.getBondParameters(i)
        (springs if i % 2 else others).setBondParameters(i, a, b, length, 0 * constant)
    split.addForce(others)
    both = end_of(split, start, 0.003, 20, engine, groups=(7, FAST))
    # Sums in another order.
    assert both == pytest.approx(end_of(system, start, 0.003, 20, engine), abs=1e-9)


def test_slow_forces_in_other_groups_than_the_program_names_are_refused():
    """The program takes them by the name of their group, whatever groups OpenMM integrates later."""
    points = chains()
    _, start = start_of(points)
    system, _ = system_of(points)
    slow = openmm.CustomExternalForce("x^2")
    slow.addParticle(0)
    slow.setForceGroup(5)
    other = openmm.XmlSerializer.clone(slow)
    other.setForceGroup(7)
    for force in (slow, other):
        system.addForce(force)
    integrator = SIERIntegrator(0.001, engine="native", fastForceGroups={FAST})
    integrator.setIntegrationForceGroups({FAST, 5})
    context = context_at(system, integrator, start, steps=1)
    assert integrator.program.slow_group == 5
    with pytest.raises(openmm.OpenMMException, match=r"group 5, .*\(5, 7\)"):
        integrator.setIntegrationForceGroups({FAST, 5, 7})
    assert context.getStepCount() == 1


def test_counting_heat_changes_no_trajectory_of_a_molecule():
    points = chains()
    _, start = start_of(points)
    ends = []
    for counts in (True, False):
        options = {"engine": "native", "fastForceGroups": {FAST}, "countsHeat": counts}
        # At 0 K, since Reference draws noise for each statement of a program.
        integrator = SIERLangevinIntegrator(0, 20, 0.003, **options)
        integrator.setConstraintTolerance(1e-12)
        context = context_at(system_of(points)[0], integrator, start, steps=6)
        ends.append((*phase_point(context), integrator.computeTemperatures().in_kelvin().total))
    # Rounding of 6 steps of some ten operations, and iterations that end at 1e-12 of a bond.
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-9
    assert np.abs(ends[0][0] - start[0]).max() > 1e-3
    # The temperature is that just after the bath. What it leaves along the constraints is taken away at the end of the
    # step, and bonds turn by a few hundredths in between.
    assert ends[0][2] == pytest.approx(ends[1][2], rel=0.02)


def test_program_prints_its_inner_step_once():
    lines = str(native_program.write(SIER4G, None, {FAST}, 0.25)).splitlines()
    assert len(lines) < 20
    assert sum("drift, inner steps  for e/h = 0.25, 0.25" in line for line in lines) == 2
    assert lines.count("an inner step e:") == 1
    assert any("v = v + 0.16666666666666666*e*f1/m" in line for line in lines)


# --- what can be fast ---


def waters(model):
    topology, _, field = water_box(model)
    system = field.createSystem(topology, rigidWater=False, removeCMMotion=False)
    for force in system.getForces():
        if isinstance(force, (openmm.HarmonicBondForce, openmm.HarmonicAngleForce)):
            force.setForceGroup(FAST)
    return system


def test_bonded_forces_on_atoms_are_taken():
    refuse(waters("tip3p"), {FAST}, 0xFFFFFFFF)
    refuse(waters("tip4pew"), {FAST}, 0xFFFFFFFF)
    refuse(waters("tip4pew"), (), 1)
    # Without virtual sites any force can be fast.
    refuse(waters("tip3p"), {0}, 0xFFFFFFFF)


def test_fast_forces_that_may_act_on_virtual_sites_are_refused():
    system = waters("tip4pew")
    with pytest.raises(openmm.OpenMMException, match=r"NonbondedForce.*prepare_system.*setForceGroup"):
        refuse(system, {0}, 0xFFFFFFFF)
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(0, 1, 0.1, 1.0)
    bonds.addBond(4, 7, 0.1, 1.0)
    bonds.setForceGroup(3)
    system.addForce(bonds)
    with pytest.raises(openmm.OpenMMException, match=r"HarmonicBondForce.*group 3 .*atom 7"):
        refuse(system, {3}, 0xFFFFFFFF)


def test_fast_groups_must_be_integrated():
    with pytest.raises(openmm.OpenMMException, match="force groups"):
        refuse(waters("tip3p"), {FAST, 2}, 0b011)


@both_engines
def test_bonds_that_constraints_hold_do_not_vibrate(engine):
    """The constrained bond has a period of 9 fs, too short for SIER4G at 6 fs; the other one 300 fs."""
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(1, 0, 0.109, 4.5e5)
    bonds.addBond(0, 2, 0.153, 2.6e3)
    system = assembled((12.0, 1.0, 12.0), bonds, constraints=[(0, 1, 0.109)])
    positions = np.array([[0.109, 0, 0], [0, 0, 0], [0.262, 0, 0]])
    integrator = SIERIntegrator(0.006, SIER4G, engine=engine)
    context_at(system, integrator, (positions, np.zeros((3, 3))))
    assert integrator.engine == engine
