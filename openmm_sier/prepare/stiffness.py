"""The stiffest bond or angle that does work, by which coarse models are told from atoms, and steps for them."""

import math
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.schemes import SIER2, SIER4G, Scheme
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import harmonic_frequencies, working_terms
from openmm_sier.system.forces import kind_of
from openmm_sier.system.mobilities import COARSE, mobilities

#: Share of the period of the stiffest bond that is a usual step: at constant energy with SIER4G, and with SIER2 in a
#: heat bath. Of a chain of 40 beads with two domains SIER4G's rms(H)/rms(V) within 40 ps was 0.022 % at 1/20 of the
#: period (26 fs), 0.06 % at 1/16, 0.8 % at 1/13 and 1.8 % at 1/10; with bonds ten times as strong 0.001 % at 1/20 and
#: 0.9 % at 1/13. In a bath SIER2 had the averages of short steps up to 1/13 (40 fs), and hardly any more at 60 fs.
USUAL = {SIER4G: 1 / 20, SIER2: 1 / 13}


class Stiffest(NamedTuple):
    """The fastest motion that bonded Forces cause.

    Attributes:
        period: ps.
        atoms: particle indices of the bond or angle.
    """

    period: float
    atoms: tuple[int, ...]

    @property
    def is_coarse(self) -> bool:
        """Tell whether it is so slow that kicks can follow it."""
        return self.period >= COARSE


def stiffest(system: openmm.System, bodies: BodySet | None, owner: np.ndarray) -> Stiffest | None:
    """Return the stiffest bond or angle that does work; None without one, or if the stiffness of some is not known.

    Args:
        system: openmm.System.
        bodies: its rigid bodies, whose atoms move less easily than alone; None where they are not known yet.
        owner: for each particle the number of its body, (N,).
    """
    masses, constraints = tables.masses(system), tables.constraints(system)
    # No atom of a body moves more easily than it would alone.
    alone = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    mobility = alone if bodies is None else mobilities(bodies)
    fastest = Stiffest(math.inf, ())
    for force in system.getForces():
        if not len(working_terms(force, owner)):
            continue
        # The stiffness of expressions is not known here. Torsions are softer than angles.
        if not kind_of(force).is_divisible:
            return None
        atoms, squares = harmonic_frequencies(force, mobility, owner, constraints)
        if len(squares) and squares.max() > 0:
            period = 2 * math.pi / math.sqrt(squares.max())
            fastest = min(fastest, Stiffest(period, tuple(atoms[squares.argmax()].tolist())))
    return fastest if fastest.atoms else None


def usual_steps(motion: Stiffest) -> dict[Scheme, float]:
    """Return steps in ps that are usual where this is the stiffest motion: at constant energy, and in a heat bath.

    Bonds of a chain couple, so that some are up to 1.4 times as fast as one alone.
    """
    return {scheme: share * motion.period for scheme, share in USUAL.items()}


def describe_coarse(motion: Stiffest) -> str:
    """Say what limits the step of a coarse model, and which steps are usual."""
    kind = "bond between atoms" if len(motion.atoms) == 2 else "angle of atoms"
    energy, bath = (f"{1000 * step:.2g} fs with {scheme.name}" for scheme, step in usual_steps(motion).items())
    return (
        f"There are no fast forces, since all bonds and angles are slow. The stiffest of them, the {kind} "
        f"{', '.join(map(str, motion.atoms))}, has a period of {1000 * motion.period:.3g} fs: usual steps are {energy} "
        f"at constant energy and {bath} in a heat bath."
    )
