"""Properties of liquids from samples of a run: averages, fluctuations and correlations, each with its standard error.

Errors come from the number of independent samples in a series. Where a property is not the mean of a series, they come
from the scatter between parts of the run, which must be longer than the relaxation in it.
"""

from __future__ import annotations

import math

import numpy as np

from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from openmm_sier.dynamics.statistics import mean_products
from openmm_sier.measure.statistics import Estimate, jackknife, mean_and_error, of_independent

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

#: Bins over which a pair distribution is smoothed to find its maximum, and the part of that maximum above which a cubic
#: is fitted to the bins themselves. In TIP4P/2005 with bins of 0.002 nm the fit is off by 0.01 of 3.23, a parabola by
#: 0.06. With 20 frames of 512 molecules it scatters by 0.04, while the highest bin is too high by 0.06.
SMOOTHED, FITTED = 9, 0.7

#: Parts of a run, whose scatter gives the error of a property that is not the mean of a series.
PARTS = 8


class TooShortError(ValueError):
    """A run is too short, or has too few frames, for a property."""


def heat_capacity(energy: np.ndarray, temperature: float, molecules: int) -> Estimate:
    """Heat capacity per mole of molecules, J/mol/K, from the fluctuations of an energy.

    Args:
        energy: (n,), kJ/mol: the total energy at constant volume, the enthalpy at constant pressure.
        temperature: K, of the ensemble.
        molecules: their number.
    """
    scale = 1e3 / (GAS_CONSTANT * temperature**2 * molecules)
    return jackknife(lambda kept: float(np.var(energy[kept])) * scale, len(energy), PARTS)


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
    samples = dipoles.size / _squares_inefficiency(dipoles)
    return Estimate(1 + difference, difference * math.sqrt(2 / samples), samples)


def _squares_inefficiency(vectors: np.ndarray) -> float:
    """How many squares of vectors (n, 3) are worth one independent square, if components are normal with mean zero.

    The squares then have the square of the vectors' correlation, which a short run tells far better than that of the
    squares themselves. It is summed down to 0.1 of the vectors' correlation.
    """
    products = mean_products(vectors, len(vectors) - 1)
    correlation = products / products[0]
    low = np.flatnonzero(correlation < 0.1)
    return float(1 + 2 * (correlation[1 : low[0] if low.size else None] ** 2).sum())


def vaporization_enthalpy(potential: Estimate, temperature: float, molecules: int) -> Estimate:
    """Enthalpy of vaporization of rigid molecules to an ideal gas, kJ/mol.

    The gas has no potential energy, and the volume of the liquid is neglected. No correction for the polarization of
    the liquid is added: SPC/E, TIP4P/2005 and others were parametrized with one.

    Args:
        potential: mean of the potential energy of the liquid, kJ/mol.
        temperature: K.
        molecules: their number.
    """
    per_molecule = potential.times(-1 / molecules)
    return per_molecule._replace(value=GAS_CONSTANT * temperature + per_molecule.value)


def maximum_of_pairs(distances: np.ndarray, pairs_by_frame: np.ndarray) -> tuple[Estimate, Estimate]:
    """The highest maximum of a pair distribution, the first in water: its height, and its distance in nm.

    Args:
        distances: (b,), nm, middles of bins.
        pairs_by_frame: (k, b), pair distributions of frames in the order of time.

    Returns:
        Errors are from the scatter between parts of the run; values are NaN where there is no maximum.
    """

    def found(kept: np.ndarray) -> tuple[float, float]:
        return _fitted_maximum(distances, pairs_by_frame[kept].mean(axis=0))

    n = len(pairs_by_frame)
    return jackknife(lambda kept: found(kept)[0], n, PARTS), jackknife(lambda kept: found(kept)[1], n, PARTS)


def _fitted_maximum(distances: np.ndarray, pairs: np.ndarray) -> tuple[float, float]:
    smooth = np.convolve(pairs, np.full(SMOOTHED, 1 / SMOOTHED), "same")
    top = int(smooth.argmax())
    low = np.flatnonzero(smooth < FITTED * smooth[top])
    begin, end = low[low < top].max(initial=-1) + 1, low[low > top].min(initial=len(pairs))
    if end - begin < 5:
        return math.nan, math.nan
    # The number of pairs in a bin, and so the weight of its height, grows with the square of the distance.
    x, y = distances[begin:end], pairs[begin:end]
    cubic = np.polynomial.Polynomial.fit(x, y, 3, w=x)
    for place in cubic.deriv().roots():
        if np.isreal(place) and x[0] <= place.real <= x[-1] and cubic.deriv(2)(place.real) < 0:
            return float(cubic(place.real)), float(place.real)
    return math.nan, math.nan


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
    return (sums / (n - np.arange(n)) - 2 * mean_products(centres, n - 1)) / centres.shape[1]


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
    return mean_and_error(slopes).times(NM2_PER_PS / 6)


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
        correlation = np.stack([mean_products(component, lags) for component in part.T])
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
    return of_independent(viscosity_integrals(tensors, interval, volume, temperature, last)[:, -1])


def viscosity_tail(
    tensors: np.ndarray, interval: float, volume: float, temperature: float, last: float = MEMORY
) -> Estimate:
    """The part of `shear_viscosity` from the second half of the integral, mPa s: zero where `last` is late enough."""
    integrals = viscosity_integrals(tensors, interval, volume, temperature, last)
    return of_independent(integrals[:, -1] - integrals[:, integrals.shape[1] // 2])


def without_finite_size(diffusion: Estimate, temperature: float, edge: float, viscosity: float | Estimate) -> Estimate:
    """Coefficient of self-diffusion of an infinite liquid from that in a cubic box, both in 10^-9 m^2/s.

    Args:
        diffusion: in the box.
        temperature: K.
        edge: of the box, nm.
        viscosity: of the same model, mPa s; its error, if it has one, is propagated.

    Source: Yeh and Hummer, J. Phys. Chem. B 108, 15873 (2004), Eq. 12.
    """
    value, error = viscosity[:2] if isinstance(viscosity, Estimate) else (viscosity, 0.0)
    eta = value / KJ_PER_NM3_PS
    shift = YEH_HUMMER * GAS_CONSTANT * temperature / (6 * math.pi * eta * edge) * NM2_PER_PS
    return diffusion._replace(value=diffusion.value + shift, error=math.hypot(diffusion.error, shift * error / value))


def orientation_correlation(directions: np.ndarray, longest: int) -> np.ndarray:
    """<P2(u(0) u(t))> over molecules and origins, (longest + 1,), by the number of frames in between.

    Args:
        directions: (n, m, 3), unit vectors.
        longest: number of frames, less than n.
    """
    products = directions[..., [0, 1, 2, 0, 0, 1]] * directions[..., [0, 1, 2, 1, 2, 2]]
    products *= np.array([1, 1, 1, *[math.sqrt(2)] * 3])
    return 1.5 * mean_products(products, longest) / products.shape[1] - 0.5


def rotation_time(directions: np.ndarray, interval: float, parts: int = PARTS) -> Estimate:
    """Integral of <P2>, ps: by trapezoids as long as it is above 0.1, and the exponential tail that follows from there.

    Args:
        directions: (n, m, 3), unit vectors fixed in molecules.
        interval: ps between frames.
        parts: of the run, whose scatter gives the error.

    Raises:
        TooShortError: the correlation does not fall below 0.1 in half of a part of the run, or falls in three frames.
    """
    longest = len(directions) // parts // 2
    if longest > 2:
        found = np.array([orientation_correlation(part, longest) for part in np.array_split(directions, parts)])
        times = jackknife(lambda kept: _decay_time(found[kept].mean(axis=0), interval), parts)
        if math.isfinite(times.value):
            return times
    raise TooShortError(
        f"orientations must lose their correlation within {longest * interval:g} ps, and not within three frames, "
        f"{3 * interval:g} ps"
    )


def _decay_time(correlation: np.ndarray, interval: float) -> float:
    """Integral of a correlation that ends exponentially; NaN where it does not fall below 0.1, or too soon."""
    low = np.flatnonzero(correlation < 0.1)
    if not low.size or low[0] < 3:
        return math.nan
    # What is below 0.1 may be noise, and negative: the tail follows from the second half of what is above.
    last = int(low[0]) - 1
    begun = last // 2
    fallen = math.log(correlation[begun] / correlation[last])
    tail = correlation[last] * (last - begun) * interval / fallen if fallen > 0 else math.nan
    return interval * float(correlation[: last + 1].sum() - 0.5 * (correlation[0] + correlation[last])) + tail
