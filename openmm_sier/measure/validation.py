"""Whether runs sampled their ensembles, by the tests of the package physical_validation: distances in standard errors.

- Kinetic energies of translation, rotation and flexible molecules, each a group of its own: their mean and width
  (`distribution(strict=False)`, errors by bootstrap) and their whole distribution (`strict=True`, the test of
  Kolmogorov and Smirnov, its probability turned into standard errors of a normal distribution). Together these test
  equipartition.
- Potential energy, enthalpy or volume of two runs that differ in temperature or pressure: the logarithm of the ratio of
  their probabilities is a straight line whose slope is known, whatever the system (`ensemble.check`).

All assume independent samples: one sample in g is taken of each series, with its statistical inefficiency g.

Sources: Merz and Shirts, PLoS ONE 13, e0202764 (2018); Shirts, J. Chem. Theory Comput. 9, 909 (2013).
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.statistics import inefficiency, is_constant
from openmm_sier.measure.observables import blocks, fluctuation_within_1_ps
from openmm_sier.measure.statistics import FEWEST, Estimate, of_independent
from openmm_sier.observe.conservation import TEMPERATURES

#: Standard errors beyond which a check fails. By chance, one number in 16000 lies so far out.
LIMIT = 4.0

#: Seed of the bootstrap, so that the same runs have the same verdict.
BOOTSTRAP_SEED = 5

#: Fraction by which a ratio of fluctuations may be off at finite steps. Terms of the next order are (w h)^2/12 of it,
#: 4 % for the librations of water at 2 fs.
NEXT_ORDER = 0.1

#: Columns of the log by the group whose temperature they are.
GROUPS = dict(zip(("translation", "rotation", "flexible molecules"), TEMPERATURES, strict=True))


class TooFewError(ValueError):
    """There are too few independent samples for a check, or distributions that must overlap do not."""


class Group(NamedTuple):
    """Kinetic energies that share the heat equally.

    Attributes:
        name: of the group.
        dof: its degrees of freedom.
        energies: (n,), kJ/mol, independent.
    """

    name: str
    dof: float
    energies: np.ndarray


class Sampled(NamedTuple):
    """Independent samples of runs at one temperature and pressure.

    Attributes:
        temperature: K.
        pressure: bar; None at constant volume.
        groups: kinetic energies.
        potential: (m,), kJ/mol.
        volume: (m,), nm^3, at the same moments; None at constant volume.
    """

    temperature: float
    pressure: float | None
    groups: tuple[Group, ...]
    potential: np.ndarray
    volume: np.ndarray | None


class Verdict(NamedTuple):
    """One check.

    Attributes:
        check: its name.
        distance: from what statistical mechanics demands, standard errors.
        samples: number of independent ones.
        detail: what was found, and expected.
    """

    check: str
    distance: float
    samples: int
    detail: str


def independent(*series: np.ndarray) -> np.ndarray:
    """One sample in g of k series (n,), with g the largest statistical inefficiency among them; (k, n/g)."""
    every = math.ceil(max(inefficiency(values) for values in series))
    return np.array(series)[:, ::every]


def sampled(logs: Sequence[Mapping[str, np.ndarray]], temperature: float, pressure: float | None) -> Sampled:
    """Independent samples from logs of `openmm-sier run`, or of `ConservationReporter`, at one state point.

    Args:
        logs: columns of each run.
        temperature: K, of the ensemble.
        pressure: bar; None at constant volume.
    """
    columns = ["Potential Energy (kJ/mole)"] + ([] if pressure is None else ["Box Volume (nm^3)"])
    found: dict[str, list[Group]] = {}
    for log in logs:
        groups = kinetic_groups(log)
        # Groups exchange heat with the same bath: the slowest of them decides how far samples must be apart.
        kept = independent(*(group.energies for group in groups))
        for group, energies in zip(groups, kept, strict=True):
            found.setdefault(group.name, []).append(group._replace(energies=energies))
    together = tuple(
        parts[0]._replace(energies=np.concatenate([p.energies for p in parts])) for parts in found.values()
    )
    ends = np.concatenate([independent(*(log[name] for name in columns)) for log in logs], axis=1)
    return Sampled(temperature, pressure, together, ends[0], None if pressure is None else ends[1])


def kinetic_groups(log: Mapping[str, np.ndarray]) -> list[Group]:
    """Kinetic energies (n,) of all rows of a log by group.

    Degrees of freedom are those from which the log's temperatures were computed: the kinetic energy of all motion is
    linear in these temperatures, and its coefficients give the degrees of freedom.
    """
    names = [name for name, column in GROUPS.items() if column in log and not np.isnan(log[column]).all()]
    temperatures = np.array([log[GROUPS[name]] for name in names])
    kinetic = log["Kinetic Energy (kJ/mole)"]
    if len(kinetic) <= 2 * len(names):
        raise TooFewError(f"a log of {len(kinetic)} rows is too short")
    halves = np.linalg.lstsq(temperatures.T, kinetic, rcond=None)[0]
    return [
        Group(name, 2 * half / GAS_CONSTANT, half * values)
        for name, half, values in zip(names, halves.tolist(), temperatures, strict=True)
    ]


# --- kinetic energies ---


def kinetic_verdicts(sample: Sampled) -> list[Verdict]:
    """Mean, width and shape of the kinetic energies of each group.

    Raises:
        TooFewError: fewer than `FEWEST` independent samples.
    """
    pv, found = _package(), []
    for group in sample.groups:
        n = len(group.energies)
        if n < FEWEST:
            raise TooFewError(f"{group.name} has {n} independent samples, {FEWEST} are needed: longer runs, or more")
        # The package takes degrees of freedom as those of atoms less constraints.
        atoms = math.ceil(group.dof / 3)
        system = {"natoms": atoms, "nconstraints": 3 * atoms - group.dof, "mass": np.ones(atoms)}
        data = pv.data.SimulationData(
            units=pv.data.UnitData.units("GROMACS"),
            system=pv.data.SystemData(ndof_reduction_tra=0, ndof_reduction_rot=0, **system),
            ensemble=pv.data.EnsembleData("NVT", natoms=1, volume=1.0, temperature=sample.temperature),
            observables=pv.data.ObservableData(kinetic_energy=group.energies),
        )
        options: dict[str, Any] = {"data_is_uncorrelated": True, "bootstrap_seed": BOOTSTRAP_SEED, "verbosity": 0}
        mean, width = pv.kinetic_energy.distribution(data, strict=False, **options)
        probability = pv.kinetic_energy.distribution(data, strict=True, **options)
        scale = 2 / (group.dof * GAS_CONSTANT)
        # For given degrees of freedom, the width of the distribution is proportional to the temperature.
        by_mean = f"T = {scale * group.energies.mean():.1f} K, {sample.temperature:g} K expected"
        by_width = f"T = {math.sqrt(2 / group.dof) / GAS_CONSTANT * group.energies.std():.1f} K by the width"
        found += [
            Verdict(f"{group.name}: mean kinetic energy", float(mean), n, by_mean),
            Verdict(f"{group.name}: width of its distribution", float(width), n, by_width),
            Verdict(
                f"{group.name}: its shape", errors_of(probability), n, f"Kolmogorov-Smirnov: p = {probability:.2g}"
            ),
        ]
    return found


def errors_of(probability: float) -> float:
    """Standard errors of a normal distribution beyond which this probability lies, on both sides together."""
    from scipy.special import ndtri

    return float(-ndtri(max(probability, 1e-300) / 2))


# --- ensembles ---


def ensemble_verdict(one: Sampled, two: Sampled) -> Verdict:
    """Whether the distributions of two runs that differ in temperature or in pressure have the right ratio.

    Raises:
        ValueError: they differ in both, or in neither.
        TooFewError: there are fewer than `FEWEST` independent samples, or the distributions do not overlap.
    """
    pv = _package()
    temperatures, pressures = (one.temperature, two.temperature), (one.pressure, two.pressure)
    pressed = pressures[0] != pressures[1]
    if pressed == (temperatures[0] != temperatures[1]):
        raise ValueError(f"two runs must differ in temperature or pressure, got {temperatures} K and {pressures} bar")
    _refuse_few(min(len(one.potential), len(two.potential)))
    quantity = "volume" if pressed else "potential energy" if one.pressure is None else "enthalpy"
    values, unit, interval = (pressures, "bar", "dP") if pressed else (temperatures, "K", "dT")
    check = f"{quantity} at {values[0]:g} and {values[1]:g} {unit}"
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            quantiles = pv.ensemble.check(
                _data(pv, one), _data(pv, two), verbosity=0, data_is_uncorrelated=True, bootstrap_seed=BOOTSTRAP_SEED
            )
    except pv.util.error.InputError as error:
        raise TooFewError(f"{check}: {error.message}") from error
    best = suggested_interval(one).get(interval, math.nan)
    detail = f"slope of ln(P2/P1); the best interval is {best:.3g} {unit}"
    return Verdict(check, abs(float(quantiles[0])), len(one.potential) + len(two.potential), detail)


def suggested_interval(sample: Sampled) -> dict[str, float]:
    """Intervals of temperature (dT, K) and pressure (dP, bar) to the most telling second run, two widths apart.

    There is none of temperature where the energy is constant, and none of pressure where the volume is.

    Raises:
        TooFewError: fewer than `FEWEST` independent samples, whose widths tell nothing.
    """
    _refuse_few(len(sample.potential))
    pv = _package()
    with contextlib.redirect_stdout(io.StringIO()):
        found = pv.ensemble.estimate_interval(_data(pv, sample), verbosity=0, data_is_uncorrelated=True)
    widths = {"dT": sample.potential, "dP": sample.volume}
    return {name: found[name] for name, values in widths.items() if values is not None and not is_constant(values)}


def _refuse_few(samples: int) -> None:
    if samples < FEWEST:
        raise TooFewError(f"there are {samples} independent samples, {FEWEST} are needed: longer runs, or more")


def _data(pv: Any, sample: Sampled) -> Any:
    if sample.pressure is None:
        ensemble = pv.data.EnsembleData("NVT", natoms=1, temperature=sample.temperature, volume=1.0)
    else:
        ensemble = pv.data.EnsembleData("NPT", natoms=1, temperature=sample.temperature, pressure=sample.pressure)
    observables = pv.data.ObservableData(potential_energy=sample.potential, volume=sample.volume)
    return pv.data.SimulationData(pv.data.UnitData.units("GROMACS"), ensemble=ensemble, observables=observables)


# --- the order of the integrator ---


def fluctuation(logs: Sequence[Mapping[str, np.ndarray]]) -> Estimate:
    """rms of the conserved energy within 1 ps of runs at constant energy, kJ/mol; over longer times it walks."""
    squares = []
    for log in logs:
        time, energy = (blocks(log["Time (ps)"], log[name]) for name in ("Time (ps)", "Conserved Energy (kJ/mole)"))
        squares += [fluctuation_within_1_ps(t, e) ** 2 for t, e in zip(time, energy, strict=True)]
    square = of_independent(np.array(squares))
    root = math.sqrt(square.value)
    return Estimate(root, square.error / (2 * root))


def order_verdict(steps: tuple[float, float], fluctuations: tuple[Estimate, Estimate], order: int) -> Verdict:
    """Whether fluctuations of the conserved energy at two steps are in the ratio that the order of a scheme demands.

    physical_validation has this test for second order alone.

    Args:
        steps: fs.
        fluctuations: at these steps.
        order: of the scheme.
    """
    one, two = fluctuations
    expected, ratio = (steps[0] / steps[1]) ** order, one.value / two.value
    error = math.hypot(one.error / one.value, two.error / two.value, NEXT_ORDER)
    detail = f"ratio of fluctuations {ratio:.3g}, {expected:.3g} expected of order {order}"
    return Verdict(f"energy at {steps[0]:g} and {steps[1]:g} fs", abs(math.log(ratio / expected)) / error, 2, detail)


def _package() -> Any:
    try:
        import physical_validation
        import physical_validation.util.error
    except ModuleNotFoundError as error:
        message = "validation needs physical_validation; install it with: pip install 'openmm-sier[validation]'"
        raise ModuleNotFoundError(message) from error
    return physical_validation
