"""The options of `openmm-sier run`, declared once.

The command line, `--help` and the notes in checkpoints are read and checked by this declaration.
"""

# `_option` is a field of a dataclass.
# ruff: noqa: RUF009

import argparse
from collections.abc import Collection
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from openmm_sier.cli.methods import ENSEMBLES, HEAVY, METHODS, Method
from openmm_sier.cli.values import PICTURE, SWITCH, TIME, Kind, choice, file, number, several, step, whole, word
from openmm_sier.inputs.forcefields import CONSTRAINTS, CUTOFF, EWALD_TOLERANCE
from openmm_sier.prepare.masses import LIGHTEST_HYDROGEN
from openmm_sier.system.body_selection import file_words
from openmm_sier.system.tables import HEAVIEST_HYDROGEN

#: The default scheme of each ensemble, by the name that `--scheme` takes.
RECOMMENDED = {"nve": "sier4g", "nvt": "sier2", "npt": "sier2", "hmc": "sier4g"}

#: Most steps of a run: doubles count them exactly, with room.
MOST_STEPS = 10**15

#: What a restart does with an option: it keeps the value in the checkpoint, and refuses another; or it may have
#: another. Options that are "not noted" are not in checkpoints.
Restart = Literal["keeps", "may change", "not noted"]

FORCEFIELD_HELP = (
    "force-field files, OpenMM's or your own; with a psf file all parameter, topology and stream files of CHARMM, that "
    "end in .prm or .par, .rtf or .top, .str, or .inp (default: the file named in a record 'REMARK  99 FORCEFIELD "
    "file.xml' of the PDB file)"
)


@dataclass(frozen=True)
class Option:
    """What is known of an option.

    Attributes:
        name: with underscores, as in checkpoints.
        kind: the values that it takes.
        help: what it is, in words.
        default: the value without it; None where that depends on others.
        otherwise: the default in words, where there is no single value.
        restart: see `Restart`.
        positional: whether a command line has its values without a flag.
    """

    name: str
    kind: Kind
    help: str
    default: Any = None
    otherwise: str = ""
    restart: Restart = "keeps"
    positional: bool = False

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    @property
    def described(self) -> str:
        """The text in `--help`."""
        if not self.otherwise and self.default is None:
            return self.help
        default = self.otherwise or (f"{self.default:g}" if isinstance(self.default, float) else str(self.default))
        return f"{self.help} (default: {default})"

    def words(self, value: Any) -> list[str]:
        """The words of a command line that give it this value."""
        if isinstance(value, bool):
            return [self.flag if value else f"--no-{self.flag[2:]}"]
        return [self.flag, *map(str, value if isinstance(value, list) else [value])]


def _option(kind: Kind, help: str, default: Any = None, otherwise: str = "", **more: Any) -> Any:
    known = {"kind": kind, "help": help, "default": default, "otherwise": otherwise, **more}
    return field(default=None, metadata=known)


def _usual_steps() -> str:
    """The default of `--dt` for each method: at constant energy, with a bath or trials, and with heavy hydrogens."""

    def told(method: Method) -> str:
        steps = method.usual_step("nve"), method.usual_step("nvt"), method.usual_step("nvt", HEAVY)
        return " or ".join(dict.fromkeys(f"{dt:g}" for dt in steps))

    each = ", ".join(f"{told(method)} for {name}" for name, method in METHODS.items())
    return f"{each}; the first at constant energy, the last with heavy hydrogens and a bath or trials"


@dataclass(frozen=True)
class Options:
    """Options of a run. Those that were not given are None; `openmm_sier.cli.plan.Plan` has values for them.

    Times are in ps, but `dt` is in fs.
    """

    box: Path = _option(
        file("BOX"),
        "coordinates of whole molecules with hydrogens: a PDB or PDBx/mmCIF file, to which virtual sites are added, or "
        "with --topology an inpcrd or rst7 file of AMBER, a gro file of GROMACS, a crd file of CHARMM, or a State of "
        "OpenMM in XML",
        restart="may change",
        positional=True,
    )
    topology: Path | None = _option(
        file(),
        "what the coordinates belong to, with its force field: a prmtop file of AMBER, a top file of GROMACS, a psf "
        "file of CHARMM, or a System of OpenMM in XML",
        otherwise="none, for PDB and PDBx/mmCIF files with --forcefield",
        restart="may change",
    )
    forcefield: list[Path] | None = _option(several(file()), FORCEFIELD_HELP)
    edges: list[float] | None = _option(
        several(number("nm", 0.1, 1e4), 3),
        "edges of a rectangular periodic box, for coordinates without one, as crd files are",
        otherwise="the box of the coordinates",
    )
    rigid: list[str] | None = _option(
        several(word("WHAT")),
        "what, besides water, is to be held rigid in the geometry that it has in the coordinates, but for bonds that "
        "constraints hold: names of residues; ranges of them, as A:1-36, one body each; chains, as 'chain A'; atoms, "
        "as 'atoms 0-35'; selections of MDTraj; or a file with one of these in each line",
        otherwise="none",
    )
    constraints: str | None = _option(
        choice(*CONSTRAINTS),
        "constraints besides those of water: of bonds to hydrogen, of all bonds, or of bonds and angles of hydrogens",
        "hbonds",
    )
    cutoff: float | None = _option(
        number("nm", 0.2, 10),
        "where the direct sum of PME and Lennard-Jones end",
        otherwise=f"{CUTOFF:g}, less in a box that is too small for it",
    )
    switch: float | None = _option(
        number("nm", 0, 10),
        "where Lennard-Jones starts to be switched off; 0 for a jump at the cut-off",
        otherwise="five sixths of the cut-off",
    )
    tolerance: float | None = _option(
        number("", 1e-10, 1e-3), "error tolerance of the sums of PME, which are balanced", EWALD_TOLERANCE
    )
    hydrogen_mass: float | None = _option(
        number("dalton", LIGHTEST_HYDROGEN, HEAVIEST_HYDROGEN),
        "mass of hydrogens, in water too, taken from the atoms that they are bonded to; it slows motion, not averages",
        otherwise="that of the force field",
    )
    scheme: str = _option(
        choice(*METHODS),
        "scheme of this package, or for comparison one of OpenMM's own integrators: verlet, with an AndersenThermostat "
        "at constant temperature, or langevinmiddle; MonteCarloBarostat keeps their pressure",
        otherwise="sier4g; sier2 with nvt and npt",
    )
    dt: float = _option(step(0.05, 1e3), "step", otherwise=_usual_steps())
    ensemble: str = _option(
        choice(*ENSEMBLES), "what is constant; hmc is hybrid Monte Carlo", otherwise="nve; nvt for langevinmiddle"
    )
    friction: float = _option(
        number("1/ps", 0, 1e5),
        "of the heat bath, or the rate of collisions of verlet",
        otherwise="1, or 5 with heavy hydrogens; hmc draws all momenta for each trial without it",
    )
    pressure: float | None = _option(
        number("bar", -5000, 50000, hint=" (1 bar is 100000 Pa)"),
        "with npt or hmc",
        otherwise="1 with npt, constant volume with hmc",
    )
    steps_per_trial: int = _option(
        whole(most=10**6), "of the scheme in a trial of hmc, which is then a step of the run", otherwise="10"
    )
    steps: int = _option(
        whole(most=MOST_STEPS),
        "length of the whole trajectory, of which a restart does what is left",
        otherwise="as --time says",
        restart="may change",
    )
    time: float | None = _option(
        TIME, "the same in ps", otherwise="10; that of the checkpoint with --restart", restart="not noted"
    )
    temperature: float = _option(
        number("K", 0, 3000), "of start and heat bath", otherwise="297, or that of the run of --start"
    )
    equilibrate: float | None = _option(
        number("ps", 0, 1e9),
        "how long",
        otherwise="until temperatures and potential energy have settled, 3 to 20; not at all with --start",
        restart="not noted",
    )
    minimize: bool | None = _option(
        SWITCH,
        "minimize the energy first",
        otherwise="if the start has forces that a liquid has not",
        restart="not noted",
    )
    out: Path = _option(
        file("FILE", "output"), "trajectory, .dcd or .xtc", otherwise="BOX.dcd, in the current directory"
    )
    unwrapped: bool = _option(
        SWITCH, "frames have molecules where they went, not in the box", False, otherwise="in the box"
    )
    report: Path = _option(file("CSV", "output"), "log", otherwise="as the trajectory, with .csv")
    every: float = _option(TIME, "between frames", 0.1)
    report_every: float = _option(TIME, "between rows of the log", 0.04)
    checkpoint_every: float = _option(TIME, "between checkpoints", 1.0)
    pressure_tensor: Path | None = _option(
        file("CSV", "output"), "write the molecular pressure tensor there, for viscosity", otherwise="it is not written"
    )
    # Sums over tensors mistake oscillations of the period of their interval, or a fraction of it, for slow ones; in
    # rigid water such oscillations have a thousandth of the power of the slow ones at 0.02 ps.
    pressure_tensor_every: float = _option(TIME, "between rows of it, each of which costs 12 energies", 0.02)
    seed: int = _option(whole(), "of velocities, equilibration and heat bath", 1)
    platform: str | None = _option(
        word(), "of OpenMM", otherwise="the fastest; that of the checkpoint with --restart", restart="not noted"
    )
    start: Path | None = _option(
        file(),
        "checkpoint (.chk) of any run, whose positions, velocities and box a new run begins with; unless given, the "
        "options that make the System, and --temperature, are those of that run",
        otherwise="none",
        restart="not noted",
    )
    restart: Path | None = _option(file(), "checkpoint (.chk) to go on from", otherwise="none", restart="not noted")
    resume: bool | None = _option(
        SWITCH,
        "go on from the checkpoint beside --out where there is one, begin where there is none, and end well where the "
        "run is complete: one command line for a job that may be killed",
        False,
        otherwise="begin",
        restart="not noted",
    )
    plot: Path | None = _option(
        PICTURE, "draw the log at the end, as `plot` does", otherwise="no picture", restart="not noted"
    )
    overwrite: bool | None = _option(
        SWITCH,
        "replace files of an earlier run, or with --restart cut back a longer one",
        False,
        otherwise="refuse to",
        restart="not noted",
    )

    def __post_init__(self) -> None:
        # The checkpoint has the words of a file, which may be changed or moved later.
        if self.rigid is not None:
            words = [line for word in self.rigid for line in file_words(word)]
            object.__setattr__(self, "rigid", words)

    @property
    def equilibrates(self) -> bool:
        """Whether the run begins with an equilibration. From a checkpoint it does so only if asked to."""
        return self.start is None or bool(self.equilibrate or self.minimize)


#: All options by name, in the order of `--help`.
OPTIONS = {option.name: option for option in (Option(entry.name, **entry.metadata) for entry in fields(Options))}

#: Options that a restart keeps, and all those that stand in a checkpoint.
CONTINUED = tuple(name for name, option in OPTIONS.items() if option.restart == "keeps")
NOTED = tuple(name for name, option in OPTIONS.items() if option.restart != "not noted")

#: Options of which a run may have none.
MAY_LACK = tuple(entry.name for entry in fields(Options) if "None" in str(entry.type))

#: Options that make the System. A run with `--start` takes them from the other run unless they are given.
OF_THE_SYSTEM = (
    *("topology", "forcefield", "edges", "rigid", "constraints"),
    *("cutoff", "switch", "tolerance", "hydrogen_mass"),
)

#: Options of `openmm-sier tune`: those that make the System and its start, and those with which the search begins.
OF_TUNING = (
    *("box", *OF_THE_SYSTEM, "scheme", "dt", "steps_per_trial", "friction", "pressure"),
    *("temperature", "equilibrate", "minimize", "seed", "platform", "start"),
)

#: Options of which only one may be given.
EXCLUSIVE = ("steps", "time")


def add_options(parser: argparse.ArgumentParser, options: Collection[Option], with_defaults: bool = False) -> None:
    """Add options to a parser.

    Args:
        parser: of a command.
        options: to add.
        with_defaults: whether options that are not given have their defaults; otherwise they are None.
    """
    names = {option.name for option in options}
    excluding = names >= set(EXCLUSIVE)
    one_of_them = parser.add_mutually_exclusive_group() if excluding else parser
    for option in options:
        # A per cent sign has a meaning in argparse.
        shared: dict[str, Any] = {"help": option.described.replace("%", "%%")}
        if option.kind is SWITCH:
            shared |= {"action": argparse.BooleanOptionalAction if option.default is None else "store_true"}
        else:
            each = option.kind.each
            shared |= {
                "type": (each or option.kind).read,
                "metavar": option.kind.metavar,
                "nargs": (option.kind.count or "+") if each else None,
            }
        if option.positional:
            # A checkpoint names the coordinates of its run.
            may_lack = {"nargs": "?"} if "restart" in names else {}
            parser.add_argument(option.name, **shared | may_lack)
            continue
        group = one_of_them if option.name in EXCLUSIVE else parser
        group.add_argument(option.flag, default=option.default if with_defaults else None, **shared)
