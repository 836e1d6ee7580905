"""Masses and moments of bodies, the axes along and about which they move, and what follows for momenta and energies."""

from functools import cached_property

import numpy as np

from openmm_sier.dynamics import kernels
from openmm_sier.dynamics.body_state import BodyState, Pair
from openmm_sier.dynamics.vectors import body_frame


class Bearings:
    """Bearings of bodies that do not move along or turn about all axes; they take up forces and torques along the rest.

    They take up momenta too, such as those of velocities that a user sets.

    Attributes:
        columns: of the bodies with bearings, ascending, (k,).
    """

    def __init__(self, translates: np.ndarray, turns: np.ndarray, columns: np.ndarray) -> None:
        """
        Args:
            translates: whether each of all bodies moves along x, y and z, (3, n).
            turns: whether each turns about its principal axes, (3, n).
            columns: of the bodies with bearings, ascending, (k,).
        """
        self.columns = columns
        self._tables = columns, translates, turns

    def remove(self, p: np.ndarray, L: np.ndarray, A: np.ndarray) -> None:
        """Remove the parts that bearings take up from momenta or forces, and angular momenta or torques, (3, n)."""
        kernels.bodies.hold(len(self.columns), *self._tables, A, p, L)


class Inertia:
    """The inertia of n bodies, and their motions.

    Attributes:
        n: number of bodies.
        masses: (n,), dalton.
        moments: principal moments, (3, n), dalton nm^2.
        translates: whether each body moves along x, y and z, (3, n).
        turns: whether each body turns about its principal axes, (3, n).
    """

    def __init__(self, masses: np.ndarray, moments: np.ndarray, translates: np.ndarray, turns: np.ndarray) -> None:
        self.n = len(masses)
        self.masses = masses
        self.moments = np.ascontiguousarray(moments)
        self.translates = np.ascontiguousarray(translates)
        self.turns = np.ascontiguousarray(turns)

    # --- motions ---

    @cached_property
    def _turns_freely(self) -> np.ndarray:
        """Whether each body turns about all axes about which it has a moment, (n,)."""
        return (self.turns == (self.moments > 0)).all(axis=0)

    @cached_property
    def bearings(self) -> Bearings | None:
        """Bearings of bodies that do not move along and about all axes; None if there are none."""
        moves_freely = self.translates.all(axis=0) & self._turns_freely
        return None if moves_freely.all() else Bearings(self.translates, self.turns, np.flatnonzero(~moves_freely))

    @cached_property
    def rotation_moments(self) -> np.ndarray:
        """Moments with which bodies turn freely, (3, n), dalton nm^2.

        They are the principal ones without bearings, and three equal ones with them. A body that turns about one axis
        has all of its angular momentum along this axis. With three equal moments it turns about the axis uniformly, as
        it should, and rounding errors do not grow. So does a body that turns about two axes with equal moments, as a
        line does.
        """
        if self._turns_freely.all():
            return self.moments
        return np.where(self._turns_freely, self.moments, (self.moments * self.turns).max(axis=0))

    @cached_property
    def inverse_masses(self) -> np.ndarray:
        """Inverse masses, (n,), 1/dalton."""
        return 1 / self.masses

    @cached_property
    def inverse_moments(self) -> np.ndarray:
        """Inverse moments, (3, n), 1/(dalton nm^2); zero about axes about which a body does not turn."""
        return np.divide(1.0, self.moments, out=np.zeros_like(self.moments), where=self.turns)

    # --- energies and momenta ---

    def kinetic_energies_by_axis(self, state: BodyState) -> np.ndarray:
        """Return kinetic energies of each body along and about its principal axes, (2, 3, n), kJ/mol.

        The first are of translation, the second of rotation. In equilibrium each of a body that moves freely has the
        mean kT/2, but for rotations about axes without a moment.
        """
        along = body_frame(state.A, state.p) ** 2 * self.inverse_masses
        about = body_frame(state.A, state.L) ** 2 * self.inverse_moments
        return 0.5 * np.stack([along, about])

    def kinetic_energies(self, state: BodyState) -> tuple[float, float]:
        """Return the translational and rotational kinetic energy, kJ/mol."""
        translation = 0.5 * float(((state.p**2).sum(axis=0) / self.masses).sum())
        rotation = 0.5 * float((body_frame(state.A, state.L) ** 2 * self.inverse_moments).sum())
        return translation, rotation

    @cached_property
    def moving_masses(self) -> np.ndarray:
        """Masses of the bodies along x, y and z, (3, n), dalton; zero along axes along which a body does not move."""
        return np.broadcast_to(self.masses, (3, self.n)) if self.translates.all() else self.masses * self.translates

    @cached_property
    def moving_mass(self) -> np.ndarray:
        """Total mass of the bodies that move along x, y and z, (3,), dalton."""
        return self.moving_masses.sum(axis=1)

    def centre_velocity(self, p: np.ndarray) -> np.ndarray:
        """Return the velocity of the centre of mass of all that moves, (3,), nm/ps, for momenta (3, n).

        It is zero along axes along which no body moves.
        """
        return np.divide(p.sum(axis=1), self.moving_mass, out=np.zeros(3), where=self.moving_mass > 0)

    def shifted(self, state: BodyState, velocity: np.ndarray) -> BodyState:
        """Return the state with a velocity, (3,), nm/ps, added to all that moves."""
        p = state.p + self.moving_masses * velocity[:, None]
        return BodyState(state.q, p, state.A, state.L, state.cache)

    def stopped(self, state: BodyState) -> tuple[BodyState, float]:
        """Return the state without the motion of the total centre of mass, and its energy, kJ/mol."""
        velocity = self.centre_velocity(state.p)
        return self.shifted(state, -velocity), -self.energy_of_shift(velocity, -velocity)

    def energy_of_shift(self, centre: np.ndarray, velocity: np.ndarray) -> float:
        """Return the energy gain when a velocity is added to all that moves, kJ/mol.

        Args:
            centre: previous velocity of the centre of mass, (3,), nm/ps.
            velocity: added velocity, (3,), nm/ps.
        """
        return float(self.moving_mass @ ((centre + 0.5 * velocity) * velocity))

    def total_momenta(self, state: BodyState) -> Pair:
        """Return the total momentum and total angular momentum about the origin, each (3,)."""
        return state.p.sum(axis=1), (np.cross(state.q.T, state.p.T).T + state.L).sum(axis=1)
