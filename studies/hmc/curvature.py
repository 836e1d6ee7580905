"""Squares of forces and their divergence, whose means have the ratio kT: configurational temperatures.

For a field u on the positions that constraints leave free, <u . grad V> = kT <div u>. Here u is the force over the mass
of groups of atoms that constraints hold together, which move as wholes, and the torque on water, which turns. The
measure of constrained motion does not depend on where such groups are, nor on how a rigid molecule is turned, so that
nothing else enters. The divergence is estimated without bias by forces at two places, displaced by random signs.

Sources: Butler, Ayton, Jepps and Evans, J. Chem. Phys. 109, 6519 (1998); Hutchinson, Commun. Stat. Simul. Comput. 19,
433 (1990).
"""

from __future__ import annotations

import numpy as np
import openmm
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from openmm_sier import RigidBodies
from openmm_sier.inputs.equilibration import make_context
from studies.units import md

#: The motion of rigid molecules as wholes, their turning, and that of the parts of other molecules.
KINDS = ("translation", "rotation", "flexible")

#: Displacements, nm, and angles, rad: small beside those over which forces change, large beside rounding.
DISPLACEMENT, ANGLE = 1e-4, 1e-3


class Curvature:
    """Computes squares and divergences for the States of a System, in a Context of its own."""

    def __init__(self, system: openmm.System, bodies: RigidBodies, seed: int, platform: str | None) -> None:
        n = system.getNumParticles()
        self.context = make_context(system, openmm.VerletIntegrator(0.001), platform)
        self.masses = np.array([md(system.getParticleMass(i)) for i in range(n)])
        pairs = np.array([system.getConstraintParameters(i)[:2] for i in range(system.getNumConstraints())])
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(n, n))
        count, self.groups = connected_components(graph, directed=False)
        self.weights = 1 / self._sum(self.masses[:, None], count)
        self.rigid = np.ones(count, dtype=bool)
        self.rigid[self.groups[bodies.point_particles]] = False
        self.rng = np.random.default_rng(seed)

    def _sum(self, values: np.ndarray, count: int = 0) -> np.ndarray:
        """Sums (groups, k) of values (N, k) over the atoms of each group."""
        found = np.zeros((count or len(self.weights), values.shape[1]))
        np.add.at(found, self.groups, values)
        return found

    def __call__(self, state: openmm.State) -> dict[str, float]:
        """`KIND_square` and `KIND_divergence` of each kind, in kJ/mol per dalton nm^2, and per 1 for the rotation.

        Args:
            state: positions and box.
        """
        self.context.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        positions = md(state.getPositions(asNumpy=True))
        centres = self.weights * self._sum(self.masses[:, None] * positions)
        arms = positions - centres[self.groups]
        shift, turn = self.rng.choice([-1.0, 1.0], size=(2, len(centres), 3))
        turn[~self.rigid] = 0.0
        found = []
        for sign in (1, -1):
            turned = Rotation.from_rotvec(sign * ANGLE * turn[self.groups]).apply(arms)
            moved = centres + sign * DISPLACEMENT * shift
            self.context.setPositions(moved[self.groups] + turned)
            forces = md(self.context.getState(forces=True).getForces(asNumpy=True))
            found.append((self._sum(forces), self._sum(np.cross(turned, forces))))
        (ahead, ahead_turning), (behind, behind_turning) = found
        force, torque = 0.5 * (ahead + behind), 0.5 * (ahead_turning + behind_turning)
        divergence = -shift * (ahead - behind) / (2 * DISPLACEMENT)
        turning = -turn * (ahead_turning - behind_turning) / (2 * ANGLE)
        terms = {
            "translation": (self.weights * force**2, self.weights * divergence, self.rigid),
            "rotation": (torque**2, turning, self.rigid),
            "flexible": (self.weights * force**2, self.weights * divergence, ~self.rigid),
        }
        return {
            f"{kind}_{name}": float(values[chosen].sum())
            for kind, (square, curved, chosen) in terms.items()
            for name, values in (("square", square), ("divergence", curved))
        }
