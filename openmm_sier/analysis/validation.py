"""Convert logs of runs for physical_validation, which tests whether the runs sampled their ensembles.

Kinetic energies of translation, rotation and flexible molecules are separate groups, so that equipartition is tested.
All tests assume independent samples: every g-th row of a log is used, with its statistical inefficiency g.

Sources: Merz and Shirts, PLoS ONE 13, e0202764 (2018); Shirts, J. Chem. Theory Comput. 9, 909 (2013).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.correlation import inefficiency
from openmm_sier.observe.conservation import TEMPERATURES

#: Columns of the log with the temperature of each group.
GROUPS = dict(zip(("translation", "rotation", "flexible molecules"), TEMPERATURES, strict=True))


def independent(*series: np.ndarray) -> np.ndarray:
    """Return every g-th sample of k series (n,), with g the largest statistical inefficiency among them; (k, n/g)."""
    every = math.ceil(max(inefficiency(values) for values in series))
    return np.array(series)[:, ::every]


def kinetic_data(logs: Sequence[Mapping[str, np.ndarray]], temperature: float) -> dict[str, Any]:
    """Return kinetic energies by group, for `physical_validation.kinetic_energy.distribution`.

    Degrees of freedom are derived from the logs: the kinetic energy of all motion is linear in the temperatures, and
    the coefficients are half the degrees of freedom times the gas constant.

    Args:
        logs: columns of each run at this temperature, from `openmm-sier run` or `ConservationReporter`.
        temperature: temperature of the ensemble, K.

    Returns:
        A `SimulationData` for each group in the logs.

    Raises:
        ValueError: a log has too few rows for its degrees of freedom.
        ModuleNotFoundError: physical_validation is not installed.
    """
    groups = [_kinetic_groups(log) for log in logs]
    data = _package().data
    by_group = {}
    for name, (dof, _) in groups[0].items():
        # The package counts the degrees of freedom of atoms minus constraints.
        atoms = math.ceil(dof / 3)
        system = {"natoms": atoms, "nconstraints": 3 * atoms - dof, "mass": np.ones(atoms)}
        energies = np.concatenate([group[name][1] for group in groups])
        by_group[name] = data.SimulationData(
            units=data.UnitData.units("GROMACS"),
            system=data.SystemData(ndof_reduction_tra=0, ndof_reduction_rot=0, **system),
            ensemble=data.EnsembleData("NVT", natoms=1, volume=1.0, temperature=temperature),
            observables=data.ObservableData(kinetic_energy=energies),
        )
    return by_group


def _kinetic_groups(log: Mapping[str, np.ndarray]) -> dict[str, tuple[float, np.ndarray]]:
    """Return degrees of freedom and independent kinetic energies (n,), kJ/mol, of the groups in a log."""
    names = [name for name, column in GROUPS.items() if column in log and not np.isnan(log[column]).all()]
    temperatures = np.array([log[GROUPS[name]] for name in names])
    kinetic = np.asarray(log["Kinetic Energy (kJ/mole)"])
    if len(kinetic) <= 2 * len(names):
        raise ValueError(f"a log needs more than {2 * len(names)} rows, got {len(kinetic)}")
    halves = np.linalg.lstsq(temperatures.T, kinetic, rcond=None)[0]
    # Groups exchange heat with the same bath: the slowest group determines the distance between samples.
    energies = independent(*(halves[:, None] * temperatures))
    return dict(zip(names, zip((2 * halves / GAS_CONSTANT).tolist(), energies, strict=True), strict=True))


def ensemble_data(logs: Sequence[Mapping[str, np.ndarray]], temperature: float, pressure: float | None = None) -> Any:
    """Return potential energies, and volumes if a pressure is given, for `physical_validation.ensemble.check`.

    Args:
        logs: columns of each run at this state point, from `openmm-sier run` or `ConservationReporter`.
        temperature: temperature of the ensemble, K.
        pressure: pressure of the ensemble, bar; None at constant volume.

    Returns:
        A `SimulationData`.

    Raises:
        ModuleNotFoundError: physical_validation is not installed.
    """
    columns = ["Potential Energy (kJ/mole)"] + ([] if pressure is None else ["Box Volume (nm^3)"])
    samples = np.concatenate([independent(*(np.asarray(log[name]) for name in columns)) for log in logs], axis=1)
    data = _package().data
    state = {"volume": 1.0} if pressure is None else {"pressure": pressure}
    return data.SimulationData(
        units=data.UnitData.units("GROMACS"),
        ensemble=data.EnsembleData("NVT" if pressure is None else "NPT", natoms=1, temperature=temperature, **state),
        observables=data.ObservableData(potential_energy=samples[0], volume=None if pressure is None else samples[1]),
    )


def _package() -> Any:
    try:
        import physical_validation
    except ModuleNotFoundError as error:
        message = "validation needs physical_validation; install it with: pip install 'openmm-sier[validation]'"
        raise ModuleNotFoundError(message) from error
    return physical_validation
