"""Defaults of a run that follow from other settings, and how `--help` describes them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from openmm_sier.cli.methods import FRICTION, HEAVY_FRICTION, METHODS, is_heavy
from openmm_sier.dynamics.acceptance import TRIAL_FRICTION, usual_steps

#: The default scheme of each ensemble, by its name for `--scheme`.
RECOMMENDED = {"nve": "sier4g", "nvt": "sier2", "npt": "sier2", "hmc": "sier2v2"}

#: K; the temperature of the systems that come with the project.
TEMPERATURE = 297.0

#: ps; the length of a run.
TIME = 10.0

#: Values of earlier settings, by name, from which a default follows.
Earlier = Mapping[str, Any]


def listed(meanings: Mapping[str, str]) -> str:
    """Return names with their meanings, for `--help`."""
    return "; ".join(f"{name}: {meaning}" for name, meaning in meanings.items())


def motion_of(ensemble: str, thermostat: str) -> str:
    """Return the ensemble whose schemes and steps apply: between rescalings the energy is constant."""
    return "nve" if ensemble in ("nvt", "npt") and thermostat == "rescaling" else ensemble


def steps_in(time: float, dt: float) -> int:
    """Return the number of steps of `dt` fs in a time in ps, at least 1."""
    return max(1, round(time * 1000 / dt))


def scheme(earlier: Earlier) -> str:
    """Return the recommended scheme of the ensemble."""
    return RECOMMENDED[motion_of(earlier["ensemble"], earlier["thermostat"])]


def step(earlier: Earlier) -> float:
    """Return the usual step of the scheme, fs."""
    motion = motion_of(earlier["ensemble"], earlier["thermostat"])
    return METHODS[earlier["scheme"]].usual_step(motion, earlier["hydrogen_mass"])


def friction(earlier: Earlier) -> float:
    """Return the usual friction, 1/ps."""
    if earlier["ensemble"] == "hmc":
        return TRIAL_FRICTION
    has_long_steps = is_heavy(earlier["hydrogen_mass"]) and earlier["thermostat"] == "langevin"
    return HEAVY_FRICTION if has_long_steps else FRICTION


def pressure(earlier: Earlier) -> float | None:
    """Return the default pressure, bar; None at constant volume."""
    return 1.0 if earlier["ensemble"] == "npt" else None


def steps_per_trial(earlier: Earlier) -> int:
    """Return the number of steps of a usual trial of hybrid Monte Carlo; 1 in other ensembles."""
    return usual_steps(earlier["dt"] / 1000) if earlier["ensemble"] == "hmc" else 1


def steps(earlier: Earlier) -> int:
    """Return the number of steps in the time of the run."""
    return steps_in(earlier["time"] or TIME, earlier["dt"] * earlier["steps_per_trial"])


def out(earlier: Earlier) -> Path:
    """Return the default trajectory of a run, after which its other files are named."""
    return Path(f"{earlier['box'].stem}.dcd")


def report(earlier: Earlier) -> Path:
    """Return the default log of a run."""
    trajectory: Path = earlier["out"]
    return trajectory.with_suffix(".csv")
