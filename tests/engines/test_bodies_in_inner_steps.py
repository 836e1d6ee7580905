"""Fast forces on rigid bodies, which turn in the inner steps: conservation, heat, who takes part.

A chain with two rigid domains has bonds as fast as those of atoms, also between linkers and domains.
"""

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import (
    SIER2,
    SIER4G,
    RigidBodies,
    SIERIntegrator,
    SIERLangevinIntegrator,
    prepare_system,
    with_frames,
)
from openmm_sier.engines.exact.fast_force_context import FastForceContext, working_forces
from openmm_sier.system.links import linked
from tests.support.domains import stiff_chain
from tests.support.hydrogen_groups import hydrogen_groups
from tests.support.peptides import capped_alanine_box, forcefield
from tests.support.seeded import seeded
from tests.support.silence import silence
from tests.support.waters import array, phase_point, plain_context, platform

#: The group of the fast forces of `prepare_system`.
FAST = 1


def made(integrator, system, point=None):
    """A Context on Reference. Steps of half a bond's period draw warnings, which are not what is tested."""
    with silence():
        context = openmm.Context(system, integrator, platform())
    if point is not None:
        context.setPositions(point[0])
        context.setVelocities(point[1])
    return context


@pytest.fixture(scope="module")
def chain():
    """System, prepared, bodies, and a phase point near 300 K."""
    system, bodies, positions = stiff_chain(cut_off=None)
    prepare_system(system, bodies)
    bath = seeded(SIERLangevinIntegrator(300, 20, 0.002, bodies=bodies), 3)
    context = made(bath, system)
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(300, 1)
    bath.step(300)
    return system, bodies, phase_point(context)


def end_of(chain, scheme, h, steps, **options):
    system, bodies, point = chain
    integrator = SIERIntegrator(h, scheme, bodies=bodies, **options)
    context = made(integrator, system, point)
    integrator.step(steps)
    return integrator, context


# --- the trajectory ---------------------------------------------------------------------------------------------------


def test_momentum_and_angular_momentum_are_conserved(chain):
    _, bodies, _ = chain
    integrator, context = end_of(chain, SIER4G, 0.004, 0)
    before = bodies.total_momenta(integrator.getBodyState())
    integrator.step(100)
    state = integrator.getBodyState()
    scale = np.abs(state.p).sum(), np.abs(state.q).max() * np.abs(state.p).sum()
    for results, expected, size in zip(bodies.total_momenta(state), before, scale, strict=True):
        # Rounding of some thousand kicks.
        assert np.abs(results - expected).max() < 1e-12 * size
    assert context.getStepCount() == 100


@pytest.mark.parametrize(("scheme", "substeps", "largest"), [(SIER2, 4, 3.0), (SIER4G, None, 0.5)], ids=["SIER2", "4G"])
def test_the_bath_counts_its_heat(chain, scheme, substeps, largest):
    """The energy at whole steps less the heat is conserved as well as at constant energy.

    SIER2 with everything in the kicks leaves 1.2 kJ/mol in steps of 0.3 fs, which are its inner steps here.
    """
    system, bodies, point = chain
    bath = seeded(SIERLangevinIntegrator(300, 5, 0.002, scheme, bodies=bodies, substeps=substeps), 2)
    context = made(bath, system, point)
    conserved, heat = [], []
    for _ in range(30):
        bath.step(2)
        state = bath.getBodyState()
        V = context.getState(energy=True).getPotentialEnergy()._value
        heat.append(bath.countedHeat)
        conserved.append(V + sum(bodies.kinetic_energies(state)) - heat[-1])
    # The bath gives and takes some kT of each of 60 degrees of freedom.
    assert np.ptp(heat) > 10
    assert np.ptp(conserved) < largest


# --- who takes part ---------------------------------------------------------------------------------------------------


def test_forces_and_torques_are_those_of_the_whole_system(chain):
    """Only atoms of the bodies on which terms act are placed."""
    system, bodies, point = chain
    known = linked(system, bodies)
    forces = [force for force in system.getForces() if force.getForceGroup() == FAST]
    working = working_forces(forces, known.owners, known.owners >= 0)
    members = np.unique(known.owners[working.particles])
    fast = FastForceContext(working, known.restricted(members), platform(), {})
    q, A = known.fit(point[0])
    context = plain_context(system, known.place(q, A, point[0].copy()))
    expected = known.forces_and_torques(array(context.getState(forces=True, groups={FAST}).getForces()), A)
    result = fast(np.ascontiguousarray(q[:, members]), np.ascontiguousarray(A[:, :, members]))
    for mine, theirs in zip(result, expected, strict=True):
        # Those within bodies, which cancel, are there in the whole System alone.
        assert np.abs(mine - theirs[:, members]).max() < 1e-10 * np.abs(theirs).max()
    assert np.abs(expected[1]).max() > 10
    # A torsion into a domain acts on three of its beads.
    assert len(working.particles) < 0.8 * known.n_particles


@pytest.fixture(scope="module")
def grouped():
    """A peptide whose heavy atoms and hydrogens are bodies, in ten rigid waters: prepared System, bodies, positions."""
    topology, positions = capped_alanine_box(10)
    system = forcefield().createSystem(topology, removeCMMotion=False)
    bodies = RigidBodies.from_system(system, topology, hydrogen_groups(topology), positions * unit.nanometer)
    prepare_system(system, bodies)
    return system, bodies, positions


def test_waters_are_not_slowed_down(grouped):
    system, bodies, positions = grouped
    integrator = SIERIntegrator(0.002, SIER4G, bodies=bodies)
    context = made(integrator, system)
    context.setPositions(positions)
    integrator.step(1)
    moved = integrator.impl.engine.motion.fast_context.bodies
    # ACE-ALA-NME has ten heavy atoms, of which six have hydrogens.
    assert (moved.n, int(moved.moments.any(axis=0).sum())) == (10, 6)


def test_hydrogen_groups_allow_the_step_of_constrained_bonds(grouped):
    """Bonds between groups, of 20 fs, would be wrong in the kicks at 4 fs."""
    system, bodies, positions = grouped
    integrator = SIERIntegrator(0.004, SIER4G, bodies=bodies)
    context = made(integrator, system)
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(300, 2)
    total = []
    for _ in range(40):
        integrator.step(1)
        state = context.getState(energy=True)
        total.append((state.getPotentialEnergy() + state.getKineticEnergy())._value)
    # From the minimum the potential energy rises by some 100 kJ/mol.
    assert np.ptp(total) < 0.5


@pytest.mark.thorough
def test_numbers_that_are_not_finite_are_reported(chain):
    system, bodies, point = chain
    integrator = SIERIntegrator(0.004, SIER4G, bodies=bodies)
    context = made(integrator, system, point)
    context.setVelocities(np.full_like(point[1], 1e200))
    with pytest.raises(openmm.OpenMMException, match=r"not finite in step 1\. Is the step size too long"):
        integrator.step(1)


def test_a_point_is_a_body_that_does_not_turn(chain):
    """Restricted bodies keep what belongs to them."""
    system, bodies, _ = chain
    known = linked(system, bodies)
    members = np.flatnonzero(known.moments.any(axis=0) | (np.arange(known.n) % 2 == 0))
    some = known.restricted(members)
    for name in ("masses", "molecules", "flexible"):
        np.testing.assert_array_equal(getattr(some, name), getattr(known, name)[members])
    np.testing.assert_array_equal(some.moments, known.moments[:, members])
    for mine, theirs in enumerate(members.tolist()):
        np.testing.assert_array_equal(some.atoms_of(mine), known.atoms_of(theirs))


# --- the native engine, by frames -------------------------------------------------------------------------------------


def test_frames_of_a_prepared_system_are_prepared_again():
    """Fast terms act on virtual sites of the frames, which the native engine refuses with the remedy that works."""
    system, bodies, positions = stiff_chain(cut_off=None)
    prepare_system(system, bodies)
    framed = with_frames(system, positions, bodies)
    integrator = SIERIntegrator(0.001, SIER4G, engine="native")
    with pytest.raises(openmm.OpenMMException, match=r"prepare_system\(system\)"):
        made(integrator, framed.system)
    prepared = prepare_system(framed.system)
    assert "stay slow forces, since they act on virtual sites or frozen atoms: HarmonicBondForce" in str(prepared)
    integrator = SIERIntegrator(0.0005, SIER4G, engine="native")
    context = made(integrator, framed.system)
    context.setPositions(framed.positions)
    integrator.step(20)
    exact = SIERIntegrator(0.0005, SIER4G, bodies=bodies)
    other = made(exact, system)
    other.setPositions(positions)
    exact.step(20)
    atom_positions = framed.getAtomPositions(context.getState(positions=True))
    # Two schemes of fourth order at a sixtieth of the period of a bond.
    assert np.abs(atom_positions - phase_point(other)[0]).max() < 1e-6
