"""The step that bodies without bonds can take: by the stiffest contact at given positions, and by their spin."""

import math

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.prepare.stiffness import usual_steps
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import all_forces
from openmm_sier.system.links import links_of
from openmm_sier.system.measurement import HiddenError, Vibration, fastest_motion
from openmm_sier.system.second_context import reference_context

#: K, at which bodies spin.
TEMPERATURE = 300.0


def describe_contacts(system: openmm.System, bodies: BodySet, positions: np.ndarray) -> str:
    """Return sentences on the fastest motions of bodies at positions (N, 3), nm, and on usual steps.

    Each Force takes up to 43 evaluations on the Reference platform.
    """
    linked = links_of(system).link(bodies)
    context = reference_context(system)
    context.setPositions(positions)
    found: dict[str, Vibration] = {}
    hidden = []
    for entry in all_forces(system):
        if entry.containers or not kind_of(entry.force).exerts_forces:
            continue
        try:
            vibration = fastest_motion(entry.force, context, linked)
        except HiddenError:
            hidden.append(entry.name)
            continue
        if vibration is not None:
            found[entry.name] = vibration
    if hidden:
        return f"Overlaps of atoms hide the motions by {', '.join(hidden)}: give positions of a minimized start."
    return _described(bodies, found)


def _described(bodies: BodySet, found: dict[str, Vibration]) -> str:
    """Return sentences on motions, by the names of their Forces."""
    if not found:
        return (
            "No contacts of the bodies can be measured at these positions: for usual steps call prepare_system on a "
            "copy of the System with positions of a run."
        )
    rate, spin = _spin(bodies)
    name = max(found, key=lambda name: found[name].square)
    fastest = found[name]
    period = 2 * math.pi / math.sqrt(fastest.square)
    plural = "s" if len(fastest.atoms) > 1 else ""
    return (
        f"The stiffest contact at these positions, of atom{plural} {', '.join(map(str, fastest.atoms))} by {name}, has "
        f"a period of {1000 * period:.3g} fs{', and ' + spin if rate else ''}: {usual_steps(period, rate)}. In a run "
        "contacts may become closer."
    )


def _spin(bodies: BodySet) -> tuple[float, str]:
    """Return the largest thermal angular velocity of a body, 1/ps, and words on it; zero if no body turns."""
    inverse = bodies.inverse_moments
    if not inverse.any():
        return 0.0, ""
    _, body = np.unravel_index(inverse.argmax(), inverse.shape)
    rate = math.sqrt(GAS_CONSTANT * TEMPERATURE * inverse.max())
    name = bodies.describe(int(body))
    return rate, f"{name} turns by one radian in {1000 / rate:.3g} fs at {TEMPERATURE:g} K"
