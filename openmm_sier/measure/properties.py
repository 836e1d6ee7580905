"""Properties of liquids from samples of a run: averages, fluctuations and correlations, each with its standard error.

Errors come from the number of independent samples in a series (`pymbar.timeseries`). Where a property is not the mean
of a series, they come from the scatter between parts of the run, which must be longer than the relaxation in it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT

#: Vacuum permittivity, e^2 mol/(kJ nm) (CODATA 2018).
PERMITTIVITY = 5.72765723e-4

#: 1 nm^2/ps in 10^-9 m^2/s, and kJ/mol/(nm^3) ps in mPa s.
NM2_PER_PS, KJ_PER_NM3_PS = 1e3, 1.66053907e-3

#: The constant of a cubic lattice with a neutralizing background (Yeh and Hummer, J. Phys. Chem. B 108, 15873 (2004),
#: Eq. 12).
YEH_HUMMER = 2.837297

#: ps; upper limit of the integral of the pressure's correlation for the viscosity. In liquid water at room temperature,
#: stress relaxes in some 0.6 ps, so less than a thousandth of the integral lies beyond, while the error grows with the
#: square root of the limit.
MEMORY = 5.0

#: ps; longest interval between pressures for the viscosity. Water molecules librate with periods of 30 fs and more, and
#: motion as fast as the interval is mistaken for slow motion. The error is 0.1 % at 20 fs, 0.4 % at 24 fs and 1 % at
#: 30 fs in SPC/E.
COARSEST = 0.03

#: Displacements to which the slope for self-diffusion is fitted; more would hardly lower its error.
SLOPE_POINTS = 11

#: Parts of a run, whose scatter gives the error of a property that is not the mean of a series.
PARTS = 8


class TooShortError(ValueError):
    """A run is too short, or has too few frames, for a property."""


class Estimate(NamedTuple):
    """A value and its standard error, NaN where there is none."""

    value: float
    error: float

    def __str__(self) -> str:
        if not (self.error > 0 and math.isfinite(self.error)):
            return f"{self.value:.4g}"
        digits = max(0, 1 - math.floor(math.log10(self.error)))
        return f"{self.value:.{digits}f} ± {self.error:.{digits}f}"

    def times(self, factor: float) -> Estimate:
        """In another unit."""
        return Estimate(self.value * factor, self.error * abs(factor))


def mean(series: np.ndarray) -> Estimate:
    """Mean of a correlated series (n,), the error from its statistical inefficiency.

    Source: Chodera et al., J. Chem. Theory Comput. 3, 26 (2007).
    """
    values = np.asarray(series, dtype=float)
    if _is_constant(values):
        return Estimate(float(values.mean()), 0.0)
    return Estimate(float(values.mean()), float(values.std()) * math.sqrt(inefficiency(values) / len(values)))


def _is_constant(values: np.ndarray) -> bool:
    """Whether values differ by rounding alone, as does the density of a box of constant volume."""
    return bool(np.ptp(values) <= 1e-13 * np.abs(values).max())


def inefficiency(values: np.ndarray) -> float:
    """How many samples of a series (n,) are worth one independent sample."""
    # At its import, pymbar advises to install JAX.
    log = logging.getLogger("pymbar")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        from pymbar.timeseries import statistical_inefficiency
    except ModuleNotFoundError as error:
        message = "properties need pymbar; install it with: pip install 'openmm-sier[properties]'"
        raise ModuleNotFoundError(message) from error
    finally:
        log.setLevel(before)
    return float(statistical_inefficiency(values))


def pooled(estimates: Sequence[Estimate]) -> Estimate:
    """Mean over independent runs of equal length; the error is from their scatter if there are five or more."""
    values, errors = np.array(estimates, dtype=float).T
    n = len(values)
    if _is_constant(values) and not errors.any():
        return Estimate(float(values.mean()), 0.0)
    error = values.std(ddof=1) / math.sqrt(n) if n >= 5 else math.sqrt((errors**2).sum()) / n
    return Estimate(float(values.mean()), float(error))


def of_parts(estimate: Callable[[np.ndarray], float], n: int, parts: int = PARTS) -> Estimate:
    """An estimate from all of n samples, and its standard error by the jackknife over equal parts of the run.

    Args:
        estimate: takes indices of samples and returns a number.
        n: number of samples.
        parts: how many; each must be longer than the correlation time.
    """
    if n < 2 * parts:
        return Estimate(estimate(np.arange(n)), math.nan)
    edges = np.linspace(0, n, parts + 1).astype(int)
    left_out = np.array([estimate(np.r_[0:a, b:n]) for a, b in pairwise(edges)])
    error = math.sqrt((parts - 1) / parts * ((left_out - left_out.mean()) ** 2).sum())
    return Estimate(estimate(np.arange(n)), error)


def heat_capacity(energy: np.ndarray, temperature: float, molecules: int) -> Estimate:
    """Heat capacity per mole of molecules, J/mol/K, from the fluctuations of an energy.

    Args:
        energy: (n,), kJ/mol: the total energy at constant volume, the enthalpy at constant pressure.
        temperature: K, of the ensemble.
        molecules: their number.
    """
    scale = 1e3 / (GAS_CONSTANT * temperature**2 * molecules)
    return of_parts(lambda part: float(np.var(energy[part])) * scale, len(energy))


def dielectric_constant(dipoles: np.ndarray, volumes: np.ndarray, temperature: float) -> Estimate:
    """Static dielectric constant with conducting boundaries, from the fluctuations of the dipole of the box.

    Args:
        dipoles: (n, 3), e nm, of whole molecules.
        volumes: (n,), nm^3.
        temperature: K.

    Source: Neumann, Mol. Phys. 50, 841 (1983). Means of the dipole, which vanish by symmetry, are not subtracted. The
    error is that of a normally distributed dipole.
    """
    scale = 1 / (3 * PERMITTIVITY * GAS_CONSTANT * temperature)
    squares = (dipoles**2).sum(axis=1)
    difference = scale * float(squares.mean() / np.mean(volumes))
    if not difference:
        return Estimate(1.0, 0.0)
    return Estimate(1 + difference, difference * math.sqrt(2 / 3 * _squares_inefficiency(dipoles) / len(dipoles)))


def _squares_inefficiency(vectors: np.ndarray) -> float:
    """How many squares of vectors (n, 3) are worth one independent square, if components are normal with mean zero.

    The squares then have the square of the vectors' correlation, which a short run tells far better than that of the
    squares themselves. It is summed down to 0.1 of the vectors' correlation.
    """
    products = _mean_products(vectors, len(vectors) - 1)
    correlation = products / products[0]
    low = np.flatnonzero(correlation < 0.1)
    return float(1 + 2 * (correlation[1 : low[0] if low.size else None] ** 2).sum())


def _mean_products(values: np.ndarray, longest: int) -> np.ndarray:
    """Mean over origins of the product of values (n, ...), summed over components, with those some frames later.

    Args:
        values: by frame.
        longest: number of frames in between, less than n; the result is (longest + 1,).

    Source: Kneller et al., Comput. Phys. Commun. 91, 191 (1995), by fast Fourier transforms.
    """
    n = len(values)
    transform = np.fft.rfft(values.reshape(n, -1), 2 * n, axis=0)
    sums = np.fft.irfft((np.abs(transform) ** 2).sum(axis=1), 2 * n)[: longest + 1]
    return sums / (n - np.arange(longest + 1))


def vaporization_enthalpy(potential: Estimate, temperature: float, molecules: int) -> Estimate:
    """Enthalpy of vaporization of rigid molecules to an ideal gas, kJ/mol.

    The gas has no potential energy, and the volume of the liquid is neglected. No correction for the polarization of
    the liquid is added: SPC/E, TIP4P/2005 and others were parametrized with one.

    Args:
        potential: mean of the potential energy of the liquid, kJ/mol.
        temperature: K.
        molecules: their number.
    """
    return Estimate(GAS_CONSTANT * temperature - potential.value / molecules, potential.error / molecules)


# --- motion -----------------------------------------------------------------------------------------------------------


def mean_square_displacements(centres: np.ndarray) -> np.ndarray:
    """Mean over molecules and origins of the squared displacement, (n,), by the number of frames in between.

    Args:
        centres: (n, m, 3), unwrapped.

    Source: Kneller et al., Comput. Phys. Commun. 91, 191 (1995), by fast Fourier transforms.
    """
    n = len(centres)
    squares = (centres**2).sum(axis=2)
    ends = np.concatenate([squares, np.zeros((1, squares.shape[1]))]).sum(axis=1)
    # Sums of the squares at both ends of all intervals of one length follow from those of intervals one frame shorter.
    sums = 2 * ends[:-1].sum() - np.concatenate([[0], np.cumsum(ends[: n - 1])])
    sums -= np.concatenate([[0], np.cumsum(ends[n - 1 : 0 : -1])])
    return (sums / (n - np.arange(n)) - 2 * _mean_products(centres, n - 1)) / centres.shape[1]


def self_diffusion(centres: np.ndarray, interval: float, first: float = 2.0, last: float = 5.0) -> Estimate:
    """Coefficient of self-diffusion in the periodic box, 10^-9 m^2/s, by Einstein's relation.

    Each frame is an origin from which the mean square displacement gives a slope. The result is the mean of these
    slopes, its error that of a correlated series. Later displacements would add more noise than information.

    Args:
        centres: (n, m, 3) of molecules, nm, unwrapped, without drift of the whole.
        interval: ps between frames.
        first, last: ps between which the slope is taken; below, molecules rattle in their cages.

    Raises:
        TooShortError: the run is not three times as long as `last`, or frames are more than `last`/5 apart.
    """
    if len(centres) * interval <= 3 * last or interval > last / 5 * (1 + 1e-9):
        raise TooShortError(
            f"self-diffusion needs a run of more than {3 * last:g} ps with frames {last / 5:g} ps apart or less, got "
            f"{len(centres) * interval:g} ps with frames {interval:g} ps apart"
        )
    lags = np.unique(np.linspace(first / interval, last / interval, SLOPE_POINTS).round().astype(int))
    origins = len(centres) - lags[-1]
    times = lags * interval - lags.mean() * interval
    slopes = np.zeros(origins)
    for lag, weight in zip(lags, times / (times @ times), strict=True):
        moved = centres[lag : lag + origins] - centres[:origins]
        slopes += weight * (moved**2).sum(axis=2).mean(axis=1)
    return mean(slopes).times(NM2_PER_PS / 6)


def viscosity_integrals(
    tensors: np.ndarray, interval: float, volume: float, temperature: float, last: float = MEMORY
) -> np.ndarray:
    """Running Green-Kubo integrals, mPa s, whose mean is the viscosity: (c, k), from 0 to `last` in k samples.

    There is one for each of five components of the traceless pressure tensor, which are independent and fluctuate alike
    in a liquid, in each of up to eight parts of the run, each at least ten times as long as `last`. Integrals are by
    the trapezoidal rule, which is exact where nothing in the correlation is as fast as the interval.

    Args:
        tensors: (n, 6), bar, components xx, yy, zz, xy, xz and yz.
        interval: ps between them.
        volume: nm^3.
        temperature: K.
        last: ps.

    Raises:
        TooShortError: the run is not twice as long as `last`, or the interval is longer than `COARSEST`.

    Source: Daivis and Evans, J. Chem. Phys. 100, 541 (1994), the sum over all components.
    """
    if interval > COARSEST * (1 + 1e-9):
        raise TooShortError(f"viscosity needs pressures {COARSEST:g} ps apart or less, got {interval:g} ps")
    n, lags = len(tensors), max(1, round(last / interval))
    if n < 2 * lags:
        raise TooShortError(
            f"viscosity needs a run of {2 * last:g} ps or more, and many times that for an error of some per cent, got "
            f"{n * interval:g} ps"
        )
    xx, yy, zz, xy, xz, yz = np.asarray(tensors, dtype=float).T * BAR
    shears = np.stack([xy, xz, yz, (xx - yy) / 2, (xx + yy - 2 * zz) / math.sqrt(12)], axis=1)
    scale = volume / (GAS_CONSTANT * temperature) * interval * KJ_PER_NM3_PS
    found = []
    for part in np.array_split(shears, max(1, min(PARTS, n // (10 * lags)))):
        correlation = np.stack([_mean_products(component, lags) for component in part.T])
        areas = (correlation[:, 1:] + correlation[:, :-1]) / 2
        found.append(scale * np.concatenate([np.zeros((5, 1)), np.cumsum(areas, axis=1)], axis=1))
    return np.concatenate(found)


def shear_viscosity(
    tensors: np.ndarray, interval: float, volume: float, temperature: float, last: float = MEMORY
) -> Estimate:
    """Shear viscosity, mPa s, by the formula of Green and Kubo; the arguments are those of `viscosity_integrals`.

    The upper limit of the integral is given, not read off the integral, where noise would choose it. `viscosity_tail`
    tells whether it is late enough.
    """
    return _of_components(viscosity_integrals(tensors, interval, volume, temperature, last)[:, -1])


def viscosity_tail(
    tensors: np.ndarray, interval: float, volume: float, temperature: float, last: float = MEMORY
) -> Estimate:
    """The part of `shear_viscosity` from the second half of the integral, mPa s: zero where `last` is late enough."""
    integrals = viscosity_integrals(tensors, interval, volume, temperature, last)
    return _of_components(integrals[:, -1] - integrals[:, integrals.shape[1] // 2])


def _of_components(values: np.ndarray) -> Estimate:
    return Estimate(float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values))))


def without_finite_size(diffusion: Estimate, temperature: float, edge: float, viscosity: float | Estimate) -> Estimate:
    """Coefficient of self-diffusion of an infinite liquid from that in a cubic box, both in 10^-9 m^2/s.

    Args:
        diffusion: in the box.
        temperature: K.
        edge: of the box, nm.
        viscosity: of the same model, mPa s; its error, if it has one, is propagated.

    Source: Yeh and Hummer, J. Phys. Chem. B 108, 15873 (2004), Eq. 12.
    """
    value, error = viscosity if isinstance(viscosity, Estimate) else (viscosity, 0.0)
    eta = value / KJ_PER_NM3_PS
    shift = YEH_HUMMER * GAS_CONSTANT * temperature / (6 * math.pi * eta * edge) * NM2_PER_PS
    return Estimate(diffusion.value + shift, math.hypot(diffusion.error, shift * error / value))


def orientation_correlation(directions: np.ndarray, longest: int) -> np.ndarray:
    """<P2(u(0) u(t))> over molecules and origins, (longest + 1,), by the number of frames in between.

    Args:
        directions: (n, m, 3), unit vectors.
        longest: number of frames, less than n.
    """
    products = directions[..., [0, 1, 2, 0, 0, 1]] * directions[..., [0, 1, 2, 1, 2, 2]]
    products *= np.array([1, 1, 1, *[math.sqrt(2)] * 3])
    return 1.5 * _mean_products(products, longest) / products.shape[1] - 0.5


def rotation_time(directions: np.ndarray, interval: float, parts: int = PARTS) -> Estimate:
    """Integral of <P2>, ps: by trapezoids down to 0.1, and the exponential tail that follows from there.

    Args:
        directions: (n, m, 3), unit vectors fixed in molecules.
        interval: ps between frames.
        parts: of the run, whose scatter gives the error.

    Raises:
        TooShortError: the correlation does not fall to 0.1 in a part of the run.
    """
    found = []
    for part in np.array_split(directions, parts):
        correlation = orientation_correlation(part, len(part) // 2)
        low = np.flatnonzero(correlation < 0.1)
        if not low.size or low[0] < 2:
            raise TooShortError(
                f"orientations must lose their correlation within {len(part) // 2 * interval:g} ps, and not within "
                f"two frames, {2 * interval:g} ps"
            )
        k = int(low[0])
        tail = correlation[k] * k * interval / math.log(correlation[k // 2] / correlation[k]) / 2
        found.append(interval * (correlation[: k + 1].sum() - 0.5 * (correlation[0] + correlation[k])) + tail)
    return Estimate(float(np.mean(found)), float(np.std(found, ddof=1) / math.sqrt(parts)))
