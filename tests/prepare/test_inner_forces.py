"""Forces within Forces, and Forces with charges and a mesh of their own: prepared and judged like a NonbondedForce."""

import copy

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import RigidBodies, SIERIntegrator, balance_pme, prepare_system
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system.inner_forces import all_forces, pme_parameters
from tests.support.containers import CONTAINERS, at_rest, contained, scaled
from tests.support.peptides import capped_alanine
from tests.support.silence import silence
from tests.support.systems import assembled
from tests.support.waters import array, cluster_system, context_at, periodic_system, plain_context, platform


@pytest.fixture(scope="module")
def water():
    """Positions and System with PME as OpenMM splits it, and without a jump of Lennard-Jones energies."""
    _, positions, system = periodic_system("tip3p", 64, switchDistance=0.46 * unit.nanometer)
    return positions, system


def energy_and_forces(system, positions):
    state = plain_context(system, positions).getState(energy=True, forces=True)
    return state.getPotentialEnergy()._value, array(state.getForces())


def longest(system):
    return StepCheck(system, RigidBodies.from_system(system)).longest_step(SIER4G, 1, 0)


# --- PME ---


@pytest.mark.parametrize("name", CONTAINERS)
def test_pme_is_balanced_wherever_it_is(water, name):
    """A prepared System has the energy and the forces of one that holds the NonbondedForce itself."""
    positions, system = water
    one, other = copy.deepcopy(system), contained(system, name)
    prepare_system(one)
    assert "PME are balanced" in str(prepare_system(other))
    (energy, forces), (other_energy, other_forces) = (
        energy_and_forces(one, positions),
        energy_and_forces(other, positions),
    )
    # Sums of 1e5 terms of some 100 kJ/mol in double precision. OpenMM's own split differs by 1e-1 and more.
    assert other_energy == pytest.approx(energy, abs=1e-7)
    assert np.abs(other_forces - forces).max() < 1e-7
    assert np.abs(energy_and_forces(contained(system, name), positions)[1] - forces).max() > 0.1


@pytest.mark.parametrize("name", CONTAINERS)
def test_pme_that_is_not_balanced_draws_a_warning_in_any_force(water, name):
    system = contained(water[1], name)
    with pytest.warns(UserWarning, match=r"prepare_system\(system\)"):
        openmm.Context(system, SIERIntegrator(0.004), platform())
    prepare_system(system)
    with silence():
        openmm.Context(system, SIERIntegrator(0.004), platform())


def charges(kind):
    """A Force of a kind for two unit charges of opposite sign, with PME, a cut-off of 0.9 nm and nothing else."""
    force = kind()
    force.setCutoffDistance(0.9)
    force.setEwaldErrorTolerance(5e-4)
    if kind is not openmm.ConstantPotentialForce:
        force.setNonbondedMethod(kind.PME)
    for charge in (-1, 1):
        if kind is openmm.ConstantPotentialForce:
            force.addParticle(charge)
        elif kind is openmm.AmoebaMultipoleForce:
            force.addMultipole(charge, [0] * 3, [0] * 9, kind.NoAxisType, -1, -1, -1, 0.39, 0.3, 0)
        else:
            # A core alone, without electrons around it that penetrate; OpenMM divides by the polarizability.
            rest = (charge, 40, 0, 40, 0, 0, 0, 40, 1e-9, kind.NoAxisType, -1, -1, -1)
            force.addParticle(charge, [0] * 3, [0] * 9, *rest)
    return force


@pytest.mark.parametrize(
    "kind", [openmm.ConstantPotentialForce, openmm.AmoebaMultipoleForce, openmm.HippoNonbondedForce]
)
def test_the_step_at_the_cutoff_is_smaller(kind):
    step = np.zeros(2)
    for balanced in (0, 1):
        for side in (-1, 1):
            system = assembled([1, 1], charges(kind))
            system.setDefaultPeriodicBoxVectors(*(2.4 * np.eye(3)))
            if balanced:
                balance_pme(system)
            positions = np.array([[0.1, 0.2, 0.3], [0.1, 0.2, 1.2 + side * 1e-10]])
            step[balanced] += side * energy_and_forces(system, positions)[0]
    # As for a NonbondedForce: a share of 200 by the definition, and 22 to 33 % by erfc.
    assert 235 < step[0] / step[1] < 275


# --- librations ---


def judged(system, integrator):
    """A Context, whose step is judged as before the first step."""
    context = openmm.Context(system, integrator, platform())
    integrator.impl.refuse_long_step()
    return context


@pytest.mark.parametrize("name", ["ATMForce", "ConstantPotentialForce"])
def test_librations_are_seen_wherever_the_charges_are(water, name):
    assert longest(contained(water[1], name)) == longest(water[1])
    with pytest.warns(UserWarning, match=r"20 fs is long: .*31\.5 fs"):
        judged(contained(water[1], name), SIERIntegrator(0.02, "SIER2"))


def test_librations_by_multipoles():
    """Two rigid molecules with charges of water, which take the step that a NonbondedForce of these allows."""
    _, _, plain = cluster_system(2)
    for kind in (openmm.AmoebaMultipoleForce, openmm.HippoNonbondedForce):
        force = kind()
        for charge in 2 * (-0.52, 0.26, 0.26):
            if kind is openmm.AmoebaMultipoleForce:
                force.addMultipole(charge, [0] * 3, [0] * 9, kind.NoAxisType, -1, -1, -1, 0.39, 0.3, 0)
            else:
                rest = (charge, 40, 0, 40, 0, 0, 0, 40, 0, kind.NoAxisType, -1, -1, -1)
                force.addParticle(charge, [0] * 3, [0] * 9, *rest)
        system = copy.deepcopy(plain)
        system.removeForce([type(one) for one in system.getForces()].index(openmm.NonbondedForce))
        system.addForce(force)
        assert longest(system) == longest(plain)


@pytest.mark.parametrize("name", ["CustomCVForce", "CustomCVForce in ATMForce"])
def test_steps_are_not_judged_by_collective_variables_of_all_pairs(water, name):
    system = contained(water[1], name)
    # Spins of water are left, which are slower than its librations.
    assert longest(system) > 2 * longest(water[1])
    with pytest.warns(UserWarning, match="cannot be judged.*CustomCVForce"):
        judged(system, SIERIntegrator(0.004))


# --- bonds ---


def pair(force):
    """Two atoms of 1 dalton under one Force."""
    return assembled([1.0, 1.0], force)


@pytest.mark.parametrize("kind", [openmm.HarmonicBondForce, openmm.CustomBondForce])
def test_bonds_are_seen_within_a_sum_of_forces(kind):
    bond = kind() if kind is openmm.HarmonicBondForce else kind("2e5*(r-0.1)^2")
    bond.addBond(0, 1, *((0.1, 4e5) if kind is openmm.HarmonicBondForce else ([],)))
    bare = pair(copy.deepcopy(bond))
    system = assembled([1.0, 1.0])
    system.addForce(at_rest(system, bond))
    message = str(prepare_system(system))
    assert f"stay slow forces, since another Force contains them: {kind.__name__} in ATMForce." in message
    positions = np.array([[0, 0, 0], [0.1, 0, 0]])
    # The period is 2 pi sqrt(0.5/4e5) ps = 7.02 fs, and SIER4G is unstable from a tenth above half of it on.
    for one in (bare, system):
        with pytest.raises(openmm.OpenMMException, match=r"bond .*7\.02 fs"):
            context_at(one, SIERIntegrator(0.006, SIER4G), (positions, 0 * positions), steps=1)


def test_close_pairs_are_found_within_a_sum_of_forces():
    system, positions = capped_alanine(waters=4)
    prepared, balanced = contained(system, "ATMForce"), contained(system, "ATMForce")
    assert "between 81 close pairs" in str(prepare_system(prepared))
    (energy, forces), (same_energy, same_forces) = (
        energy_and_forces(balanced, positions),
        energy_and_forces(prepared, positions),
    )
    # Of some 1000 kJ/mol and kJ/mol/nm in sums of 100 terms, to rounding.
    assert same_energy == pytest.approx(energy, abs=1e-8)
    assert np.abs(same_forces - forces).max() < 1e-8


# --- what else is read of Forces within Forces ---


def test_a_discontinuity_draws_a_warning_in_any_force():
    _, _, system = periodic_system("tip3p", 64)
    message = str(prepare_system(contained(system, "ATMForce")))
    assert "NonbondedForce in ATMForce ends with a jump of the energy at 0.55 nm" in message


def test_drude_particles_are_refused_wherever_they_are():
    system = assembled([1.0, 0.4])
    force = openmm.DrudeForce()
    force.addParticle(1, 0, -1, -1, -1, -1.0, 1e-3, 1, 1)
    system.addForce(at_rest(system, force))
    with pytest.raises(openmm.OpenMMException, match="DrudeForce in ATMForce"):
        openmm.Context(system, SIERIntegrator(0.001, "SIER2"), platform())


def test_inner_forces_are_of_their_own_class_and_can_be_changed():
    system = assembled([1.0])
    system.addForce(at_rest(system, openmm.NonbondedForce(), scaled(openmm.NonbondedForce())))
    for entry in all_forces(system):
        if isinstance(entry.force, openmm.NonbondedForce):
            entry.force.setPMEParameters(4, 24, 24, 24)
    again = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(system))
    names = [entry.name for entry in all_forces(again)]
    assert names == [
        "ATMForce",
        "NonbondedForce in ATMForce",
        "CustomCVForce in ATMForce",
        "NonbondedForce in CustomCVForce in ATMForce",
    ]
    results = [
        pme_parameters(entry.force) for entry in all_forces(again) if isinstance(entry.force, openmm.NonbondedForce)
    ]
    assert results == 2 * [(4.0, 24, 24, 24)]
