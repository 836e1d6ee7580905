"""Phi and psi of alanine dipeptide by hybrid Monte Carlo and by OpenMM's LangevinMiddle at steps of 0.5 fs.

With kicks that are too weak: without the rule they sample the ensemble of a higher temperature.

The molecule has no water, and a torsion that holds each angle in one basin, so that seconds suffice. The figures of the
solvated molecule are in docs/measurements/heat-bath.md.
"""

import math

import numpy as np
import openmm
import pytest
from openmm import app, unit

from openmm_sier import Scheme, SIERHMCIntegrator, prepare_system
from openmm_sier.analysis.statistics import mean_and_error
from openmm_sier.dynamics.stages import DRIFT, KICK, Stage
from openmm_sier.ensembles import metropolis
from studies.observers import backbone, dihedral
from systems import peptide
from tests.support.seeded import seeded
from tests.support.waters import context_at

TEMPERATURE, FRICTION = 300.0, 5.0

#: Where the angles are held, rad, and how firmly, kJ/mol.
CENTRES, FIRMNESS = (-1.4, 1.2), 50.0

#: ps between samples, and their number.
EVERY, SAMPLES = 0.1, 1000


@pytest.fixture(scope="module")
def dipeptide():
    made = peptide.dry(("ALA",), *peptide.TORSIONS)
    forcefield = app.ForceField(*peptide.FORCE_FIELD)
    system = forcefield.createSystem(made.topology, constraints=app.HBonds, hydrogenMass=3, removeCMMotion=False)
    angles = backbone(made.topology)
    for atoms, centre in zip(angles, CENTRES, strict=True):
        restraint = openmm.CustomTorsionForce(f"{FIRMNESS}*(1 - cos(theta - ({centre})))")
        restraint.addTorsion(*atoms, [])
        system.addForce(restraint)
    return system, np.array(made.positions.value_in_unit(unit.nanometer)), angles


def test_the_energy_with_the_last_force_has_that_of_the_fast_forces(dipeptide, monkeypatch):
    system = openmm.XmlSerializer.clone(dipeptide[0])
    prepare_system(system)
    integrator = seeded(SIERHMCIntegrator(TEMPERATURE, 0.002, stepsPerTrial=3, engine="exact"), 1)
    context = context_at(system, integrator, (dipeptide[1], 0 * dipeptide[1]))
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    monkeypatch.setattr(metropolis, "largest_error", lambda *_: math.inf)
    integrator.step(5)
    assert integrator.fastForceGroups
    kept = integrator.impl.engine.potential_energy()
    # Sums of a few hundred terms in another order.
    assert kept == pytest.approx(context.getState(energy=True).getPotentialEnergy()._value, rel=1e-12)


def sampled(dipeptide, integrator, every):
    """Means and errors (4, 2) of the cosines and sines of both angles about their centres."""
    system, positions, angles = dipeptide
    context = context_at(system, seeded(integrator, 1), (positions, 0 * positions))
    openmm.LocalEnergyMinimizer.minimize(context, 10, 100)
    context.setVelocitiesToTemperature(TEMPERATURE, 1)
    integrator.step(20 * every)
    results = []
    for _ in range(SAMPLES):
        integrator.step(every)
        x = context.getState(positions=True).getPositions(asNumpy=True)._value
        results.append([dihedral(x, atoms) - centre for atoms, centre in zip(angles, CENTRES, strict=True)])
    return np.array([mean_and_error(f(angle))[:2] for angle in np.array(results).T for f in (np.cos, np.sin)])


def distances(one, other):
    """Differences of the means in joint standard errors, (4,)."""
    return (one[:, 0] - other[:, 0]) / np.hypot(one[:, 1], other[:, 1])


@pytest.fixture(scope="module")
def expected(dipeptide):
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, 0.0005)
    return sampled(dipeptide, integrator, round(EVERY / 0.0005))


@pytest.fixture
def unchecked(monkeypatch):
    """Schemes without the check that their kicks sum to 1."""

    def keep(scheme):
        object.__setattr__(scheme, "stages", tuple(Stage(*stage) for stage in scheme.stages))

    monkeypatch.setattr(Scheme, "__post_init__", keep)


@pytest.mark.thorough
@pytest.mark.usefixtures("unchecked")
def test_the_rule_mends_a_wrong_scheme(dipeptide, expected):
    """Trajectories with weak kicks are reversible and keep the volume of phase space; the rule needs no more.

    Without the rule the temperature is 1/0.6 as high, and the distances of the cosines are -6.7 and -4.7, together -8.
    """
    kick = Stage(KICK, 0.3)
    scheme = Scheme("weak kicks", (kick, Stage(DRIFT, 1.0), kick))
    integrator = SIERHMCIntegrator(TEMPERATURE, 0.002, scheme, 20, FRICTION, engine="native")
    result = distances(sampled(dipeptide, integrator, 3), expected)
    # Standard errors: five right ones exceed the limit with a probability of 4e-10.
    assert (np.abs(result) < 6.5).all()
    assert abs(result[0] + result[2]) / np.sqrt(2) < 6.5
    # The rule has something to do. Of 3000 trials some third is accepted.
    assert 0.05 < integrator.acceptanceRate < 0.9
