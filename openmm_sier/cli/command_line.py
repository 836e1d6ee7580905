"""The commands and their options, read from a command line."""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from cyclopts import App, CycloptsError, Parameter, UnknownOptionError, UnusedCliTokensError
from cyclopts.validators import Number
from pydantic import ValidationError

from openmm_sier.cli.arguments import flag
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.fields import refusal
from openmm_sier.cli.many.seeds import read_seeds
from openmm_sier.cli.settings import InputSettings, RunSettings, TrialSettings
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.inputs.completion import FILES, PADDING, PH, SALT
from openmm_sier.version import __version__

EXIT_CODES = """Exit codes:

- 0: done
- 1: an error, in one line on standard error
- 2: wrong arguments
- 3: the temperature ran away, for example because the step is too long. The last checkpoint is kept
- 4: the run that --restart should continue is already complete; with --resume that is 0
- 129, 130, 143: ended by SIGHUP, SIGINT (Ctrl-C) or SIGTERM after a completed step: all files are written, checkpoint
  included, and --restart continues the run
"""

#: The fields of a model are options of the command.
FLAT = Parameter(name="*")

Overwrite = Annotated[bool, Parameter(negative="", help="replace existing files (default: refuse to)")]

Debug = Annotated[bool, Parameter(negative="", help="show the traceback of an error (default: one line)")]


def _in_words(default: str, of: str, **limits: Any) -> Parameter:
    return Parameter(help=f"{of} (default: {default})", validator=Number(**limits) if limits else None)


app = App(
    name=PROGRAM,
    help="Simulate rigid molecules with OpenMM, with exact rotation.",
    version=f"{PROGRAM} {__version__}",
    help_format="markdown",
    result_action="return_value",
    # The last value of an option counts. Helps have defaults in words.
    default_parameter=Parameter(
        consume_multiple=True, allow_repeating=True, negative_iterable="", show_default=False, show_choices=False
    ),
)


@app.command(help_epilogue=EXIT_CODES)
def run(
    settings: Annotated[RunSettings, FLAT] = RunSettings(),
    *,
    config: Annotated[
        Path | None,
        _in_words("none", "a TOML file with settings under the names of options; options that are given override it"),
    ] = None,
    seeds: Annotated[
        str | None,
        _in_words(
            "one run",
            "do several runs side by side that differ in their seeds, such as 1-24 or 1-4,7; -seedN is added to the "
            "names of their files. Continue those that are not complete, and print means over all",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        _in_words("one for each core, or one on a GPU", "runs at a time on this machine", gte=1, lte=10**4),
    ] = None,
    scheduler: Annotated[
        str | None, _in_words("this machine", "address of a scheduler of Dask, whose workers do the runs")
    ] = None,
    debug: Debug = False,
) -> None:
    """Simulate molecules.

    Read coordinates with a force field or a topology, equilibrate them at a temperature and simulate them at
    constant energy, temperature or pressure. Writes a trajectory of the atoms that the coordinates list, a log (CSV)
    and a checkpoint. From it --restart continues without a gap, and --start begins a new run, for example in another
    ensemble.
    """
    from openmm_sier.cli import run as command

    command.execute(settings, config, None if seeds is None else read_seeds(seeds), workers, scheduler)


@app.command
def setup(
    structure: Annotated[Path, Parameter(help="a PDB or PDBx/mmCIF file, of which the first model is taken")],
    *,
    out: Annotated[
        Path | None,
        _in_words(
            "after the structure with -water.pdb, in the current directory",
            "what `run` reads, with the force field named in it",
        ),
    ] = None,
    forcefield: Annotated[
        list[Path] | None,
        _in_words(" ".join(FILES), "force-field files, OpenMM's or your own, with water and ions"),
    ] = None,
    shape: Annotated[
        Literal["cube", "octahedron", "dodecahedron"],
        _in_words("dodecahedron", "of the box: cube, octahedron or dodecahedron, which has the least water"),
    ] = "dodecahedron",
    padding: Annotated[
        float, _in_words(f"{PADDING:g}", "least distance in nm between the solute and its images", gte=0.1, lte=100)
    ] = PADDING,
    salt: Annotated[
        float, _in_words(f"{SALT:g}", "mol/l of ions beyond those that neutralize the solute", gte=0, lte=10)
    ] = SALT,
    ph: Annotated[float, _in_words(f"{PH:g}", "by which hydrogens of residues are chosen", gte=0, lte=14)] = PH,
    leave_out: Annotated[list[str] | None, _in_words("none", "names of residues to leave out")] = None,
    ends: Annotated[
        bool,
        Parameter(negative="", help="add residues that are missing at the ends of chains too, not only within them"),
    ] = False,
    seed: Annotated[int, _in_words("1", "of the places of what is added", gte=1, lt=2**31)] = 1,
    overwrite: Overwrite = False,
    debug: Debug = False,
) -> None:
    """Complete a structure, such as one from the Protein Data Bank, for `run`.

    Add what a structure lacks, by PDBFixer and OpenMM's Modeller: residues within chains, heavy atoms and hydrogens,
    then water and ions in a periodic box. Says what was added, and names the force field in the file that it writes.
    """
    from openmm_sier.cli import setup as command

    command.execute(structure, out, forcefield, shape, padding, salt, ph, leave_out, ends, seed, overwrite)


@app.command
def tune(
    settings: Annotated[TrialSettings, FLAT] = TrialSettings(),
    *,
    acceptance: Annotated[
        float | None,
        _in_words(
            "where step times acceptance is nearly largest", "wanted fraction of accepted trials", gte=0.01, lte=0.99
        ),
    ] = None,
    trials: Annotated[int, _in_words("40", "at each step that is tried", gte=10, lt=2**31)] = 40,
    debug: Debug = False,
) -> None:
    """Find the step of hybrid Monte Carlo.

    Equilibrate coordinates as `run --ensemble hmc` does, then find the step, beginning with --dt, at which trials of
    the same length in time have the acceptance. Writes no files: it prints the command line of a run.
    """
    from openmm_sier.cli import tune as command

    command.execute(settings, acceptance, trials)


@app.command
def summary(
    logs: Annotated[
        list[Path],
        Parameter(
            help="logs of runs of one kind, which need not have ended; runs that differ in their seeds count as one "
            "sample each"
        ),
    ],
    *,
    plot: Annotated[Path | None, _in_words("no picture", "draw the logs there, in PNG or SVG")] = None,
    json: Annotated[Path | None, _in_words("nowhere", "write all numbers there too")] = None,
    skip: Annotated[
        float | None,
        _in_words(
            "what had not settled, if anything",
            "time in ps, or with hmc trials, at the beginning of each run to leave out of means",
            gte=0,
            lte=1e9,
        ),
    ] = None,
    overwrite: Overwrite = False,
    debug: Debug = False,
) -> None:
    """Print means over a run or over several, and draw their logs.

    Print means over runs that differ in their seeds, with errors over runs: from their scatter if there are five or
    more, else from the errors of each. Say whether the runs settled, drift, or have temperatures that differ. With
    --plot also draw what logs have: energy and its error, temperatures by kind, density, acceptance, in means over
    equal times.
    """
    from openmm_sier.cli import summary as command

    command.execute(logs, json, plot, skip, overwrite)


@app.command
def info(settings: Annotated[InputSettings, FLAT] = InputSettings(), *, debug: Debug = False) -> None:
    """List the rigid bodies of the input.

    Show the kinds of rigid body that coordinates have, with a force field or a topology.
    """
    from openmm_sier.cli import info as command

    command.execute(settings)


class Call(NamedTuple):
    """A parsed command line.

    Attributes:
        carry_out: function that executes the command.
        debug: whether errors have a traceback.
    """

    carry_out: Callable[[], Any]
    debug: bool


def parse(arguments: Sequence[str] | None = None) -> Call:
    """Parse a command line, by default that of the process.

    Raises:
        Misused: arguments are wrong.
    """
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    if not tokens:
        raise Misused(f"expected a command, one of {', '.join(name for name in app if name[0] != '-')}")
    try:
        function, bound, _ = app.parse_args(tokens, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        command = " ".join([PROGRAM, *(error.command_chain or ())])
        raise Misused(f"{_described(error)} (see {command} --help)") from None
    return Call(partial(function, *bound.args, **bound.kwargs), bool(bound.arguments.get("debug")))


def _described(error: CycloptsError) -> str:
    cause = error.__cause__
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens:
        return f"{error.unused_tokens[0]!r} belongs to no option"
    if isinstance(error, UnknownOptionError):
        # The parser would suggest --time for --timestep.
        return f"there is no option {error.token.keyword or error.token.value}"
    if not (isinstance(cause, ValidationError) and error.argument):
        return " ".join(str(error).split()).removesuffix(".")
    name, message = refusal(cause, error.argument.hint)
    return f"argument {'BOX' if name == 'box' else flag(name)}: {message}"


def settings_of(line: Sequence[str]) -> RunSettings:
    """Return the settings in a command line of `run`.

    Raises:
        CycloptsError: arguments are wrong.
    """
    _, bound, _ = app.parse_args(list(line), exit_on_error=False, print_error=False)
    settings: RunSettings = bound.arguments["settings"]
    return settings
