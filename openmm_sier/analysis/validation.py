"""Logs of runs as physical_validation takes them, whose tests then tell whether the runs sampled their ensembles.

Kinetic energies of translation, rotation and flexible molecules are a group each, so that the tests see equipartition.
All tests assume independent samples: one in g is taken of each log, with its statistical inefficiency g.

Sources: Merz and Shirts, PLoS ONE 13, e0202764 (2018); Shirts, J. Chem. Theory Comput. 9, 909 (2013).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.correlation import inefficiency
from openmm_sier.observe.conservation import TEMPERATURES

#: Columns of the log by the group whose temperature they are.
GROUPS = dict(zip(("translation", "rotation", "flexible molecules"), TEMPERATURES, strict=True))


def independent(*series: np.ndarray) -> np.ndarray:
    """Return every g-th sample of k series (n,), with g the largest statistical inefficiency among them; (k, n/g)."""
    every = math.ceil(max(inefficiency(values) for values in series))
    return np.array(series)[:, ::every]


def kinetic_data(logs: Sequence[Mapping[str, np.ndarray]], temperature: float) -> dict[str, Any]:
    """Return kinetic energies by group, for `physical_validation.kinetic_energy.distribution`.

    Degrees of freedom are those from which the temperatures of the logs were computed: the kinetic energy of all motion
    is linear in these temperatures, and its coefficients give the degrees of freedom.

    Args:
        logs: columns of each run at this temperature, from `openmm-sier run` or `ConservationReporter`.
        temperature: K, of the ensemble.

    Returns:
        A `SimulationData` for each group that the logs have.

    Raises:
        ValueError: a log has too few rows to tell its degrees of freedom.
        ModuleNotFoundError: physical_validation is not installed.
    """
    groups = [_kinetic_groups(log) for log in logs]
    data = _package().data
    found = {}
    for name, (dof, _) in groups[0].items():
        # The package takes degrees of freedom as those of atoms less constraints.
        atoms = math.ceil(dof / 3)
        system = {"natoms": atoms, "nconstraints": 3 * atoms - dof, "mass": np.ones(atoms)}
        energies = np.concatenate([group[name][1] for group in groups])
        found[name] = data.SimulationData(
            units=data.UnitData.units("GROMACS"),
            system=data.SystemData(ndof_reduction_tra=0, ndof_reduction_rot=0, **system),
            ensemble=data.EnsembleData("NVT", natoms=1, volume=1.0, temperature=temperature),
            observables=data.ObservableData(kinetic_energy=energies),
        )
    return found


def _kinetic_groups(log: Mapping[str, np.ndarray]) -> dict[str, tuple[float, np.ndarray]]:
    """Return degrees of freedom and independent kinetic energies (n,), kJ/mol, of the groups that a log has."""
    names = [name for name, column in GROUPS.items() if column in log and not np.isnan(log[column]).all()]
    temperatures = np.array([log[GROUPS[name]] for name in names])
    kinetic = np.asarray(log["Kinetic Energy (kJ/mole)"])
    if len(kinetic) <= 2 * len(names):
        raise ValueError(f"a log needs more than {2 * len(names)} rows, got {len(kinetic)}")
    halves = np.linalg.lstsq(temperatures.T, kinetic, rcond=None)[0]
    # Groups exchange heat with the same bath: the slowest of them decides how far samples must be apart.
    kept = independent(*(halves[:, None] * temperatures))
    return dict(zip(names, zip((2 * halves / GAS_CONSTANT).tolist(), kept, strict=True), strict=True))


def ensemble_data(logs: Sequence[Mapping[str, np.ndarray]], temperature: float, pressure: float | None = None) -> Any:
    """Return potential energies, and volumes if a pressure is given, for `physical_validation.ensemble.check`.

    Args:
        logs: columns of each run at this state point, from `openmm-sier run` or `ConservationReporter`.
        temperature: K, of the ensemble.
        pressure: bar; None at constant volume.

    Returns:
        A `SimulationData`.

    Raises:
        ModuleNotFoundError: physical_validation is not installed.
    """
    columns = ["Potential Energy (kJ/mole)"] + ([] if pressure is None else ["Box Volume (nm^3)"])
    kept = np.concatenate([independent(*(np.asarray(log[name]) for name in columns)) for log in logs], axis=1)
    data = _package().data
    state = {"volume": 1.0} if pressure is None else {"pressure": pressure}
    return data.SimulationData(
        units=data.UnitData.units("GROMACS"),
        ensemble=data.EnsembleData("NVT" if pressure is None else "NPT", natoms=1, temperature=temperature, **state),
        observables=data.ObservableData(potential_energy=kept[0], volume=None if pressure is None else kept[1]),
    )


def _package() -> Any:
    try:
        import physical_validation
    except ModuleNotFoundError as error:
        message = "validation needs physical_validation; install it with: pip install 'openmm-sier[validation]'"
        raise ModuleNotFoundError(message) from error
    return physical_validation
