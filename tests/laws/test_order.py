"""Order: against exact trajectories, errors of positions fall with the order of the scheme.

So they do for every System, scheme, engine and number of inner steps, prepared or not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import openmm
from hypothesis import strategies as st

from openmm_sier import FramedSystem, SIERIntegrator, prepare_system, with_frames
from openmm_sier.dynamics.schemes import CATALOGUE
from tests.laws.mixtures import Built, Mixture, angular_velocity, is_frozen, masses_of, mixtures
from tests.laws.oracle import Oracle

#: ps: length of the trajectories, and steps.
TIME, STEPS = 0.008, (0.001, 0.0005, 0.00025)


@dataclass(frozen=True)
class Run:
    """A way to move a mixture.

    Attributes:
        mixture: what moves; the native engine moves named bodies by frames.
        scheme: name of the scheme.
        engine: name of the engine.
        substeps: as the integrator's argument.
        platform: name of the platform.
    """

    mixture: Mixture
    scheme: str = "sier2"
    engine: str = "exact"
    substeps: int | None = None
    platform: str = "Reference"

    @property
    def order(self) -> int:
        """Order of the trajectories."""
        order = CATALOGUE[self.scheme].order
        if self.engine == "exact" or self.substeps in (None, 3, 5):
            return order
        # Without fast forces drifts are this number of RATTLE steps, of second order.
        return min(order, 2)

    def errors(self) -> list[float]:
        """Return the largest error of a coordinate at the end of trajectories, nm, for each of `STEPS`."""
        built = self.mixture.build()
        expected = Oracle(built).positions(TIME)
        framed = with_frames(built.plain, built.positions, built.bodies) if self.engine == "native" and built.named else None
        system, bodies, x, v = built.system, built.bodies, built.positions, built.velocities
        if framed is not None:
            system, bodies, x, v = framed.system, None, framed.positions, framed_velocities(framed, built)
            if self.mixture.prepared != "no":
                prepare_system(system)
        integrator = SIERIntegrator(
            STEPS[0], CATALOGUE[self.scheme], bodies=bodies, engine=self.engine, substeps=self.substeps
        )
        context = openmm.Context(system, integrator, openmm.Platform.getPlatform(self.platform))
        result = []
        for step in STEPS:
            integrator.setStepSize(step)
            context.setPositions(x)
            context.setVelocities(v)
            integrator.step(round(TIME / step))
            atoms = context.getState(positions=True).getPositions(asNumpy=True)._value[: len(expected)]
            result.append(float(np.abs(atoms - expected).max()))
        return result


def framed_velocities(framed: FramedSystem, built: Built) -> np.ndarray:
    """Return the velocities of all particles of a copy with frames."""
    masses = masses_of(built.plain)
    velocities = np.zeros((framed.system.getNumParticles(), 3))
    velocities[: framed.numAtoms] = built.velocities
    for frame in framed.frames:
        m, x, v = masses[frame.atoms], built.positions[frame.atoms], built.velocities[frame.atoms]
        centre = m @ x / m.sum()
        momentum = (m[:, None] * np.cross(x - centre, v)).sum(axis=0)
        spin = angular_velocity(m, x - centre, momentum)
        velocities[frame.particles] = m @ v / m.sum() + np.cross(spin, framed.positions[frame.particles] - centre)
        velocities[frame.atoms] = 0
    return velocities


@st.composite
def runs(draw: st.DrawFn) -> Run:
    """Draw a way to move a mixture, whose momentum no remover changes."""
    engine = draw(st.sampled_from(["exact", "native"]))
    mixture = draw(mixtures())
    if is_frozen(mixture):
        mixture = replace(mixture, remover=False)
    scheme = draw(st.sampled_from(list(CATALOGUE)))
    return Run(mixture, scheme, engine, draw(st.sampled_from([None, 1, 2, 3])))
