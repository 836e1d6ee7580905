"""Transport coefficients of liquids: shear viscosity from pressure tensors, and self-diffusion from positions."""

import math
from collections.abc import Sequence

import numpy as np

from openmm_sier.analysis.statistics import Estimate, mean_and_error, of_independent
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.correlation import mean_products

#: 1 nm^2/ps in 10^-9 m^2/s, and kJ/mol/(nm^3) ps in mPa s.
NM2_PER_PS, KJ_PER_NM3_PS = 1e3, 1.66053907e-3

#: Constant of a cubic lattice with a neutralizing background (Yeh and Hummer, J. Phys. Chem. B 108, 15873 (2004),
#: Eq. 12).
YEH_HUMMER = 2.837297

#: Upper limit in ps of the integral of the pressure's correlation for the viscosity. In liquid water at room
#: temperature stress relaxes in some 0.6 ps, so less than a thousandth of the integral lies beyond, while the error
#: grows with the square root of the limit.
MEMORY = 5.0

#: Maximum interval between pressures for the viscosity, ps. Water molecules librate with periods of 30 fs and more, and
#: motion as fast as the interval is mistaken for slow motion. The error is 0.1 % at 20 fs, 0.4 % at 24 fs and 1 % at
#: 30 fs in SPC/E.
COARSEST = 0.03

#: Maximum number of parts of a run whose scatter gives the error of its viscosity.
PARTS = 8

#: Number of displacements in the fit of the slope for self-diffusion; more would hardly lower its error.
SLOPE_POINTS = 11


class TooShortError(ValueError):
    """Run that is too short, or has too few frames, for a property."""


def shear_viscosity(
    tensors: np.ndarray, interval: float, volume: float, temperature: float, last: float = MEMORY
) -> Estimate:
    """Return the shear viscosity, mPa s, by the Green-Kubo formula.

    >>> tensors = np.random.default_rng(1).normal(scale=500, size=(2000, 6))
    >>> viscosity = shear_viscosity(tensors, interval=0.02, volume=15.4, temperature=297)

    The five independent components of the traceless pressure tensor fluctuate alike in a liquid. The error is from the
    scatter of their integrals in up to eight parts of the run, each at least ten times as long as `last`. The upper
    limit of the integral is fixed in advance: noise would affect a choice from the integral itself. Integrals use the
    trapezoidal rule, which is exact if nothing in the correlation is as fast as the interval.

    Args:
        tensors: pressure tensors, (n, 6), bar, components xx, yy, zz, xy, xz and yz.
        interval: time between tensors, ps.
        volume: volume of the box, nm^3.
        temperature: in K.
        last: upper limit of the integral over the correlation, ps.

    Raises:
        TooShortError: the run is not twice as long as `last`, or the interval is longer than `COARSEST`.

    Source: Daivis and Evans, J. Chem. Phys. 100, 541 (1994), the sum over all components.
    """
    if interval > COARSEST * (1 + 1e-9):
        raise TooShortError(f"viscosity needs pressures at most {COARSEST:g} ps apart, got {interval:g} ps")
    n, lags = len(tensors), max(1, round(last / interval))
    if n < 2 * lags:
        raise TooShortError(
            f"viscosity needs a run of at least {2 * last:g} ps, got {n * interval:g} ps; an error of a few per cent "
            "needs a run many times as long"
        )
    xx, yy, zz, xy, xz, yz = np.asarray(tensors, dtype=float).T * BAR
    shears = np.stack([xy, xz, yz, (xx - yy) / 2, (xx + yy - 2 * zz) / math.sqrt(12)])
    integrals = []
    for block in np.array_split(shears, max(1, min(PARTS, n // (10 * lags))), axis=1):
        correlations = np.stack([mean_products(component, lags) for component in block])
        integrals.append(correlations.sum(axis=1) - (correlations[:, 0] + correlations[:, -1]) / 2)
    scale = volume / (GAS_CONSTANT * temperature) * interval * KJ_PER_NM3_PS
    return of_independent(np.concatenate(integrals)).times(scale)


def self_diffusion(centres: np.ndarray, interval: float, first: float = 2.0, last: float = 5.0) -> Estimate:
    """Return the self-diffusion coefficient in the periodic box, 10^-9 m^2/s, by the Einstein relation.

    >>> walks = np.random.default_rng(1).normal(scale=0.02, size=(300, 64, 3)).cumsum(axis=0)
    >>> diffusion = self_diffusion(walks, interval=0.1)

    Each frame is an origin from which the mean square displacement gives a slope. The result is the mean of these
    slopes, with the error of a correlated series. Longer times would add more noise than information.

    Args:
        centres: centres of m molecules in n frames, (n, m, 3), nm, along continuous paths; see `unwrapped`.
        interval: time between frames, ps.
        first: shortest time for the slope, ps; at shorter times molecules rattle in their cages.
        last: longest time for the slope, ps.

    Raises:
        TooShortError: the run is not three times as long as `last`, or frames are more than `last`/5 apart.
    """
    if len(centres) * interval <= 3 * last or interval > last / 5 * (1 + 1e-9):
        raise TooShortError(
            f"self-diffusion needs a run of more than {3 * last:g} ps, got {len(centres) * interval:g} ps, and frames "
            f"at most {last / 5:g} ps apart, got {interval:g} ps"
        )
    lags = np.unique(np.linspace(first / interval, last / interval, SLOPE_POINTS).round().astype(int))
    origins = len(centres) - lags[-1]
    times = lags * interval - lags.mean() * interval
    slopes = np.zeros(origins)
    for lag, weight in zip(lags, times / (times @ times), strict=True):
        displacements = centres[lag : lag + origins] - centres[:origins]
        slopes += weight * (displacements**2).sum(axis=2).mean(axis=1)
    return mean_and_error(slopes).times(NM2_PER_PS / 6)


def unwrapped(wrapped: np.ndarray, edges: np.ndarray, masses: Sequence[float] | None = None) -> np.ndarray:
    """Return continuous paths (n, m, 3) of particles in rectangular boxes.

    >>> paths = unwrapped(np.array([[[0.9, 0, 0], [0, 0, 0]], [[0.1, 0, 0], [0, 0, 0]]]), np.ones((2, 3)))

    Each step is the shortest one in the box at its end, which keeps diffusion correct if the box changes. In a heat
    bath with friction the box as a whole diffuses, too. To leave this motion out, give all particles with their masses,
    and select those of interest from the paths.

    Args:
        wrapped: positions of m particles in n frames, (n, m, 3), nm.
        edges: of the boxes, (n, 3), nm.
        masses: of all particles of the box, (m,), in any unit, for paths without the motion of the centre of mass; None
            for the paths as they are.

    Raises:
        ValueError: there are not as many masses as particles, or all are zero.

    Source: von Bülow, Bullerjahn and Hummer, J. Chem. Phys. 153, 021101 (2020).
    """
    steps = np.diff(np.asarray(wrapped, dtype=float), axis=0)
    box_edges = edges[1:, None]
    steps -= box_edges * np.round(steps / box_edges)
    if masses is not None:
        if len(masses) != steps.shape[1] or not np.sum(masses) > 0:
            raise ValueError(
                f"masses must be those of all {steps.shape[1]} particles, got {len(masses)} masses with the sum "
                f"{np.sum(masses):g}"
            )
        steps -= np.average(steps, axis=1, weights=masses)[:, None]
    return np.concatenate([wrapped[:1], wrapped[:1] + np.cumsum(steps, axis=0)])


def without_finite_size(diffusion: Estimate, temperature: float, edge: float, viscosity: Estimate) -> Estimate:
    """Return a self-diffusion coefficient corrected for the size of a cubic box, 10^-9 m^2/s.

    >>> print(without_finite_size(Estimate(2.3, 0.02), temperature=297, edge=2.5, viscosity=Estimate(0.9, 0.05)))
    2.574 ± 0.025

    Args:
        diffusion: coefficient in the box, 10^-9 m^2/s.
        temperature: in K.
        edge: edge of the box, nm.
        viscosity: viscosity of the same model, mPa s; its error is propagated.

    Source: Yeh and Hummer, J. Phys. Chem. B 108, 15873 (2004), Eq. 12.
    """
    eta = viscosity.value / KJ_PER_NM3_PS
    shift = YEH_HUMMER * GAS_CONSTANT * temperature / (6 * math.pi * eta * edge) * NM2_PER_PS
    error = math.hypot(diffusion.error, shift * viscosity.error / viscosity.value)
    return diffusion._replace(value=diffusion.value + shift, error=error)
