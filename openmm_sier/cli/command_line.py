"""Read a command line. The module of commands, whose options need OpenMM, is imported for one of them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from cyclopts import App, CycloptsError, Parameter, UnknownOptionError, UnusedCliTokensError
from pydantic import ValidationError

from openmm_sier.cli.arguments import flag
from openmm_sier.cli.errors import Misused
from openmm_sier.cli.fields import refusal
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.version import __version__

if TYPE_CHECKING:
    from openmm_sier.cli.settings import RunSettings

#: What the help of each command says, by name: its first line is in the list of commands.
DESCRIPTIONS = {
    "run": """Simulate molecules.

Read coordinates with a force field or a topology, equilibrate them at a temperature and simulate them at
constant energy, temperature or pressure. Writes a trajectory of the atoms that the coordinates list, a log (CSV)
and a checkpoint. From it --restart continues without a gap, and --start begins a new run, for example in another
ensemble.""",
    "setup": """Complete a structure, such as one from the Protein Data Bank, for `run`.

Add what a structure lacks, by PDBFixer and OpenMM's Modeller: residues within chains, heavy atoms and hydrogens,
then water and ions in a periodic box. Says what was added, and names the force field in the file that it writes.""",
    "tune": """Find the step of hybrid Monte Carlo.

Equilibrate coordinates as `run --ensemble hmc` does, then find the step, beginning with --dt, at which trials of
the same length in time have the acceptance. Writes no files: it prints the command line of a run.""",
    "summary": """Print means over a run or over several, and draw their logs.

Print means over runs that differ in their seeds, with errors over runs: from their scatter if there are five or
more, else from the errors of each. Say whether the runs settled, drift, or have temperatures that differ. With
--plot also draw what logs have: energy and its error, temperatures by kind, density, acceptance, in means over
equal times.""",
    "info": """List the rigid bodies of the input.

Show the kinds of rigid body that coordinates have, with a force field or a topology.""",
}

EXIT_CODES = """Exit codes:

- 0: done
- 1: an error, in one line on standard error
- 2: wrong arguments
- 3: the temperature ran away, for example because the step is too long. The last checkpoint is kept
- 4: the run that --restart should continue is already complete; with --resume that is 0
- 129, 130, 143: ended by SIGHUP, SIGINT (Ctrl-C) or SIGTERM after a completed step: all files are written, checkpoint
  included, and --restart continues the run
"""

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
for name, description in DESCRIPTIONS.items():
    app.command(
        f"openmm_sier.cli.commands:{name}",
        name=name,
        help=description,
        help_epilogue=EXIT_CODES if name == "run" else None,
    )


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
