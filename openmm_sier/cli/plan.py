"""The plan of a run: its options with a value for each, from a command line or from the notes in a checkpoint."""

import os
from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from openmm_sier.cli.methods import FRICTION, HEAVY_FRICTION, METHODS, Method, is_heavy
from openmm_sier.cli.options import CONTINUED, MAY_LACK, NOTED, OF_THE_SYSTEM, OPTIONS, RECOMMENDED, Options
from openmm_sier.cli.values import WrongValueError
from openmm_sier.dynamics.acceptance import usual_steps
from openmm_sier.inputs.forcefields import Interactions
from openmm_sier.inputs.inputs import IGNORED, topology_kind

#: K; the temperature of the systems that come with the project.
DEFAULT_TEMPERATURE = 297.0

#: ps; the length of a run.
DEFAULT_TIME = 10.0

#: Options that name one file each. A checkpoint notes them relative to itself.
FILES = tuple(name for name in NOTED if OPTIONS[name].kind.file and not OPTIONS[name].kind.each)

#: Those of them that a run writes.
OUTPUTS = tuple(name for name in FILES if OPTIONS[name].kind.file == "output")


class RunError(ValueError):
    """The command cannot do what it was asked for."""


class NothingLeft(RunError):
    """The run to be continued is already complete."""

    exit_code = 4


class Plan(Options):
    """Options of a run with all values that it needs.

    Hybrid Monte Carlo is at constant volume where `pressure` is None, and draws momenta anew where `friction` is 0.
    """

    @property
    def moves_volume(self) -> bool:
        """Whether the pressure is constant."""
        return self.ensemble in ("npt", "hmc") and self.pressure is not None

    @property
    def method(self) -> Method:
        """What moves the molecules."""
        return METHODS[self.scheme]

    @property
    def interactions(self) -> Interactions:
        """How the interactions are cut off."""
        return Interactions(self.cutoff, self.switch, self.tolerance, self.hydrogen_mass)

    @property
    def title(self) -> str:
        """Method, ensemble, the mass of hydrogens if it was chosen, and step."""
        bath = f", {self.temperature:g} K" if self.ensemble != "nve" else ""
        piston = f", {self.pressure:g} bar" if self.moves_volume else ""
        hydrogens = f", hydrogens of {self.hydrogen_mass:g}" if self.hydrogen_mass else ""
        return f"{self.method.name}, {self.ensemble.upper()}{bath}{piston}{hydrogens}, {self.dt:g} fs"

    @property
    def step_time(self) -> float:
        """Time of a step, ps; a step of hybrid Monte Carlo is a trial."""
        return self.dt / 1000 * self.steps_per_trial

    def interval(self, time: float) -> int:
        """Number of steps nearest to a time, at least 1."""
        return max(1, round(time / self.step_time))

    def noted(self, checkpoint: Path) -> dict[str, Any]:
        """The plan as the checkpoint holds it, with files relative to the checkpoint."""
        here = os.path.dirname(checkpoint) or "."
        values: dict[str, Any] = {name: getattr(self, name) for name in NOTED}
        values |= {name: os.path.relpath(values[name], here) for name in FILES if values[name]}
        values["forcefield"] = self.forcefield and [str(file) for file in self.forcefield]
        return values


def new_plan(options: Options, origin: Plan | None = None) -> Plan:
    """The plan of a new run.

    Args:
        options: of the command.
        origin: of the run from whose checkpoint this one starts. It defines the System.

    Raises:
        RunError: options contradict each other, or the topology.
        ForceFieldError, OSError: the topology is none, or cannot be read.
    """
    given = {entry.name: value for entry in fields(options) if (value := getattr(options, entry.name)) is not None}
    defaults = {name: option.default for name, option in OPTIONS.items() if option.default is not None}
    if origin is not None:
        defaults |= {name: getattr(origin, name) for name in (*OF_THE_SYSTEM, "temperature")}
    values = {"temperature": DEFAULT_TEMPERATURE, **defaults, **given}
    for name in ignored_options(values.get("topology"), given):
        values[name] = None
    method = METHODS[values.setdefault("scheme", RECOMMENDED[values.get("ensemble", "nve")])]
    ensemble = values.setdefault("ensemble", method.ensembles[0])
    _check_given(options, ensemble)
    values.setdefault("dt", method.usual_step(ensemble, values.get("hydrogen_mass")))
    of_bath = HEAVY_FRICTION if is_heavy(values.get("hydrogen_mass")) else FRICTION
    values.setdefault("friction", 0.0 if ensemble == "hmc" else of_bath)
    if ensemble == "npt":
        values.setdefault("pressure", 1.0)
    values.setdefault("steps_per_trial", usual_steps(values["dt"] / 1000) if ensemble == "hmc" else 1)
    values.setdefault("steps", _steps(values.get("time", DEFAULT_TIME), values["dt"] * values["steps_per_trial"]))
    values.setdefault("out", trajectory_of(options))
    values.setdefault("report", values["out"].with_suffix(".csv"))
    plan = Plan(**values)
    _check(plan)
    return plan


def trajectory_of(options: Options) -> Path:
    """The trajectory of a new run, after which its checkpoint is named."""
    return options.out or Path(f"{options.box.stem}.dcd")


def checkpoint_of(trajectory: Path) -> Path:
    """The checkpoint of a run with this trajectory."""
    return trajectory.with_suffix(".chk")


def ignored_options(topology: Path | None, given: Collection[str]) -> tuple[str, ...]:
    """Names of options that would do nothing with a topology.

    Args:
        topology: its file; None without one.
        given: names of options that the user gave.

    Raises:
        RunError: one of them was given.
        ForceFieldError, OSError: the topology is none, or cannot be read.
    """
    if topology is None:
        return ()
    kind = topology_kind(topology)
    for name in IGNORED[kind]:
        if name in given:
            raise RunError(f"{OPTIONS[name].flag} does nothing with {topology}, which is {kind}: leave it out")
    return IGNORED[kind]


def _steps(time: float, dt: float) -> int:
    """Steps of `dt` fs in a time in ps."""
    return max(1, round(time * 1000 / dt))


def _check(plan: Plan) -> None:
    """Refuse what no run can have."""
    if plan.ensemble not in plan.method.ensembles:
        possible = ", ".join(plan.method.ensembles)
        raise RunError(f"{plan.method.name} has the ensembles {possible}, got {plan.ensemble}")
    if plan.rigid and plan.method.scheme is None:
        raise RunError(
            f"--rigid {' '.join(plan.rigid)} needs a scheme of this package: {plan.method.name} holds no molecules "
            "rigid but by constraints"
        )


def _check_given(options: Options, ensemble: str) -> None:
    """Refuse options that would do nothing."""
    for name, needed, there in (
        ("friction", "--ensemble nvt, npt or hmc", ensemble != "nve"),
        ("pressure", "--ensemble npt or hmc", ensemble in ("npt", "hmc")),
        ("steps_per_trial", "--ensemble hmc", ensemble == "hmc"),
        ("pressure_tensor_every", "--pressure-tensor FILE.csv", options.pressure_tensor),
    ):
        if getattr(options, name) is not None and not there:
            raise RunError(f"{OPTIONS[name].flag} needs {needed}")


# --- from a checkpoint ---


def noted_plan(checkpoint: Path, saved: Mapping[str, object]) -> Plan:
    """The plan that a checkpoint notes, with paths of files relative to the current directory.

    Raises:
        RunError: an option is unknown, missing or wrong; the message names the checkpoint and the option.
    """
    if unknown := set(saved) - set(NOTED):
        raise RunError(f"{checkpoint}: plan: there is no option {min(unknown)}")
    values: dict[str, Any] = {}
    for name in NOTED:
        value = saved.get(name)
        try:
            values[name] = None if value is None and name in MAY_LACK else OPTIONS[name].kind.check(value)
        except WrongValueError as error:
            raise RunError(f"{checkpoint}: plan: {name}: {error}") from None
    here = os.path.dirname(checkpoint)
    beside = {name: Path(os.path.normpath(os.path.join(here, values[name]))) for name in FILES if values.get(name)}
    return Plan(**values | beside)


def continued_plan(options: Options, checkpoint: Path, saved: Mapping[str, object]) -> Plan:
    """The plan of a checkpoint, with another length if one is given.

    Options must not contradict the checkpoint, and outputs that do not lie beside it must be named again.
    """
    plan = noted_plan(checkpoint, saved)
    if options.start:
        raise RunError("--start begins a new run and --restart goes on with an old one: give one of them")
    for name in CONTINUED:
        given, noted = getattr(options, name), getattr(plan, name)
        if given is not None and not _same(given, noted):
            option = OPTIONS[name].flag + ("" if given is True else f" {_shown(given)}")
            raise RunError(
                f"{option} differs from {_shown(noted)} of {checkpoint}; leave it out, or begin a new run with --start"
            )
    for name in OUTPUTS:
        if (path := getattr(plan, name)) and getattr(options, name) is None and not _is_below(path, checkpoint):
            raise RunError(
                f"{checkpoint}: plan: {name}: {path} does not lie beside the checkpoint; if the run writes there, say "
                f"so by {OPTIONS[name].flag} {path}"
            )
    steps = _steps(options.time, 1000 * plan.step_time) if options.time is not None else options.steps or plan.steps
    return replace(plan, steps=steps, box=options.box or plan.box, topology=options.topology or plan.topology)


def _same(given: Any, noted: Any) -> bool:
    if isinstance(given, Path) and noted is not None:
        return os.path.abspath(given) == os.path.abspath(noted)
    return bool(given == noted)


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def _is_below(path: Path, checkpoint: Path) -> bool:
    """Whether a file is in the directory of a checkpoint or below it, all links followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(os.path.dirname(checkpoint) or "."))
