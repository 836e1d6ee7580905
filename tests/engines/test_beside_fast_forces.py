"""Molecules beside those that fast forces move: points under constraints, and atoms with virtual sites.

The oracle is a constrained velocity Verlet in short steps, with one force in each of OpenMM's steps, so that virtual
sites are where they belong on every platform.
"""

import re
from itertools import pairwise

import numpy as np
import openmm
import pytest

from openmm_sier import SIER2, SIER4G, SIERIntegrator, SIERLangevinIntegrator, prepare_system
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.engines.native import program as native_program
from tests.support.waters import context_at, phase_point

#: ps.
TIME = 0.016

WATER = np.array([[0.0, 0.0, 0.0], [0.09572, 0.0, 0.0], [-0.0239987, 0.0926627, 0.0]])
SITE = np.array([0.78664558, 0.10667721, 0.10667721])


class Mixture:
    """A flexible chain of four beads beside other molecules, in vacuum."""

    def __init__(self):
        self.system = openmm.System()
        self.x = []
        self._nonbonded = openmm.NonbondedForce()
        self._bonds = openmm.HarmonicBondForce()
        self._angles = openmm.HarmonicAngleForce()
        chain = self._molecule(
            [(12.0, 0.2 * (-1) ** k, [0.13 * k, 0.07 * (k % 2), 0.03 * k * (k == 3)]) for k in range(4)]
        )
        for first, second in pairwise(chain):
            self._bonds.addBond(first, second, 0.15, 2.5e5)
        for k in range(2):
            self._angles.addAngle(*chain[k : k + 3], 1.95, 500)

    def _molecule(self, atoms):
        """Add atoms (mass, charge, position) that do not interact with each other otherwise."""
        first = self.system.getNumParticles()
        for mass, charge, x in atoms:
            self.system.addParticle(mass)
            self._nonbonded.addParticle(charge, 0.3, 0.3 if mass > 2 else 0.0)
            self.x.append(x)
        members = range(first, self.system.getNumParticles())
        for i in members:
            for j in range(first, i):
                self._nonbonded.addException(i, j, 0, 1, 0)
        return list(members)

    def _constrain(self, first, second):
        self.system.addConstraint(first, second, float(np.linalg.norm(np.subtract(self.x[first], self.x[second]))))

    def water(self, shift):
        atoms = WATER + shift
        site = SITE @ atoms
        charges = (0.0, 0.52, 0.52, -1.04)
        members = self._molecule(zip((16.0, 1.008, 1.008, 0.0), charges, [*atoms, site], strict=True))
        for i, j in ((0, 1), (0, 2), (1, 2)):
            self._constrain(members[i], members[j])
        self.system.setVirtualSite(members[3], openmm.ThreeParticleAverageSite(*members[:3], *SITE))
        return members

    def bonds_to_sites(self):
        """Two waters, each with the bond from oxygen to the site that AMBER files have."""
        for shift in ([0.2, 0.45, 0.0], [0.5, 0.45, 0.1]):
            oxygen, _, _, site = self.water(shift)
            self._bonds.addBond(oxygen, site, 0.0125, 4.6e5)

    def rigid_waters(self):
        for shift in ([0.2, 0.45, 0.0], [0.5, 0.45, 0.1]):
            self.water(shift)

    def tethered_water(self):
        oxygen, *_ = self.water([0.2, 0.45, 0.0])
        (anchor,) = self._molecule([(0.0, 0.0, [0.2, 0.55, 0.1])])
        self._bonds.addBond(anchor, oxygen, 0.1, 500.0)

    def beads(self):
        """Four beads with constrained bonds and no angles."""
        row = self._molecule([(12.0, 0.3 * (-1) ** k, [0.14 * k, 0.45 + 0.06 * (k % 2), 0.02 * k]) for k in range(4)])
        for first, second in pairwise(row):
            self._constrain(first, second)

    def prepared(self):
        for force in (self._nonbonded, self._bonds, self._angles):
            self.system.addForce(force)
        prepare_system(self.system)
        return self.system


@pytest.fixture(scope="module", params=["bonds_to_sites", "rigid_waters", "tethered_water", "beads"])
def mixture(request):
    """A prepared System, and a phase point that satisfies its constraints, to rounding."""
    made = Mixture()
    getattr(made, request.param)()
    system = made.prepared()
    integrator = SIERIntegrator(0.001, engine="exact", fastForceGroups=set())
    context = context_at(system, integrator, (np.array(made.x), np.zeros((len(made.x), 3))))
    context.computeVirtualSites()
    context.setVelocitiesToTemperature(300, 7)
    context.applyConstraints(1e-12)
    context.computeVirtualSites()
    context.applyVelocityConstraints(1e-12)
    return system, phase_point(context)


def verlet(h):
    """Velocity Verlet under constraints with one force in each step, whose second half of a kick is in the next one."""
    integrator = openmm.CustomIntegrator(h)
    integrator.addGlobalVariable("share", 0.5)
    integrator.addPerDofVariable("free", 0)
    integrator.addComputePerDof("v", "v + share*dt*f/m")
    integrator.addComputePerDof("x", "x + dt*v")
    integrator.addComputePerDof("free", "x")
    integrator.addConstrainPositions()
    integrator.addComputePerDof("v", "v + (x - free)/dt")
    integrator.addComputeGlobal("share", "1")
    return integrator


def end_of(system, start, integrator, steps):
    integrator.setConstraintTolerance(1e-12)
    return phase_point(context_at(system, integrator, start, steps=steps))[0]


@pytest.fixture(scope="module")
def exact(mixture):
    system, start = mixture
    ends = [end_of(system, start, verlet(TIME / n), n) for n in (400, 800)]
    # Velocity Verlet is of second order.
    return ends[1] + (ends[1] - ends[0]) / 3


@pytest.mark.parametrize("engine", ["exact", "native"])
@pytest.mark.parametrize(("scheme", "order", "steps"), [(SIER2, 2, 16), (SIER4G, 4, 8)], ids=["SIER2", "SIER4G"])
def test_schemes_have_their_order(mixture, exact, engine, scheme, order, steps):
    system, start = mixture
    errors = [
        np.abs(end_of(system, start, SIERIntegrator(TIME / n, scheme, engine=engine, substeps=1), n) - exact).max()
        for n in (steps, 2 * steps)
    ]
    # The next term of the error is smaller by (pi h/T)^2, 0.02 with the fastest bond of 33 fs. Errors of 1e-9 nm are a
    # hundred times those of OpenMM's constraints.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


def programs():
    """All that the native engine executes with fast forces, for Systems that may have virtual sites."""
    for scheme in CATALOGUE.values():
        for slow_group in (None, 0):
            yield native_program.write(scheme, fast_groups={1, 3}, slow_group=slow_group)
    for scheme in (SIER2, SIER4G):
        method = SIERLangevinIntegrator(300, 1, 0.002, scheme=scheme).impl.method()
        for counts_heat in (True, False):
            yield native_program.write(
                method.scheme, fast_groups={1}, bath=method.bath, slow_group=0, counts_heat=counts_heat
            )


def test_no_native_step_uses_slow_forces_after_it_moved_atoms():
    """Virtual sites are placed at its end. Which forces a statement uses is read from its expression here."""
    count = 0
    for program in programs():
        for part in program.parts:
            has_moved = False
            for statement in (statement for line in part for statement, _ in line.executed()):
                forces = set(re.findall(r"\bf\d*(?=/m)", statement.expression))
                assert forces == ({statement.force.name} if statement.force is not None else set())
                uses_slow = bool(forces & {"f", "f0"})
                assert not (uses_slow and has_moved)
                has_moved = has_moved or statement.moves
                count += uses_slow
    assert count > 50
