"""The options of `openmm-sier run`, declared once.

The command line, `--help`, plans of ensembles and the notes in checkpoints are read and checked by this declaration.
"""

# `_option` is a field of a dataclass.
# ruff: noqa: RUF009

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from openmm_sier_command.parser import FORCEFIELD_HELP, reading
from openmm_sier_command.values import TIME, Choice, File, Kind, Number, Several, Switch, Whole, Word, WrongValueError

#: What moves the molecules, by the names that `--scheme` takes, and the usual step for rigid water, fs: the schemes of
#: this package and, to compare them with, OpenMM's own integrators. The first scheme is the default.
USUAL_STEPS = {
    "sier4g": 6.0,
    "sier2": 2.0,
    "sier2v2": 6.0,
    "sier2p3": 12.0,
    "sier4": 4.0,
    "sier4v": 5.0,
    "sier4p": 6.0,
    "verlet": 2.0,
    "langevinmiddle": 2.0,
}

#: The default method.
RECOMMENDED = next(iter(USUAL_STEPS))

ENSEMBLES = ("nve", "nvt", "npt", "hmc")

#: What may be constrained besides water, the keys of `openmm_sier.measure.forcefields.CONSTRAINTS`.
CONSTRAINTS = ("none", "hbonds", "allbonds", "hangles")

#: Most steps of a run: doubles count them exactly, with room.
MOST_STEPS = 10**15

#: What a restart does with an option: it keeps the value in the checkpoint, and refuses another; or it may have
#: another. Options with "" are not in checkpoints.
Restart = Literal["keeps", "may change", ""]


class OptionError(ValueError):
    """A file has an unknown option, or a wrong value; the message names the file and the option."""


@dataclass(frozen=True)
class Option:
    """What is known of an option.

    Attributes:
        name: with underscores, as in plans and checkpoints.
        kind: the values that it takes.
        help: what it is, in words.
        default: the value without it; None where that depends on others.
        otherwise: the default in words, where there is no single value.
        restart: see `Restart`.
        empty: whether a run may have none.
    """

    name: str
    kind: Kind
    help: str
    default: Any = None
    otherwise: str = ""
    restart: Restart = ""
    empty: bool = False

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    @property
    def reads(self) -> bool:
        """Whether it names a file, or files, that a run reads."""
        kind = self.kind.of if isinstance(self.kind, Several) else self.kind
        return isinstance(kind, File) and not kind.output

    @property
    def writes(self) -> bool:
        """Whether it names a file that a run writes."""
        return isinstance(self.kind, File) and self.kind.output

    @property
    def described(self) -> str:
        """The text in `--help`."""
        if not self.otherwise and self.default is None:
            return self.help
        default = self.otherwise or (f"{self.default:g}" if isinstance(self.default, float) else str(self.default))
        return f"{self.help} (default: {default})"

    def checked(self, source: str, value: object) -> Any:
        """The value that a file has.

        Raises:
            OptionError: it is not of the kind.
        """
        try:
            return self.kind.check(value)
        except WrongValueError as error:
            raise OptionError(f"{source}: {self.name}: {error}") from None


def _option(kind: Kind, help: str, default: Any = None, otherwise: str = "", **more: Any) -> Any:
    known = {"kind": kind, "help": help, "default": default, "otherwise": otherwise, **more}
    return field(default=None, metadata=known)


def _steps() -> str:
    return ", ".join(f"{step:g} for {name}" for name, step in USUAL_STEPS.items())


@dataclass(frozen=True)
class Options:
    """Options of a run. Those that were not given are None; `openmm_sier.cli.plan.Plan` has values for them.

    Times are in ps, but `dt` is in fs.
    """

    box: Path = _option(
        File("BOX.pdb"), "whole molecules with hydrogens; virtual sites are added", restart="may change", empty=True
    )
    forcefield: list[Path] | None = _option(Several(File("XML")), FORCEFIELD_HELP, restart="keeps", empty=True)
    rigid: list[str] | None = _option(
        Several(Word("RESIDUE")),
        "names of residues, besides water, to be held rigid in the geometry that they have in the PDB file, but for "
        "bonds that constraints hold",
        otherwise="none",
        restart="keeps",
        empty=True,
    )
    constraints: str | None = _option(
        Choice(CONSTRAINTS),
        "constraints besides those of water: of bonds to hydrogen, of all bonds, or of bonds and angles of hydrogens",
        "hbonds",
        restart="keeps",
        empty=True,
    )
    cutoff: float | None = _option(
        Number("nm", 0.2, 10),
        "where the direct sum of PME and Lennard-Jones end",
        otherwise="0.9, less in a box that is too small for it",
        restart="keeps",
        empty=True,
    )
    switch: float | None = _option(
        Number("nm", 0, 10),
        "where Lennard-Jones starts to be switched off; 0 for a jump at the cut-off",
        otherwise="five sixths of the cut-off",
        restart="keeps",
        empty=True,
    )
    tolerance: float | None = _option(
        Number("", 1e-10, 1e-3),
        "error tolerance of the sums of PME, which are balanced",
        1e-4,
        restart="keeps",
        empty=True,
    )
    hydrogen_mass: float | None = _option(
        Number("dalton", 1, 4),
        "mass of hydrogens outside water, taken from the atoms that they are bonded to",
        otherwise="that of the force field",
        restart="keeps",
        empty=True,
    )
    scheme: str = _option(
        Choice(tuple(USUAL_STEPS)),
        "scheme of this package, or for comparison one of OpenMM's own integrators: verlet, with an AndersenThermostat "
        "at constant temperature, or langevinmiddle; MonteCarloBarostat keeps their pressure",
        RECOMMENDED,
        restart="keeps",
    )
    dt: float = _option(Number("fs", 1e-3, 1e3), "step", otherwise=_steps(), restart="keeps")
    ensemble: str = _option(
        Choice(ENSEMBLES),
        "what is constant; hmc is hybrid Monte Carlo",
        otherwise="nve; nvt for langevinmiddle",
        restart="keeps",
    )
    friction: float = _option(
        Number("1/ps", 0, 1e5),
        "of the heat bath, or the rate of collisions of verlet",
        otherwise="1; hmc draws all momenta for each trial without it",
        restart="keeps",
    )
    pressure: float | None = _option(
        Number("bar", -5000, 50000, hint=" (1 bar is 100000 Pa)"),
        "with npt or hmc",
        otherwise="1 with npt, constant volume with hmc",
        restart="keeps",
        empty=True,
    )
    steps_per_trial: int = _option(
        Whole(most=10**6),
        "of the scheme in a trial of hmc, which is then a step of the run",
        otherwise="10",
        restart="keeps",
        empty=True,
    )
    steps: int = _option(
        Whole(most=MOST_STEPS),
        "length of the whole trajectory, of which a restart does what is left",
        otherwise="as --time says",
        restart="may change",
    )
    time: float | None = _option(TIME, "the same in ps", otherwise="10; that of the checkpoint with --restart")
    temperature: float = _option(
        Number("K", 0, 3000), "of start and heat bath", otherwise="297, or that of the run of --start", restart="keeps"
    )
    equilibrate: float | None = _option(
        Number("ps", 0, 1e9),
        "how long",
        otherwise="until temperatures and potential energy have settled, 3 to 20; not at all with --start",
    )
    minimize: bool | None = _option(
        Switch(), "minimize the energy first", otherwise="if the start has forces that a liquid has not"
    )
    out: Path = _option(
        File("FILE", output=True),
        "trajectory, .dcd, .xtc or .h5",
        otherwise="BOX.dcd, in the current directory",
        restart="keeps",
    )
    unwrapped: bool = _option(
        Switch(),
        "frames have molecules where they went, not in the box",
        False,
        otherwise="in the box",
        restart="keeps",
    )
    report: Path = _option(File("CSV", output=True), "log", otherwise="as the trajectory, with .csv", restart="keeps")
    every: float = _option(TIME, "between frames", 0.1, restart="keeps")
    report_every: float = _option(TIME, "between rows of the log", 0.04, restart="keeps")
    checkpoint_every: float = _option(TIME, "between checkpoints", 1.0, restart="keeps")
    bodies: Path | None = _option(
        File("FILE.h5", output=True),
        "write centres, quaternions and momenta of the bodies there",
        otherwise="they are not written",
        restart="keeps",
        empty=True,
    )
    bodies_every: float = _option(TIME, "between them", otherwise="as --every", restart="keeps")
    pressure_tensor: Path | None = _option(
        File("CSV", output=True),
        "write the molecular pressure tensor there, for viscosity",
        otherwise="it is not written",
        restart="keeps",
        empty=True,
    )
    # Sums over tensors mistake oscillations of the period of their interval, or a fraction of it, for slow ones; in
    # rigid water such oscillations have a thousandth of the power of the slow ones at 0.02 ps.
    pressure_tensor_every: float = _option(
        TIME, "between rows of it, each of which costs 12 energies", 0.02, restart="keeps"
    )
    seed: int = _option(Whole(), "of velocities, equilibration and heat bath", 1, restart="keeps")
    platform: str | None = _option(Word(), "of OpenMM", otherwise="the fastest")
    start: Path | None = _option(
        File(),
        "checkpoint (.chk) of any run, whose positions, velocities and box a new run begins with; unless given, the "
        "options that make the System, and --temperature, are those of that run",
        otherwise="none",
    )
    restart: Path | None = _option(File(), "checkpoint (.chk) to go on from", otherwise="none")
    overwrite: bool | None = _option(Switch(), "replace files of an earlier run", False, otherwise="refuse to")

    @property
    def equilibrates(self) -> bool:
        """Whether the run begins with an equilibration. From a checkpoint it does so only if asked to."""
        return self.start is None or bool(self.equilibrate or self.minimize)


#: All options by name, in the order of `--help`.
OPTIONS = {option.name: option for option in (Option(entry.name, **entry.metadata) for entry in fields(Options))}

#: Options that a restart keeps, and all those that stand in a checkpoint.
CONTINUED = tuple(name for name, option in OPTIONS.items() if option.restart == "keeps")
NOTED = tuple(name for name, option in OPTIONS.items() if option.restart)

#: Options that make the System. A run with `--start` takes them from the other run unless they are given.
OF_THE_SYSTEM = ("forcefield", "rigid", "constraints", "cutoff", "switch", "tolerance", "hydrogen_mass")

#: Options of which only one may be given.
EXCLUSIVE = ("steps", "time")


def add_options(parser: argparse.ArgumentParser, names: Iterable[str] = OPTIONS) -> None:
    """Add options to a parser; `box` is a positional argument."""
    names = list(names)
    together = parser.add_mutually_exclusive_group() if set(EXCLUSIVE) <= set(names) else None
    for name in names:
        _add_option(together if together and name in EXCLUSIVE else parser, OPTIONS[name])


def _add_option(parser: argparse._ActionsContainer, option: Option) -> None:
    # A per cent sign has a meaning in argparse.
    shared: dict[str, Any] = {"help": option.described.replace("%", "%%")}
    if isinstance(option.kind, Switch):
        action: Any = argparse.BooleanOptionalAction if option.default is None else "store_true"
        parser.add_argument(option.flag, action=action, default=None, **shared)
        return
    shared |= {"type": reading(option.kind), "metavar": option.kind.metavar or "VALUE"}
    if isinstance(option.kind, Several):
        shared |= {"nargs": "+"}
    parser.add_argument(option.name if option.name == "box" else option.flag, **shared)


def given_options(namespace: argparse.Namespace) -> Options:
    """The options that a command line gave."""
    return Options(**{name: getattr(namespace, name) for name in OPTIONS})


def check_table(source: str, table: Mapping[str, object]) -> dict[str, Any]:
    """The options that a table of a file gives, by name.

    Args:
        source: the file, for messages.
        table: values by the options' names; None stands for none where a run may have none.

    Raises:
        OptionError: an option is unknown, has a wrong value, or excludes another.
    """
    for name in table:
        if name not in OPTIONS:
            raise OptionError(f"{source}: there is no option {name}")
    if len(both := [name for name in EXCLUSIVE if name in table]) > 1:
        raise OptionError(f"{source}: {' and '.join(both)} exclude each other")
    return {
        name: None if value is None and OPTIONS[name].empty else OPTIONS[name].checked(source, value)
        for name, value in table.items()
    }
