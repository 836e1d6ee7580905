"""Options of `openmm-sier run`, and the plan of the run that follows from them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from openmm_sier.cli.methods import METHODS, RECOMMENDED, Method

#: K; the temperature of the systems that come with the project.
DEFAULT_TEMPERATURE = 297.0

#: Steps in a trial of hybrid Monte Carlo.
TRIAL = 10

#: ps between pressure tensors. Sums over them mistake oscillations of this period, or a fraction of it, for slow ones;
#: in rigid water such oscillations have a thousandth of the power of the slow ones.
TENSOR_EVERY = 0.02

#: Options that a restart takes from its checkpoint.
CONTINUED = (
    "steps_per_trial",
    "ensemble",
    "temperature",
    "friction",
    "pressure",
    "seed",
    "forcefield",
    "rigid",
    "constraints",
    "scheme",
    "dt",
    "every",
    "report_every",
    "checkpoint_every",
    "bodies_every",
    "pressure_tensor_every",
    "unwrapped",
    "out",
    "report",
    "bodies",
    "pressure_tensor",
)

#: Fields of a plan that are files. A checkpoint notes them relative to itself.
FILES = ("out", "report", "bodies", "pressure_tensor", "box")


class RunError(ValueError):
    """The command cannot do what it was asked for."""


class NothingLeft(RunError):
    """The run to be continued is already complete."""

    exit_code = 4


@dataclass(frozen=True)
class Options:
    """Options of the command; None where an option was not given. Times are in ps, but `dt` is in fs."""

    box: Path
    forcefield: list[str] | None = None
    rigid: list[str] | None = None
    constraints: str | None = None
    scheme: str | None = None
    dt: float | None = None
    steps: int | None = None
    time: float | None = None
    temperature: float | None = None
    equilibrate: float | None = None
    minimize: bool | None = None
    out: Path | None = None
    report: Path | None = None
    bodies: Path | None = None
    pressure_tensor: Path | None = None
    every: float | None = None
    report_every: float | None = None
    checkpoint_every: float | None = None
    bodies_every: float | None = None
    pressure_tensor_every: float | None = None
    ensemble: str | None = None
    friction: float | None = None
    pressure: float | None = None
    steps_per_trial: int | None = None
    unwrapped: bool | None = None
    seed: int | None = None
    platform: str | None = None
    start: Path | None = None
    restart: Path | None = None
    overwrite: bool = False

    @property
    def equilibrates(self) -> bool:
        """Whether the run begins with an equilibration. From a checkpoint it does so only if asked to."""
        return self.start is None or bool(self.equilibrate or self.minimize)


@dataclass(frozen=True)
class Plan:
    """Settings that a run and its continuations share; units as in `Options`, friction in 1/ps, pressure in bar.

    Hybrid Monte Carlo is at constant volume where `pressure` is None, and draws momenta anew where `friction` is 0.
    """

    ensemble: str
    temperature: float
    friction: float
    pressure: float | None
    seed: int
    forcefield: list[str] | None
    scheme: str
    dt: float
    steps: int
    every: float
    report_every: float
    checkpoint_every: float
    out: str
    report: str
    rigid: list[str] | None = None
    constraints: str | None = None
    bodies: str | None = None
    bodies_every: float = 0.1
    pressure_tensor: str | None = None
    pressure_tensor_every: float = TENSOR_EVERY
    unwrapped: bool = False
    steps_per_trial: int = 0
    box: str | None = None

    @property
    def moves_volume(self) -> bool:
        """Whether the pressure is constant."""
        return self.ensemble in ("npt", "hmc") and self.pressure is not None

    @property
    def method(self) -> Method:
        """What moves the molecules."""
        return METHODS[self.scheme]

    @property
    def counts_heat(self) -> bool:
        """Whether the conserved energy is known: the heat from OpenMM's own baths is not counted."""
        return self.method.scheme is not None or self.ensemble == "nve"

    @property
    def title(self) -> str:
        """Method, ensemble and step."""
        bath = f", {self.temperature:g} K" if self.ensemble != "nve" else ""
        piston = f", {self.pressure:g} bar" if self.moves_volume else ""
        return f"{self.method.name}, {self.ensemble.upper()}{bath}{piston}, {self.dt:g} fs"

    def interval(self, time: float) -> int:
        """Number of steps nearest to a time, at least 1; whole trials in hybrid Monte Carlo."""
        unit = self.steps_per_trial or 1
        return unit * max(1, round(time * 1000 / self.dt / unit))

    def noted(self, checkpoint: Path) -> dict[str, Any]:
        """The plan as the checkpoint holds it, with files relative to the checkpoint."""
        here = os.path.dirname(checkpoint) or "."
        fields = asdict(self)
        return fields | {name: os.path.relpath(fields[name], here) for name in FILES if fields[name]}


def new_plan(options: Options, origin: dict[str, Any] | None = None) -> Plan:
    """The plan of a new run.

    Args:
        options: of the command.
        origin: plan of the run from whose checkpoint this one starts. It defines the system.

    Raises:
        RunError: options contradict each other.
    """
    origin = origin or {}
    scheme = options.scheme or RECOMMENDED
    method = METHODS[scheme]
    dt = options.dt or method.usual_step
    ensemble = options.ensemble or method.ensembles[0]
    rigid = _first(options.rigid, origin.get("rigid"))
    _check_method(method, ensemble, rigid)
    _check_combinations(options, ensemble)
    out = _file("--out", options.out) or Path(f"{options.box.stem}.dcd")
    report = _file("--report", options.report) or out.with_suffix(".csv")
    bodies = _file("--bodies", options.bodies)
    tensor = _file("--pressure-tensor", options.pressure_tensor)
    every = options.every or 0.1
    return Plan(
        ensemble=ensemble,
        temperature=_first(options.temperature, origin.get("temperature"), DEFAULT_TEMPERATURE),
        friction=_first(options.friction, 0.0 if ensemble == "hmc" else 1.0),
        pressure=_first(options.pressure, None if ensemble == "hmc" else 1.0),
        seed=_first(options.seed, 1),
        forcefield=_first(options.forcefield, origin.get("forcefield")),
        rigid=rigid,
        constraints=_first(options.constraints, origin.get("constraints")),
        scheme=scheme,
        dt=dt,
        steps=_length(options, dt) or round(10_000 / dt),
        every=every,
        report_every=options.report_every or 0.04,
        checkpoint_every=options.checkpoint_every or 1.0,
        bodies_every=options.bodies_every or every,
        out=str(out),
        report=str(report),
        bodies=None if bodies is None else str(bodies),
        pressure_tensor=None if tensor is None else str(tensor),
        pressure_tensor_every=options.pressure_tensor_every or TENSOR_EVERY,
        unwrapped=bool(options.unwrapped),
        steps_per_trial=_first(options.steps_per_trial, TRIAL) if ensemble == "hmc" else 0,
        box=str(options.box),
    )


def _first(*values: Any) -> Any:
    """The first value that is not None, or None."""
    return next((value for value in values if value is not None), None)


def _file(option: str, path: Path | None) -> Path | None:
    if path is not None and (path.is_dir() or not path.name):
        raise RunError(f"{option} {path} is a directory, expected the name of a file")
    return path


def _check_method(method: Method, ensemble: str, rigid: list[str] | None) -> None:
    if ensemble not in method.ensembles:
        raise RunError(f"{method.name} needs --ensemble {_alternatives(method.ensembles)}, got {ensemble}")
    if rigid and method.scheme is None:
        raise RunError(
            f"--rigid {' '.join(rigid)} needs a scheme of this package: {method.name} holds no molecules rigid but by "
            "constraints"
        )


def _alternatives(names: Sequence[str]) -> str:
    return " or ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _check_combinations(options: Options, ensemble: str) -> None:
    if options.start and options.restart:
        raise RunError("--start begins a new run and --restart goes on with an old one: give one of them")
    if options.friction is not None and ensemble == "nve":
        raise RunError("--friction needs --ensemble nvt, npt or hmc")
    if options.pressure is not None and ensemble not in ("npt", "hmc"):
        raise RunError("--pressure needs --ensemble npt or hmc")
    if options.steps_per_trial is not None and ensemble != "hmc":
        raise RunError("--steps-per-trial needs --ensemble hmc")
    if options.bodies_every is not None and options.bodies is None:
        raise RunError("--bodies-every needs --bodies FILE.h5")
    if options.pressure_tensor_every is not None and options.pressure_tensor is None:
        raise RunError("--pressure-tensor-every needs --pressure-tensor FILE.csv")


def _length(options: Options, dt: float) -> int | None:
    return max(1, round(options.time * 1000 / dt)) if options.time is not None else options.steps


def noted_plan(checkpoint: Path, saved: dict[str, Any]) -> Plan:
    """The plan that a checkpoint notes, with paths of files relative to the current directory."""
    beside = {
        name: os.path.normpath(os.path.join(os.path.dirname(checkpoint), saved[name]))
        for name in FILES
        if saved.get(name)
    }
    return Plan(**{**saved, **beside})


def continued_plan(options: Options, checkpoint: Path, saved: dict[str, Any]) -> Plan:
    """The plan of a checkpoint, with another length if one is given.

    Raises:
        RunError: an option contradicts the checkpoint.
    """
    if options.start:
        _check_combinations(options, saved["ensemble"])
    plan = noted_plan(checkpoint, saved)
    for name in CONTINUED:
        given, noted = getattr(options, name), getattr(plan, name)
        given = os.path.normpath(given) if isinstance(given, Path) else given
        if given is not None and given != noted:
            value = " ".join(given) if isinstance(given, list) else given
            option = f"--{name.replace('_', '-')}" + ("" if given is True else f" {value}")
            raise RunError(f"{option} differs from {noted} of {checkpoint}; leave it out")
    longer = {"steps": _length(options, plan.dt) or plan.steps, "box": str(options.box)}
    return Plan(**{**asdict(plan), **longer})
