"""Energy minimization of rigid bodies."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.constraints import Constraints
from openmm_sier.dynamics.vectors import body_frame, rotation_matrix, turned

#: FIRE's own parameters (Bitzek et al., Phys. Rev. Lett. 97, 170201 (2006)).
SLOWEST_MIXING, MIXING_DECAY = 0.1, 0.99
ACCELERATION, DECELERATION, PATIENCE = 1.1, 0.5, 5

#: Largest displacement of a centre, and of an atom by the rotation of its body, in one iteration, nm. Forces between
#: overlapping atoms would move them across the box.
LARGEST_DISPLACEMENT = 0.01

#: Displacement in nm of the body with the largest force in the first iteration.
FIRST_DISPLACEMENT = 1e-3

#: (q, A) -> (F, tau)
Forces = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Iterate(NamedTuple):
    """The bodies after some iterations.

    Attributes:
        q: centres, (3, n), nm.
        A: attitudes, (3, 3, n).
        rms: root mean square of the components of forces, and of torques over radii of gyration, kJ/mol/nm.
    """

    q: np.ndarray
    A: np.ndarray
    rms: float


def descent(bodies: BodySet, forces: Forces, q: np.ndarray, A: np.ndarray) -> Iterator[Iterate]:
    """Yield iterates of an energy minimization without end, the first of which is the start.

    FIRE: unit masses move under the forces; the velocity is turned towards the force, and set to zero whenever it
    points uphill. Rotations are measured in nm, as angles times radii of gyration. Constraints between bodies stay
    satisfied, since only forces tangent to them act.

    Args:
        bodies: the bodies that move.
        forces: forces in kJ/mol/nm and torques in kJ/mol on them, each (3, n).
        q: centres, (3, n), nm.
        A: attitudes, (3, 3, n).

    Raises:
        ConstraintError: constraints cannot be satisfied.
    """
    constraints = Constraints(*bodies.links, np.ones(bodies.n), bodies.describe)
    radii = np.sqrt(bodies.moments.sum(axis=0) / (2 * bodies.masses))
    inverse = np.divide(1.0, radii, out=np.zeros_like(radii), where=radii > 0)
    freedoms = max(bodies.dof, 1)
    v, step, mixing, downhill = np.zeros((6, bodies.n)), 0.0, SLOWEST_MIXING, 0
    while True:
        F, tau = forces(q, A)
        f = np.concatenate([constraints.project(q, F), tau * inverse])
        length = np.sqrt((f**2).sum())
        yield Iterate(q, A, float(length / np.sqrt(freedoms)))
        if length == 0:
            continue
        step = step or float(np.sqrt(FIRST_DISPLACEMENT / np.abs(f).max()))
        if (f * v).sum() > 0:
            v = (1 - mixing) * v + (mixing * np.sqrt((v**2).sum()) / length) * f
            downhill += 1
            if downhill > PATIENCE:
                step, mixing = step * ACCELERATION, mixing * MIXING_DECAY
        elif v.any():
            v, step, mixing, downhill = np.zeros_like(v), step * DECELERATION, SLOWEST_MIXING, 0
        v = v + step * f
        # Bodies are limited one by one, so that two that overlap do not slow down all others.
        size = np.maximum(np.linalg.norm(v[:3], axis=0), np.linalg.norm(v[3:], axis=0))
        v *= np.minimum(1.0, LARGEST_DISPLACEMENT / np.maximum(step * size, 1e-300))
        v[:3] = constraints.project(q, v[:3])
        # The Cayley form of small rotations; the lab, seen from the body, turns back.
        rows = rotation_matrix(1.0, *(-0.5 * body_frame(A, step * v[3:] * inverse)))
        q, A = constraints.displaced(q, v[:3], step), turned(rows, A)
