"""The arguments of all commands."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import NoReturn

from openmm_sier.cli.options import OF_TUNING, OPTIONS, Option, add_options
from openmm_sier.cli.seeds import SEEDS
from openmm_sier.cli.streams import PROGRAM
from openmm_sier.cli.values import PICTURE, SWITCH, choice, file, number, several, whole, word
from openmm_sier.inputs.completion import FILES, PADDING, PH, SALT, SHAPES

#: Exit code for wrong arguments.
MISUSED = 2

EXIT_CODES = """exit codes:
  0    done
  1    an error, in one line on standard error
  2    wrong arguments
  3    the temperature ran away, for example because the step is too long. The last checkpoint is kept
  4    the run that --restart should continue is already complete; with --resume that is 0
  129, 130, 143
       ended by SIGHUP, SIGINT (Ctrl-C) or SIGTERM after a completed step: all files are written, checkpoint included,
       and --restart goes on
"""


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        help: in a few words, for the list of commands.
        description: above its own `--help`.
        of_runs: names of options of `openmm-sier run`, which are None where they are not given.
        own: its other options, which have their defaults.
        epilog: below its `--help`.
    """

    help: str
    description: str
    of_runs: Sequence[str] = ()
    own: Sequence[Option] = ()
    epilog: str = ""


#: Options of the commands that read logs.
LOGS = Option(
    "logs",
    several(file("RUN.csv")),
    "logs of runs of one kind, which may still be going on; runs that differ in their seeds count as one sample each",
    positional=True,
)
SKIP = Option(
    "skip",
    number("ps", 0, 1e9),
    "time, or with hmc trials, at the beginning of each run that means leave out",
    otherwise="what had not settled, if anything",
)

#: Options of `openmm-sier setup`.
OF_SETUP = (
    Option("structure", file("FILE"), "a PDB or PDBx/mmCIF file, of which the first model is taken", positional=True),
    Option(
        "out",
        file("FILE.pdb", "output"),
        "what `run` reads, with the force field named in it",
        otherwise="after the structure with -water.pdb, in the current directory",
    ),
    Option(
        "forcefield",
        several(file()),
        "force-field files, OpenMM's or your own, with water and ions",
        otherwise=" ".join(FILES),
    ),
    Option("shape", choice(*SHAPES), "of the box; a dodecahedron has the least water", "dodecahedron"),
    Option("padding", number("nm", 0.1, 100), "least distance between the solute and its images", PADDING),
    Option("salt", number("mol/l", 0, 10), "of ions beyond those that neutralize the solute", SALT),
    Option("ph", number("", 0, 14), "by which hydrogens of residues are chosen", PH),
    Option("leave_out", several(word("RESIDUE")), "names of residues to leave out", otherwise="none"),
    Option("ends", SWITCH, "add residues that are missing at the ends of chains too", False, otherwise="those within"),
    Option("seed", whole(), "of the places of what is added", 1),
    Option("overwrite", SWITCH, "replace an earlier file", False, otherwise="refuse to"),
)

#: Options of `openmm-sier run` for many runs.
OF_MANY = (
    Option(
        "seeds",
        SEEDS,
        "run members beside each other that differ in their seeds, such as 1-24 or 1-4,7, each with files of its own, "
        "-seedN added to their names; go on with those that are not complete, and print means over all",
        otherwise="one run",
    ),
    Option(
        "workers",
        whole(most=10_000),
        "members that run at a time on this machine",
        otherwise="one for each core, or one on a GPU",
    ),
    Option("scheduler", word("ADDRESS"), "of Dask, whose workers run the members", otherwise="this machine"),
)

COMMANDS = {
    "setup": Command(
        "from a structure of an archive to what `run` reads",
        "Add what a structure lacks, by PDBFixer and OpenMM's Modeller: residues within chains, heavy atoms and "
        "hydrogens, then water and ions in a periodic box. Says what was added, and names the force field in the file "
        "that it writes.",
        own=OF_SETUP,
    ),
    "run": Command(
        "simulate molecules",
        "Read coordinates with a force field or a topology, equilibrate them at a temperature and simulate them at "
        "constant energy, temperature or pressure. Writes a trajectory of the atoms that the coordinates list, a log "
        "(CSV) and a checkpoint, from which --restart goes on without a gap and --start begins a new run, in another "
        "ensemble say.",
        tuple(OPTIONS),
        own=OF_MANY,
        epilog=EXIT_CODES,
    ),
    "tune": Command(
        "find step and trial length of hybrid Monte Carlo",
        "Equilibrate coordinates as `run --ensemble hmc` does, then find the step that has the wanted acceptance, "
        "beginning with --dt, and the number of steps in a trial that gives an independent potential energy for the "
        "fewest force evaluations. Writes no files: it prints the command line of a run.",
        OF_TUNING,
        own=(
            Option("acceptance", number("", 0.01, 0.99), "wanted fraction of accepted trials", 0.9),
            Option("trials", whole(10), "at each step that is tried", 40),
            Option("samples", whole(10), "trials of the first length, and as many steps of the other lengths", 200),
        ),
    ),
    "plot": Command(
        "draw the log of a run, or of several",
        "Draw what logs have: energy and its error, temperatures by kind, density, acceptance, in means over equal "
        "times, with what had not settled, and for several runs the error of their mean. Titles say what is found.",
        own=(
            LOGS,
            Option(
                "out",
                PICTURE,
                "the picture, which takes the place of an earlier one",
                otherwise="beside the first log, with .png",
            ),
            SKIP,
        ),
    ),
    "summary": Command(
        "means over several runs",
        "Print means over runs that differ in their seeds, with errors over runs: from their scatter if there are five "
        "or more, else from the errors of each. --json and --plot replace earlier files.",
        own=(
            LOGS,
            Option("json", file("FILE.json", "output"), "write all numbers there too", otherwise="nowhere"),
            Option("plot", PICTURE, "draw the logs, as `plot` does", otherwise="no picture"),
            SKIP,
        ),
    ),
    "info": Command(
        "show what rigid bodies there are",
        "Show the kinds of rigid body that coordinates have, with a force field or a topology.",
        ("box", "topology", "forcefield", "edges", "rigid", "constraints"),
    ),
}


class Parser(argparse.ArgumentParser):
    """Reports errors in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(MISUSED, f"{self.prog}: {message} (see {self.prog} --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """The parser of `openmm-sier`. What it returns has the name of the command as `command`."""
    parser = Parser(prog=PROGRAM, description="Simulation of rigid molecules with OpenMM, with exact rotation.")
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {version(PROGRAM)}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for name, command in COMMANDS.items():
        added = commands.add_parser(
            name,
            help=command.help,
            description=command.description,
            epilog=command.epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter if command.epilog else argparse.HelpFormatter,
        )
        add_options(added, [OPTIONS[option] for option in command.of_runs])
        add_options(added, command.own, with_defaults=True)
        added.add_argument("--debug", action="store_true", help="show the traceback of an error (default: one line)")
    return parser


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """What a command line says.

    Raises:
        SystemExit: arguments are wrong, which has been said in one line; or `--help` or `--version` has been printed.
    """
    parser = build_parser()
    found = parser.parse_args(arguments)
    if found.command == "run" and found.box is None and found.restart is None:
        parser.error("run needs BOX, the coordinates, or --restart")
    return found
