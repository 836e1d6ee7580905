"""A water molecule in a uniform field: conservation of energy and of L_z (van Zon and Schofield 2007, Table 1).

The paper does not say how long its runs were nor how it averaged. Here an ensemble of molecules, canonical at 297 K,
each alone in the field, runs for a few ps from the same initial states with every method.

- Energy: rms(H)/rms(V) along each trajectory, and the mean of this ratio over the ensemble. The ratio of the
  ensemble's mean rms values is nearly the same; the median is much smaller, since the error grows steeply with |L|.
- L_z: the rms over trajectories and ensemble of L_z - <L_z>, over <|L_z|>. Only SEJ4 does not conserve L_z. Its error
  comes from few molecules, so it would be several times smaller as a mean over trajectories than as a root mean square,
  and it grows slowly with the length of the run.

The field does not lie along a coordinate axis. If it did, the third component of every torque would be zero, and every
map that conserves L in free rotation would keep L_z constant to the last bit; as it is, rounding shows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd

from openmm_sier.analysis.statistics import Estimate, jackknife
from openmm_sier.dynamics import operators
from openmm_sier.dynamics.bodies import BodyState
from openmm_sier.dynamics.vectors import body_frame
from studies import text
from studies.methods import PAPER, OwnMethod
from studies.paper import published, tip4p
from studies.paper.published import FS
from studies.records import Record
from studies.report import SILENT, Report

#: One debye times one MV/m in kJ/mol: 1e-21/299792458 C m (CODATA), 1e6 V/m, the Avogadro constant.
DEBYE_MV_PER_M = 1e-21 / 299792458 * 1e6 * 6.02214076e23 / 1e3

#: The paper's z axis in the lab frame of the computation.
Z = np.array([1.0, 2.0, 2.0]) / 3


@dataclass(frozen=True)
class DipoleSettings:
    """Parameters of the experiment.

    Attributes:
        dipole: D.
        field: MV/m.
        temperature: of the initial states, K.
        force_steps_fs: h/f, fs.
        span: length of a trajectory, ps.
        bodies: number of trajectories.
        seed: of the initial states.
    """

    dipole: float = 1.84
    field: float = 2.7
    temperature: float = 297.0
    force_steps_fs: tuple[float, ...] = (4.2, 11.0, 21.0)
    span: float = 3.0
    bodies: int = 20000
    seed: int = 1


QUICK = DipoleSettings(bodies=2000)


ENERGY = {
    "h/f (fs)": "{force_step_fs:g}",
    "method": "{method}",
    "paper": "{paper}",
    "mean of ratios": "{ours}",
    "ratio": "{ratio}",
    "ratio of means": "{energy_of_means:.3g}",
    "median": "{energy_median:.3g}",
}

MOMENTUM = {
    "h/f (fs)": "{force_step_fs:g}",
    "method": "{method}",
    "paper": "{paper}",
    "root mean square": "{momentum:.2g}",
    "ratio": "{ratio}",
    "mean rms": "{momentum_of_means:.2g}",
    "median ratio": "{momentum_median:.2g}",
}


def find(settings: DipoleSettings, report: Report = SILENT) -> Record:
    """Carry out the experiment.

    Returns:
        A row for each method and `force_step_fs`, of which the step is f times as long, with the averages that the
        paper may have meant. In per cent: `energy`, the mean over trajectories of rms(H)/rms(V), with its standard
        error, `energy_of_means`, the mean of rms(H) over the mean of rms(V), and `energy_median`. And `momentum`, the
        root of the mean square of L_z - <L_z> over the mean of |L_z|, with its standard error, `momentum_of_means`, the
        mean over trajectories of rms(L_z), over the mean of |L_z|, and `momentum_median`, that of rms(L_z)/|<L_z>|.
    """
    runs = [(method, step) for step in settings.force_steps_fs for method in PAPER]
    rows = []
    with report.progress("dipole in a field", len(runs)) as advance:
        for number, (method, step) in enumerate(runs):
            advance(number, f"dipole in a field: {method.name}, h/f = {step:g} fs")
            rows.append({"method": method.name, "force_step_fs": step} | _averages(*_spreads(method, step, settings)))
        advance(len(runs))
    return Record(asdict(settings), {"rows": pd.DataFrame(rows)}, {})


class Field:
    """Potential and torque of point dipoles that are fixed in bodies, in a uniform field along `Z`."""

    def __init__(self, dipole_energy: float, direction: np.ndarray):
        """
        Args:
            dipole_energy: dipole moment times field, kJ/mol.
            direction: of the dipole in the body frame, (3,).
        """
        self._body_vector = dipole_energy * direction

    def _lab_vector(self, A: np.ndarray) -> np.ndarray:
        x, y, z = self._body_vector
        return x * A[0] + y * A[1] + z * A[2]

    def potential(self, A: np.ndarray) -> np.ndarray:
        """-mu . E, (n,), kJ/mol."""
        return -(Z @ self._lab_vector(A))

    def forces(self, q: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """No force, and the torque mu x E, kJ/mol."""
        x, y, z = self._lab_vector(A)
        return np.zeros_like(q), np.stack([y * Z[2] - z * Z[1], z * Z[0] - x * Z[2], x * Z[1] - y * Z[0]])


class Spread:
    """Mean and rms deviation of a quantity along each trajectory.

    Sums are over deviations from the first value, so that they do not lose digits of a quantity that hardly changes.
    """

    def __init__(self, first: np.ndarray) -> None:
        self._first, self._sum, self._squares, self._count = first, 0 * first, 0 * first, 0

    def add(self, value: np.ndarray) -> None:
        change = value - self._first
        self._sum = self._sum + change
        self._squares = self._squares + change * change
        self._count += 1

    @property
    def mean(self) -> np.ndarray:
        return self._first + self._sum / self._count

    @property
    def rms(self) -> np.ndarray:
        mean = self._sum / self._count
        return np.sqrt(np.maximum(self._squares / self._count - mean * mean, 0.0))


def _spreads(method: OwnMethod, force_step_fs: float, settings: DipoleSettings) -> list[Spread]:
    """Spreads of total energy, potential energy and L_z."""
    bodies = tip4p.molecules(settings.bodies)
    state = tip4p.canonical_rotation(bodies, settings.temperature, np.random.default_rng(settings.seed))
    field = Field(settings.dipole * settings.field * DEBYE_MV_PER_M, tip4p.dipole_direction(bodies))
    h = force_step_fs * method.forces * FS
    flows = operators.body_operators(bodies, field.forces, method.rotation)
    step = operators.stepper(method.scheme, flows, h)

    def observe(state: BodyState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        potential = field.potential(state.A)
        rotation = 0.5 * (body_frame(state.A, state.L) ** 2 * bodies.inverse_moments).sum(axis=0)
        return rotation + potential, potential, Z @ state.L

    spreads = [Spread(value) for value in observe(state)]
    for _ in range(round(settings.span / h) + 1):
        for spread, value in zip(spreads, observe(state), strict=True):
            spread.add(value)
        state = step(state)
    return spreads


def _averages(energy: Spread, potential: Spread, momentum: Spread) -> dict[str, float]:
    n = energy.rms.size
    ratio = 100 * energy.rms / potential.rms
    size = np.abs(momentum.mean)
    variance, rms = momentum.rms**2, momentum.rms
    value, error, _ = jackknife(lambda sample: float(ratio[sample].mean()), n)
    Lz, Lz_error, _ = jackknife(lambda sample: float(np.sqrt(variance[sample].mean()) / size[sample].mean()), n)
    return {
        "energy": value,
        "energy_error": error,
        "energy_of_means": float(100 * energy.rms.mean() / potential.rms.mean()),
        "energy_median": float(np.median(ratio)),
        "momentum": Lz,
        "momentum_error": Lz_error,
        "momentum_of_means": float(rms.mean() / size.mean()),
        "momentum_median": float(np.median(rms / size)),
    }


# --- as text ---


def tables(record: Record) -> dict[str, pd.DataFrame]:
    """Return both halves of Table 1 as text, by their titles, with the paper's values and ours."""
    settings, rows = record.settings, record.tables["rows"]
    what = (
        f"{settings['dipole']:g} D in {settings['field']:g} MV/m, {settings['bodies']} runs of {settings['span']:g} ps"
    )
    energy = _beside(rows, "energy", published.ENERGY, lambda value, error: str(Estimate(value, error)))
    momentum = _beside(rows, "momentum", published.MOMENTUM, lambda value, error: f"{value:.2g}")
    return {
        f"Table 1, energy: rms(H)/rms(V) in %, {what}": text.table(energy, ENERGY),
        "Table 1, angular momentum along the field: rms(L_z)/<|L_z|>": text.table(momentum, MOMENTUM),
    }


def _beside(rows: pd.DataFrame, name: str, of_paper: dict, comparison: Callable[[float, float], str]) -> pd.DataFrame:
    """Rows with a quantity as text, the paper's, and the ratio of both."""
    columns = []
    for row in rows.to_dict("records"):
        paper = of_paper.get((row["method"], row["force_step_fs"]))
        row["ours"] = comparison(row[name], row[f"{name}_error"])
        row["paper"] = "-" if paper is None else comparison(*paper)
        columns.append(row | {"ratio": published.ratio(row[name], None if paper is None else paper[0])})
    return pd.DataFrame(columns)
