"""The step that bodies without bonds can take, by their stiffest contact and their spin."""

import math

import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier import SIER2, SIER4G, BodyType, RigidBodies, add_bodies, prepare_system

#: A sphere whose moments are so large, or so small, that contacts or spins are faster.
SITES = [[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]]
SLOW, FAST = (BodyType("sphere", SITES, [50, 0, 0], 3 * [moment]) for moment in (20.0, 1e-3))


def pair(kind, apart, energy="0.5*1000*(r - 1)^2*step(1.2 - r)"):
    """Two bodies on the x axis whose centres are bound by a spring of 1000 kJ/mol/nm^2."""
    system, topology = openmm.System(), app.Topology()
    lists, positions = add_bodies(system, topology, kind, [[0, 0, 0], [apart, 0, 0]])
    force = openmm.CustomNonbondedForce(energy)
    force.addInteractionGroup([lists[0][0]], [lists[1][0]])
    for _ in positions:
        force.addParticle([])
    system.addForce(force)
    return system, positions, RigidBodies.from_types(system, {kind: lists}, positions)


def test_a_contact_limits_the_step():
    system, positions, bodies = pair(SLOW, 1.0)
    text = str(prepare_system(system, bodies, positions=positions))
    # The reduced mass is 25 dalton, on a spring of 1000 kJ/mol/nm^2.
    period = 2000 * math.pi * math.sqrt(25 / 1000)
    assert f"by CustomNonbondedForce, has a period of {period:.3g} fs" in text
    turn = 1000 * math.sqrt(20 / (0.00831446 * 300))
    assert f"the body of atoms 0, 1, 2 turns by one radian in {turn:.3g} fs at 300 K" in text
    assert f"usual steps are {period / 20:.2g} fs with SIER4G at constant energy and {period / 13:.2g} fs" in text


def test_a_spin_limits_the_step():
    system, positions, bodies = pair(FAST, 1.0)
    text = str(prepare_system(system, bodies, positions=positions))
    turn = 1000 * math.sqrt(1e-3 / (0.00831446 * 300))
    energy, bath = (scheme.accuracy_limit / 2 * turn for scheme in (SIER4G, SIER2))
    assert f"usual steps are {energy:.2g} fs with SIER4G at constant energy and {bath:.2g} fs with SIER2" in text


def test_bodies_that_do_not_touch():
    system, positions, bodies = pair(SLOW, 2.0)
    text = str(prepare_system(system, bodies, positions=positions))
    assert "No contacts of the bodies can be measured at these positions" in text
    assert "usual steps are" not in text


def test_without_positions_nothing_is_measured():
    system, _, bodies = pair(SLOW, 1.0)
    assert "period" not in str(prepare_system(system, bodies))
    with pytest.raises(ValueError, match=r"positions .*\(6, 3\)"):
        prepare_system(system, bodies, positions=np.zeros((5, 3)))
