"""Carbon dioxide in a fixed zeolite: TraPPE in all-silica LTA (ITQ-29).

The framework: A. Corma, F. Rey, J. Rius, M. J. Sabater and S. Valencia, Nature 431, 287 (2004); its interactions:
TraPPE-zeo, P. Bai, M. Tsapatsis and J. I. Siepmann, J. Phys. Chem. C 117, 24375 (2013). Carbon dioxide: J. J. Potoff
and J. I. Siepmann, AIChE J. 47, 1676 (2001). Atoms of the framework have no mass, so that they stay where they are.
"""

from __future__ import annotations

import itertools

import numpy as np
import openmm

from openmm_sier import balance_pme
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.inputs.equilibration import make_context
from studies.domains.fullerenes import rotation
from studies.domains.models import INTERACTIONS, Model, exclude, pairs_within
from studies.units import md

#: nm; and fractions of the edge of the cubic cell (Pm-3m) for silicon and three kinds of oxygen.
EDGE = 1.1867
SILICON = (0.0, 0.1847, 0.3683)
OXYGENS = ((0.0, 0.2202, 0.5), (0.0, 0.2939, 0.2939), (0.1098, 0.1098, 0.3453))

#: Charge, sigma in nm, epsilon/k in K.
FRAMEWORK = {"Si": (1.50, 0.230, 22.0), "O": (-0.75, 0.330, 53.0)}
GAS = {"C": (0.70, 0.280, 27.0), "O": (-0.35, 0.305, 79.0)}
MASSES = {"C": 12.011, "O": 15.999}

#: nm, from carbon to oxygen.
BOND = 0.116

#: nm.
CUTOFF = 1.1


def orbit(place: tuple[float, float, float]) -> np.ndarray:
    """All places of the cell that the symmetry Pm-3m makes of one, (n, 3) in fractions of its edge."""
    positions = set()
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            image = np.array(signs) * np.array(place)[list(order)]
            positions.add(tuple(np.round(image % 1.0, 6) % 1.0))
    return np.array(sorted(positions))


def model(cells: int = 2, per_cage: int = 5) -> Model:
    """A framework of `cells`^3 cells, each with a large cage that holds so many molecules, at 300 K.

    It has no springs: those of a line do not resist its bending.
    """
    system, force = openmm.System(), openmm.NonbondedForce()
    force.setNonbondedMethod(force.PME)
    force.setCutoffDistance(min(CUTOFF, 0.49 * cells * EDGE))
    force.setUseDispersionCorrection(False)
    force.setName("contacts")
    force.setForceGroup(INTERACTIONS)
    places: list[np.ndarray] = []
    bodies: list[list[int]] = []
    system.addForce(force)
    system.setDefaultPeriodicBoxVectors(*(cells * EDGE * np.eye(3)))
    corners = np.array(list(itertools.product(range(cells), repeat=3)))
    for kind, unique in (("Si", SILICON), *(("O", each) for each in OXYGENS)):
        for corner, place in itertools.product(corners, orbit(unique)):
            system.addParticle(0)
            force.addParticle(*lennard_jones(FRAMEWORK[kind]))
            places.append(EDGE * (corner + place))
    empty = energy(system, np.array(places))
    random = np.random.default_rng(1)
    for corner in corners:
        for k in range(per_cage):
            # The cage is about the middle of the cell; molecules stand around it, and a minimization does the rest.
            angle = 2 * np.pi * k / per_cage
            centre = EDGE * (corner + 0.5) + 0.27 * np.array([np.cos(angle), np.sin(angle), 0])
            line = np.array([[0, 0, 0], [BOND, 0, 0], [-BOND, 0, 0]]) @ rotation(random)
            bodies.append([])
            for kind, site in zip("COO", line, strict=True):
                bodies[-1].append(system.addParticle(MASSES[kind]))
                force.addParticle(*lennard_jones(GAS[kind]))
                places.append(centre + site)
    exclude(force, pairs_within(bodies))
    balance_pme(system)
    return Model("CO2 in LTA", system, None, np.array(places), bodies, usual=2.0, offset=empty)


def energy(system: openmm.System, positions: np.ndarray) -> float:
    """The potential energy, kJ/mol."""
    context = make_context(system, openmm.VerletIntegrator(0.001), "Reference")
    context.setPositions(positions)
    return float(md(context.getState(energy=True).getPotentialEnergy()))


def lennard_jones(parameters: tuple[float, float, float]) -> tuple[float, float, float]:
    """Charge, sigma in nm and epsilon in kJ/mol."""
    charge, sigma, epsilon = parameters
    return charge, sigma, epsilon * GAS_CONSTANT
