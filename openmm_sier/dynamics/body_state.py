"""Phase points of rigid bodies."""

from dataclasses import dataclass, field

import numpy as np

#: Two arrays of bodies, for translation and rotation: centres and attitudes, momenta and angular momenta, forces and
#: torques, or inverse masses, (n,), and inverse moments, (3, n).
Pair = tuple[np.ndarray, np.ndarray]


class PlaceCache:
    """Results for one potential at the centres and attitudes of a state, once they have been computed.

    Attributes:
        forces: forces and torques of the kicks, each (3, n), kJ/mol/nm and kJ/mol.
        energy: potential energy, kJ/mol.
        members: state of the bodies that fast forces move, with a cache of its own for these forces.
    """

    forces: Pair | None = None
    energy: float | None = None
    members: "BodyState | None" = None


@dataclass(frozen=True, eq=False, init=False)
class BodyState:
    """Phase point of n rigid bodies, as returned by `integrator.getBodyState()`. It never changes in place.

    Attributes:
        q: centres of mass, (3, n), nm.
        p: momenta, (3, n), dalton nm/ps.
        A: attitude matrices, (3, 3, n); rows are the principal axes in the lab frame.
        L: angular momenta about the centres, in the lab frame, (3, n), dalton nm^2/ps.
        cache: of the place (q, A). States that differ in momenta share it; `dataclasses.replace` gives a new one.
    """

    q: np.ndarray
    p: np.ndarray
    A: np.ndarray
    L: np.ndarray
    cache: PlaceCache = field(init=False, repr=False)

    def __init__(
        self, q: np.ndarray, p: np.ndarray, A: np.ndarray, L: np.ndarray, cache: PlaceCache | None = None
    ) -> None:
        # Several of these are made in a step, and the generated constructor of a frozen class takes twice as long.
        attributes = self.__dict__
        attributes["q"] = q
        attributes["p"] = p
        attributes["A"] = A
        attributes["L"] = L
        attributes["cache"] = PlaceCache() if cache is None else cache
