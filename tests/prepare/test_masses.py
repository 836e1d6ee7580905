"""Heavy hydrogens, in water and in solutes: masses of molecules stay, and only hydrogens and their centres change."""

import copy
import itertools

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import RigidBodies, prepare_system
from openmm_sier.prepare.close_pairs import NAME
from openmm_sier.prepare.masses import set_hydrogen_masses
from openmm_sier.system.tables import HEAVIEST_IN_CHAINS, masses, read_once
from tests.support.peptides import capped_alanine_box
from tests.support.waters import cluster_system


@pytest.fixture(scope="module")
def alanine():
    topology, _ = capped_alanine_box(waters=2)
    return topology, app.ForceField("amber14-all.xml", "amber14/tip3p.xml")


def hydrogens_of(topology):
    return [atom.index for atom in topology.atoms() if atom.element is app.element.hydrogen]


def centres_of(topology):
    """The atom that each hydrogen is bonded to."""
    joined = {}
    for first, second in topology.bonds():
        for one, other in ((first, second), (second, first)):
            if one.element is app.element.hydrogen:
                joined.setdefault(other.index, []).append(one.index)
    return joined


@pytest.mark.parametrize("constraints", [None, app.HBonds, app.AllBonds, app.HAngles])
@pytest.mark.parametrize("before", [None, 1.5, 3.0, 4.0])
def test_hydrogens_of_water_and_solutes(alanine, constraints, before):
    """Arguments of createSystem do not matter."""
    topology, forcefield = alanine
    usual = forcefield.createSystem(topology, constraints=constraints)
    system = forcefield.createSystem(topology, constraints=constraints, hydrogenMass=before)
    message = str(prepare_system(system, hydrogenMass=4 * unit.dalton))
    old, new = masses(usual), masses(system)
    for centre, results in centres_of(topology).items():
        # Sums of a few doubles of 15 dalton.
        assert new[[centre, *results]].sum() == pytest.approx(old[[centre, *results]].sum(), rel=1e-14)
        share = 4.0 if len(results) == 2 and old[centre] > 15 else HEAVIEST_IN_CHAINS
        assert new[results] == pytest.approx(share, rel=1e-14)
    others = sorted(set(range(len(new))) - set(hydrogens_of(topology)) - set(centres_of(topology)))
    np.testing.assert_array_equal(new[others], old[others])
    assert "12 hydrogens have 3 dalton and 4 hydrogens have 4 dalton" in message


@pytest.mark.parametrize("constraints", [None, app.HBonds])
def test_custom_bonds_between_atoms_three_bonds_apart_are_no_bonds(alanine, constraints):
    """OpenMM's readers of GROMACS and CHARMM files have interactions of such pairs in a CustomBondForce."""
    topology, forcefield = alanine
    plain, with_pairs = (forcefield.createSystem(topology, constraints=constraints) for _ in range(2))
    force = openmm.CustomBondForce("0*r")
    torsions = next(each for each in plain.getForces() if isinstance(each, openmm.PeriodicTorsionForce))
    for first, *_, last in (torsions.getTorsionParameters(i)[:4] for i in range(torsions.getNumTorsions())):
        force.addBond(first, last)
    with_pairs.addForce(force)
    for system in (plain, with_pairs):
        prepare_system(system, hydrogenMass=4)
    np.testing.assert_array_equal(masses(with_pairs), masses(plain))
    close = [next(each for each in each_of.getForces() if each.getName() == NAME) for each_of in (plain, with_pairs)]
    assert close[0].getNumBonds() == close[1].getNumBonds()


@pytest.mark.parametrize("kind", ["harmonic", "custom"])
@pytest.mark.parametrize("constraints", [None, app.HBonds])
def test_restraints_of_hydrogens_are_no_bonds(alanine, kind, constraints):
    """To an atom of another molecule, as of a hydrogen bond, and to each other, as nuclear Overhauser effects ask."""
    topology, forcefield = alanine
    plain, restrained = (forcefield.createSystem(topology, constraints=constraints) for _ in range(2))
    hydrogens = hydrogens_of(topology)
    force = openmm.HarmonicBondForce() if kind == "harmonic" else openmm.CustomBondForce("1000*(r-0.2)^2")
    for first, second, length in (
        (hydrogens[0], plain.getNumParticles() - 3, 0.19),
        (hydrogens[1], hydrogens[-1], 0.3),
    ):
        force.addBond(first, second, *((length, 1e3) if kind == "harmonic" else ()))
    restrained.addForce(force)
    for system in (plain, restrained):
        prepare_system(system, hydrogenMass=3)
    np.testing.assert_array_equal(masses(restrained), masses(plain))


@pytest.mark.parametrize("kind", ["harmonic", "custom"])
def test_an_elastic_network_makes_no_close_pairs(alanine, kind):
    topology, forcefield = alanine
    plain, network = (forcefield.createSystem(topology, constraints=app.HBonds) for _ in range(2))
    force = openmm.HarmonicBondForce() if kind == "harmonic" else openmm.CustomBondForce("1000*(r-0.5)^2")
    heavy = [atom.index for atom in topology.atoms() if atom.element is app.element.carbon]
    for first, second in itertools.combinations(heavy, 2):
        force.addBond(first, second, *((0.5, 1e3) if kind == "harmonic" else ()))
    network.addForce(force)
    counts = []
    for system in (plain, network):
        prepare_system(system, hydrogenMass=4)
        counts.append(next(each for each in system.getForces() if each.getName() == NAME).getNumBonds())
    assert counts[0] == counts[1]
    np.testing.assert_array_equal(masses(network), masses(plain))


def test_beads_of_a_coarse_chain_are_no_hydrogens():
    system, bonds = openmm.System(), openmm.HarmonicBondForce()
    for i in range(4):
        system.addParticle(1.0)
        if i:
            bonds.addBond(i - 1, i, 0.35, 1e4)
    system.addForce(bonds)
    with pytest.warns(UserWarning, match="hydrogenMass has no effect"):
        prepare_system(system, hydrogenMass=4)
    assert masses(system).tolist() == [1.0] * 4


def test_masses_that_change_nothing_are_reported():
    system = openmm.System()
    system.addParticle(40.0)
    with pytest.warns(UserWarning, match="hydrogenMass has no effect: .*no hydrogens"):
        prepare_system(system, hydrogenMass=4)


def test_a_prepared_system_may_get_its_heavy_hydrogens_later(alanine):
    topology, forcefield = alanine
    once, twice = (forcefield.createSystem(topology, constraints=app.HBonds) for _ in range(2))
    prepare_system(twice)
    for system in (once, twice):
        prepare_system(system, hydrogenMass=4)
    np.testing.assert_array_equal(masses(twice), masses(once))


@pytest.mark.parametrize("model", ["tip3p", "tip4pew", "tip5p"])
def test_water_with_and_without_virtual_sites(model):
    _, _, system = cluster_system(3, model)
    prepare_system(system, hydrogenMass=4)
    result = masses(system)
    assert sorted(result[result > 0].round(9)) == sorted([4.0] * 6 + [result[0].round(9)] * 3)
    assert result[result > 0].sum() == pytest.approx(3 * 18.01528, rel=1e-5)  # waters of 15.99943 + 2 * 1.007947
    back = copy.deepcopy(system)
    prepare_system(back, hydrogenMass=1.007947)
    assert masses(back).max() == pytest.approx(15.99943, rel=1e-5)


def test_frozen_atoms_stay_frozen_and_systems_without_hydrogens_as_they_are():
    system = openmm.System()
    bonds = openmm.HarmonicBondForce()
    for mass in (12.0, 0.0, 12.0, 1.0, 0.0, 1.0, 1.0, 1.0, 40.0):
        system.addParticle(mass)
    # Two carbons with a frozen hydrogen each, one with another; a frozen atom with hydrogen; H2; argon.
    for first, second in ((0, 1), (0, 2), (2, 3), (4, 5), (6, 7)):
        bonds.addBond(first, second, 0.1, 1e5)
    system.addForce(bonds)
    prepare_system(system, hydrogenMass=3)
    assert masses(system).tolist() == [12, 0, 10, 3, 0, 1, 1, 1, 40]


@pytest.mark.parametrize("mass", [0, -1, 0.5, 5, float("nan"), "4", True, 4 * unit.kelvin])
def test_masses_that_are_refused(alanine, mass):
    topology, forcefield = alanine
    system = forcefield.createSystem(topology, constraints=app.HBonds)
    before = openmm.XmlSerializer.serialize(system)
    with pytest.raises((ValueError, TypeError), match="hydrogenMass must be"):
        prepare_system(system, hydrogenMass=mass)
    assert openmm.XmlSerializer.serialize(system) == before
    with pytest.raises(ValueError, match="before RigidBodies"):
        prepare_system(system, RigidBodies.from_system(system), hydrogenMass=4)
    assert openmm.XmlSerializer.serialize(system) == before


def test_masses_that_were_read_are_read_again():
    _, _, system = cluster_system(2)
    with read_once():
        before = masses(system)
        set_hydrogen_masses(system, 4.0)
        assert not np.array_equal(masses(system), before)
