"""What a run tells about itself: the rows of its log, and the table at its end."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from openmm import unit

from openmm_sier.context.langevin import SIERLangevinIntegrator
from openmm_sier.dynamics.bodies import GAS_CONSTANT
from openmm_sier.studies.console import duration

#: Degrees of freedom that a centre of mass at rest takes. A heat bath sets it in motion.
REMOVED = {False: 3, True: 0}

COLUMNS = (
    "step",
    "time_ps",
    "potential_kJ_per_mol",
    "kinetic_kJ_per_mol",
    "total_kJ_per_mol",
    "conserved_kJ_per_mol",
    "T_K",
    "T_trans_K",
    "T_rot_K",
    "momentum_dalton_nm_per_ps",
    "volume_nm3",
)

BLOCKS = 10

#: A dalton per nm^3 in g/cm^3.
GRAMS_PER_CM3 = 1 / 602.214076


def row(context, integrator) -> tuple[float, ...]:
    """Values of `COLUMNS` at the last completed step. Costs one evaluation of the energy.

    What is conserved is the total energy less the heat that a heat bath gave.
    """
    removed = REMOVED[isinstance(integrator, SIERLangevinIntegrator)]
    observed = context.getState(energy=True)
    bodies, state = integrator.bodies, integrator.getBodyState()
    potential = observed.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    kinetic = sum(bodies.kinetic_energies(state))
    freedoms = bodies.degrees_of_freedom - removed
    return (
        observed.getStepCount(),
        observed.getTime().value_in_unit(unit.picosecond),
        potential,
        kinetic,
        potential + kinetic,
        potential + kinetic - state.heat,
        2 * kinetic / (freedoms * GAS_CONSTANT) if freedoms > 0 else math.nan,
        *bodies.temperatures(state, removed),
        float(np.linalg.norm(bodies.total_momenta(state)[0])),
        observed.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3),
    )


@dataclass(frozen=True)
class Cost:
    """Wall time of the steps of one run, without that of its files.

    Attributes:
        steps: number of them.
        seconds: that they took.
        force_seconds: of these, spent in evaluations of forces, and of energies for moves of the volume.
        evaluations: force evaluations that the integrator counted.
        measured: force evaluations of which `force_seconds` has the time.
        ps: length of a step.
    """

    steps: int
    seconds: float
    force_seconds: float
    evaluations: int
    measured: int
    ps: float

    def rows(self) -> list[tuple[str, str]]:
        if not self.steps or not self.seconds:
            return []
        share = (1 - self.force_seconds / self.seconds) * 100
        return [
            ("wall time per step", duration(self.seconds / self.steps)),
            ("force evaluations per step", f"{self.evaluations / self.steps:.2f}"),
            ("time outside the force", f"{share:.1f} %" if self.measured == self.evaluations else "not measured"),
            ("speed of the integration", f"{self.steps * self.ps / 1000 / self.seconds * 86400:.2f} ns/day"),
        ]


def conservation_rows(log: dict[str, np.ndarray], has_bath: bool) -> list[tuple[str, str]]:
    """Names and values for the table at the end, from the columns of a log.

    rms(X) is the root mean square deviation from the mean (van Zon and Schofield 2007, section IV). H is the total
    energy, less the heat that a heat bath gave.

    Args:
        log: columns.
        has_bath: whether there is a heat bath, so that the conserved energy is not the total energy.
    """
    H, V, t = log["conserved_kJ_per_mol"], log["potential_kJ_per_mol"], log["time_ps"]
    momentum = log["momentum_dalton_nm_per_ps"]
    slope = np.polyfit(t - t.mean(), H, 1)[0] if len(t) > 2 else math.nan
    return [
        (
            "drift of energy less heat" if has_bath else "energy drift",
            _with_unit(slope, "+.3g", "kJ/mol/ps"),
        ),
        ("energy fluctuation rms(H)", _with_unit(H.std(), ".3g", "kJ/mol")),
        ("rms(H)/rms(V)", _with_unit(100 * H.std() / V.std() if V.std() > 0 else math.nan, ".3g", "%")),
        ("T_trans", _mean_and_error(log["T_trans_K"], ".1f", "K")),
        ("T_rot", _mean_and_error(log["T_rot_K"], ".1f", "K")),
        ("total momentum, first and last", f"{momentum[0]:.2g}, {momentum[-1]:.2g} dalton nm/ps"),
    ]


def density_rows(log: dict[str, np.ndarray], system) -> list[tuple[str, str]]:
    """The density, for the table at the end of a run at constant pressure."""
    mass = sum(system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles()))
    return [("density", _mean_and_error(mass / log["volume_nm3"] * GRAMS_PER_CM3, ".4f", "g/cm3"))]


def _with_unit(value: float, form: str, name: str) -> str:
    return "-" if math.isnan(value) else f"{value:{form}} {name}"


def _mean_and_error(values: np.ndarray, form: str, name: str) -> str:
    """Mean and its standard error from block averages, in a unit."""
    if np.isnan(values).any():
        return "-"
    if len(values) < 2 * BLOCKS:
        return f"{values.mean():{form}} {name}"
    means = [block.mean() for block in np.array_split(values, BLOCKS)]
    return f"{values.mean():{form}} ± {np.std(means, ddof=1) / math.sqrt(BLOCKS):{form}} {name}"
