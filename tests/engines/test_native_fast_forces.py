"""Programs with fast forces in the drift, executed by plain CustomIntegrators on Reference."""

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER4G, SIER4P, SIERIntegrator
from openmm_sier.engines.native import installation
from openmm_sier.engines.native import program as native_program
from openmm_sier.engines.native.refusals import refuse_fast_forces as refuse
from tests.support.ethane import ethane
from tests.support.flexible import Points, chains
from tests.support.flexible_systems import FAST, system_of
from tests.support.waters import context_at, phase_point, water_box


def integrator_of(program: native_program.Program, h: float) -> openmm.CustomIntegrator:
    integrator = openmm.CustomIntegrator(h / len(program.parts))
    installation.install(program, integrator)
    integrator.setConstraintTolerance(1e-12)
    return integrator


def start_of(points: Points, seed=4):
    state = points.start(np.random.default_rng(seed), 300.0)
    return state, (state.q.T, (state.p / points.masses).T)


def end_of(points: Points, program, start, h, steps):
    integrator = integrator_of(program, h)
    context = context_at(system_of(points)[0], integrator, start, steps=steps * len(program.parts))
    return phase_point(context)


@pytest.mark.parametrize("constrained", [True, False], ids=["C-H constrained", "C-H by springs"])
@pytest.mark.parametrize(("scheme", "order"), [(SIER4G, 4), (SIER4P, 4), (SIER2, 2)], ids=["SIER4G", "SIER4P", "SIER2"])
def test_schemes_with_fast_forces_have_their_order(constrained, scheme, order):
    """Against DOP853, which knows nothing of kicks, drifts and groups."""
    points = chains(constrained)
    state, start = start_of(points)
    exact = points.exact_flow(state, 0.016).q.T
    program = native_program.write(scheme, 1, {FAST})
    # The stiffest springs have a period of 10 fs.
    counts = (8, 16) if order == 4 else (32, 64)
    errors = [np.abs(end_of(points, program, start, 0.016 / n, n)[0] - exact).max() for n in counts]
    # The next term of the error shifts the slope by up to a fifth. Forces that are in both drift and kick, or in
    # neither, leave an error that does not fall at all.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.35)


def test_fast_forces_may_be_in_several_groups():
    points = chains()
    system, _ = system_of(points)
    _, start = start_of(points)
    whole = native_program.write(SIER4G, 1, {FAST})
    context = context_at(system, integrator_of(whole, 0.003), start, steps=20)
    split = openmm.System()
    for mass in points.masses:
        split.addParticle(mass)
    for i in range(system.getNumConstraints()):
        split.addConstraint(*system.getConstraintParameters(i))
    for force in system.getForces():
        copy = openmm.XmlSerializer.clone(force)
        if force.getForceGroup() == FAST:
            others = openmm.XmlSerializer.clone(force)
            others.setForceGroup(7)
            for i in range(force.getNumBonds()):
                a, b, length, constant = force.getBondParameters(i)
                (copy if i % 2 else others).setBondParameters(i, a, b, length, 0 * constant)
            split.addForce(others)
        split.addForce(copy)
    both = context_at(split, integrator_of(native_program.write(SIER4G, 1, [7, FAST]), 0.003), start, steps=20)
    # Sums in another order.
    assert phase_point(both)[0] == pytest.approx(phase_point(context)[0], abs=1e-9)


def test_program_prints_its_inner_step_once():
    lines = str(native_program.write(SIER4G, 2, {FAST})).splitlines()
    assert len(lines) < 20
    assert sum("inner steps of SIER4G  for e/h = 0.25, 0.25" in line for line in lines) == 2
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
    with pytest.raises(openmm.OpenMMException, match=r"NonbondedForce.*force group 0.*virtual sites.*setForceGroup"):
        refuse(system, {0}, 0xFFFFFFFF)
    bonds = openmm.HarmonicBondForce()
    bonds.addBond(0, 1, 0.1, 1.0)
    bonds.addBond(4, 7, 0.1, 1.0)
    bonds.setForceGroup(3)
    system.addForce(bonds)
    with pytest.raises(openmm.OpenMMException, match=r"HarmonicBondForce.*group 3 .*atom 7, .*virtual site"):
        refuse(system, {3}, 0xFFFFFFFF)


def test_fast_groups_must_be_integrated():
    with pytest.raises(openmm.OpenMMException, match="2 is not among the integration force groups"):
        refuse(waters("tip3p"), {FAST, 2}, 0b011)


def test_both_engines_move_a_constrained_molecule_alike():
    """Ethane, whose C-H bonds are constrained: bonded forces in inner steps, and for comparison in the kicks."""
    system, positions = ethane()
    for force in system.getForces():
        force.setForceGroup(1)
    velocities = np.random.default_rng(2).normal(size=(8, 3)) * 0.3
    ends = {}
    for engine, fast in (("exact", {1}), ("native", {1}), ("native", None)):
        integrator = SIERIntegrator(0.004, SIER4G, engine=engine, fastForceGroups=fast)
        context = context_at(system, integrator, (positions, velocities))
        context.applyConstraints(1e-10)
        context.applyVelocityConstraints(1e-10)
        integrator.step(25)
        ends[engine, fast is None] = phase_point(context)[0]
    # Seen: 3e-9 nm, the difference between Yoshida's three steps of RATTLE and Suzuki's five; 1e-5 nm in the kicks.
    assert np.abs(ends["native", False] - ends["exact", False]).max() < 3e-8
    assert np.abs(ends["native", True] - ends["exact", False]).max() > 1e-6


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_bonds_that_constraints_hold_do_not_vibrate(engine):
    """The constrained bond has a period of 9 fs, at which SIER4G bears no step of 6 fs; the other one 300 fs."""
    system, bonds = openmm.System(), openmm.HarmonicBondForce()
    for mass in (12.0, 1.0, 12.0):
        system.addParticle(mass)
    system.addConstraint(0, 1, 0.109)
    bonds.addBond(1, 0, 0.109, 4.5e5)
    bonds.addBond(0, 2, 0.153, 2.6e3)
    system.addForce(bonds)
    positions = np.array([[0.109, 0, 0], [0, 0, 0], [0.262, 0, 0]])
    integrator = SIERIntegrator(0.006, SIER4G, engine=engine)
    context_at(system, integrator, (positions, np.zeros((3, 3))))
    assert integrator.engine == engine
