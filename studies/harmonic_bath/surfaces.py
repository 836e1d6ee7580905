"""Energies to second order about a minimum, on the constraints of a System, and Gaussian averages."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg


class Surface(NamedTuple):
    """Gradient (n,) and second derivatives (n, n) of an energy at the minimum."""

    gradient: np.ndarray
    curvature: np.ndarray

    def of_atoms(self, are_in: np.ndarray) -> Surface:
        """Return the part of atoms, (N,) of bool, of an energy that has no terms between them and others."""
        coordinates = np.repeat(are_in, 3)
        return Surface(coordinates * self.gradient, np.outer(coordinates, coordinates) * self.curvature)


class Gaussian(NamedTuple):
    """Mean (n,) and covariance (n, n) of mass-weighted coordinates."""

    mean: np.ndarray
    covariance: np.ndarray

    def energy(self, surface: Surface) -> float:
        """Return the mean of an energy less its value at the minimum, kJ/mol."""
        linear = surface.gradient @ self.mean
        return float(linear + np.sum(surface.curvature * (self.covariance + np.outer(self.mean, self.mean))) / 2)


class Tangents:
    """Directions in which atoms can move, in mass-weighted coordinates.

    A normal coordinate of the manifold of constraints is a tangent at the minimum. Of an energy V whose gradient is not
    along the constraints alone, second derivatives in these coordinates are those of V - sum l_c g_c, where g_c is half
    the square of the distance that a constraint keeps, and sum l_c grad g_c the part of grad V along the constraints.
    """

    def __init__(self, positions: np.ndarray, pairs: np.ndarray, masses: np.ndarray, moving: np.ndarray):
        """
        Args:
            positions: (N, 3), nm.
            pairs: of atoms with constraints, (c, 2).
            masses: (N,), dalton.
            moving: numbers of the atoms that move.
        """
        self._pairs = pairs[np.isin(pairs[:, 0], moving)]
        self._places = (3 * moving[:, None] + np.arange(3)).ravel()
        self._weights = np.repeat(masses[moving] ** -0.5, 3)
        normals = np.zeros((len(self._pairs), *positions.shape))
        rows = np.arange(len(self._pairs))
        first, second = self._pairs.T
        normals[rows, first] = positions[first] - positions[second]
        normals[rows, second] = -normals[rows, first]
        self._normals = normals.reshape(len(rows), positions.size)[:, self._places] * self._weights
        self._basis = scipy.linalg.null_space(self._normals) if len(rows) else np.eye(len(self._places))

    def __call__(self, surface: Surface) -> Surface:
        """Return a surface of all atoms in these coordinates."""
        gradient = surface.gradient[self._places] * self._weights
        curvature = surface.curvature.copy()
        if len(self._pairs):
            multipliers = np.linalg.lstsq(self._normals.T, gradient, rcond=None)[0]
            first, second = 3 * self._pairs.T
            for axis in range(3):
                i, j = first + axis, second + axis
                for row, column, sign in ((i, i, -1), (j, j, -1), (i, j, 1), (j, i, 1)):
                    np.add.at(curvature, (row, column), sign * multipliers)
        inner = curvature[np.ix_(self._places, self._places)] * np.outer(self._weights, self._weights)
        return Surface(self._basis.T @ gradient, self._basis.T @ inner @ self._basis)
