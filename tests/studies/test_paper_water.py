"""The paper's liquid: the molecular cut-off against OpenMM's own forces, and the Systems."""

import itertools

import numpy as np
import openmm
import pytest
from openmm import unit

from openmm_sier import SIERIntegrator
from studies.paper import liquids, molecular_cutoff, tip4p
from studies.paper.liquids import MOLECULAR, PME, Cutoffs
from studies.paper.molecular_cutoff import MolecularCutoff
from tests.support.oracles import random_attitudes
from tests.support.systems import assembled
from tests.support.waters import plain_context

ON, OFF, EDGE = 0.3, 0.5, 1.5
POTENTIAL = MolecularCutoff(tip4p.SIGMA, tip4p.EPSILON, tip4p.CHARGE, ON, OFF)
SMALL = Cutoffs(molecular_on=0.4, molecular_off=0.6, pme=0.6, pme_switch=0.5, ewald_tolerance=1e-5)


#: Of O, H, H and M, the last 0.015 nm from O.
GEOMETRY = np.vstack([tip4p.GEOMETRY, [0.0, 0.015, 0.0]])


def molecules(rng, n=27, edge=EDGE):
    """Positions (4 n, 3) of molecules with random orientations, jittered about a lattice."""
    side = round(n ** (1 / 3))
    places = np.array(list(itertools.product(range(side), repeat=3))) * edge / side + 0.04 * rng.normal(size=(n, 3))
    A = random_attitudes(rng, n)
    r = places[:, None] + np.einsum("ka,abn->nkb", GEOMETRY, A)
    return r.reshape(-1, 3)


def compound_bonds(n):
    """The same potential as a CustomCompoundBondForce: one bond for each pair of molecules, in OpenMM's own algebra."""
    pairs = " + ".join(
        f"{molecular_cutoff.COULOMB * qa * qb!r}/distance(p{a}, p{b + 4})"
        for a, qa in ((2, 0.52), (3, 0.52), (4, -1.04))
        for b, qb in ((2, 0.52), (3, 0.52), (4, -1.04))
    )
    force = openmm.CustomCompoundBondForce(
        8,
        f"S*({4 * tip4p.EPSILON!r}*((sigma/R)^12 - (sigma/R)^6) + {pairs});"
        "S = 1 - x^5*(126 - 420*x + 540*x^2 - 315*x^3 + 70*x^4);"
        f"x = min(1, max(0, (R - {ON})/{OFF - ON})); R = distance(p1, p5); sigma = {tip4p.SIGMA!r}",
    )
    force.setUsesPeriodicBoundaryConditions(True)
    for i, j in itertools.combinations(range(n), 2):
        force.addBond([*range(4 * i, 4 * i + 4), *range(4 * j, 4 * j + 4)])
    return force


def reference_energy_and_forces(positions):
    n = len(positions) // 4
    system = assembled(4 * n * [1.0], compound_bonds(n))
    system.setDefaultPeriodicBoxVectors(*(EDGE * np.eye(3)))
    state = plain_context(system, positions).getState(energy=True, forces=True)
    return (
        state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole),
        state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer),
    )


def test_molecular_cutoff_against_openmm(rng):
    """27 molecules in a box in which no pair of sites within the cut-off is nearer by another image."""
    positions = molecules(rng)
    energy, forces = POTENTIAL.energy_and_forces(positions, np.full(3, EDGE))
    expected_energy, expected_forces = reference_energy_and_forces(positions)
    # Rounding of sums of some 500 terms.
    assert energy == pytest.approx(expected_energy, rel=1e-11)
    assert np.abs(forces - expected_forces).max() < 1e-11 * np.abs(expected_forces).max()
    # The oracle does see pairs in the switching range.
    d = positions[::4, None] - positions[None, ::4]
    R = np.linalg.norm(d - EDGE * np.rint(d / EDGE), axis=2)
    assert ((R > ON) & (R < OFF)).sum() > 50


@pytest.mark.parametrize("kind", [MOLECULAR, PME])
def test_systems_are_water(rng, kind):
    """Bodies of TIP4P, M at 0.015 nm, the dipole of the published model, and no net force."""
    n, box = 64, liquids.water_box(64)
    context = liquids.context(liquids.build(kind, box, SMALL), SIERIntegrator(0.001), kind)
    context.setPositions(molecules(rng, n, box.edge))
    context.computeVirtualSites()
    state = context.getState(positions=True, forces=True)
    r = state.getPositions(asNumpy=True).value_in_unit(unit.nanometer).reshape(n, 4, 3)
    assert np.linalg.norm(r[:, 3] - r[:, 0], axis=1) == pytest.approx(np.full(n, 0.015), rel=1e-6)
    dipole = 0.52 * (r[:, 1] + r[:, 2] - 2 * r[:, 3])
    # 2.177 D; 1 e nm is 48.032 D.
    assert np.linalg.norm(dipole, axis=1) * 48.032 == pytest.approx(np.full(n, 2.177), abs=1e-3)
    F = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    massive = np.arange(4 * n) % 4 != 3
    # PME interpolates charges on a mesh, and does not conserve momentum better than its tolerance.
    assert np.abs(F[massive].sum(axis=0)).max() < (1e-9 if kind == MOLECULAR else 1e-2) * np.abs(F).max()
    assert context.getIntegrator().bodies.dof == 6 * n
    assert context.getIntegrator().bodies.species[0].moments == pytest.approx(
        tip4p.molecules(1).species[0].moments, rel=1e-9
    )
