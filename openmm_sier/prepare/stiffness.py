"""Stiffest bond or angle of a System, which identifies coarse-grained models, and usual steps for these."""

import math
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.schemes import SIER2, SIER4G
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import COARSE, harmonic_frequencies, mobilities, working_terms
from openmm_sier.system.forces import kind_of

#: Usual steps over the period of the stiffest motion: at constant energy with SIER4G, and in a heat bath with SIER2.
#: For a chain of 40 beads with two domains SIER4G's rms(H)/rms(V) within 40 ps was 0.022 % at 1/20 of the period (26
#: fs), 0.06 % at 1/16, 0.8 % at 1/13 and 1.8 % at 1/10; with bonds ten times as strong 0.001 % at 1/20 and 0.9 % at
#: 1/13. In a bath SIER2 had the averages of short steps up to 1/13 (40 fs), and hardly so at 60 fs. Bonds of a chain
#: couple, so that some modes are up to 1.4 times as fast as a bond alone. By the stiffest contacts in liquids of patchy
#: particles, repulsive rods and Gay-Berne ellipsoids SIER4G had 0.01 to 0.08 % at 1/20 and 0.07 to 0.5 % at 1/10; in a
#: bath neither averages nor temperatures had an error of the step at 1/13, nor at 1/8.
USUAL = {SIER4G: 1 / 20, SIER2: 1 / 13}


class Stiffest(NamedTuple):
    """Fastest motion caused by bonded Forces.

    Attributes:
        period: ps.
        atoms: particle indices of the bond or angle.
    """

    period: float
    atoms: tuple[int, ...]

    @property
    def is_coarse(self) -> bool:
        """Whether the motion is so slow that kicks can follow it."""
        return self.period >= COARSE


def stiffest(system: openmm.System, bodies: BodySet | None, owner: np.ndarray) -> Stiffest | None:
    """Return the stiffest bond or angle that does work; None if there is none, or if some stiffness is unknown.

    Args:
        system: openmm.System.
        bodies: its rigid bodies, whose atoms move less easily than free ones; None if they are not known yet.
        owner: body index of each particle, (N,).
    """
    masses, constraints = tables.masses(system), tables.constraints(system)
    # No atom of a body moves more easily than it would alone.
    inverse_masses = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    mobility = inverse_masses if bodies is None else mobilities(bodies)
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


def describe_coarse(motion: Stiffest) -> str:
    """Return a sentence on the stiffest motion of a coarse-grained model, and on usual steps."""
    kind = "bond between atoms" if len(motion.atoms) == 2 else "angle of atoms"
    return (
        f"There are no fast forces, since all bonds and angles are slow. The stiffest of them, the {kind} "
        f"{', '.join(map(str, motion.atoms))}, has a period of {1000 * motion.period:.3g} fs: "
        f"{usual_steps(motion.period)}."
    )


def usual_steps(period: float, spin: float = 0.0) -> str:
    """Return usual steps in words.

    Args:
        period: of the stiffest motion, ps; infinite without one.
        spin: largest thermal angular velocity of a body, 1/ps.
    """
    limits = {scheme: scheme.spin_limit / spin if spin else math.inf for scheme in USUAL}
    steps = {scheme: min(share * period, limits[scheme]) for scheme, share in USUAL.items()}
    energy, bath = (f"{1000 * step:.2g} fs with {scheme.name}" for scheme, step in steps.items())
    return f"usual steps are {energy} at constant energy and {bath} in a heat bath"
