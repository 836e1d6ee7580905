"""The arguments of all commands."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from openmm_sier_command.options import OF_TUNING, add_options
from openmm_sier_command.parser import MISUSED, Parser, reading
from openmm_sier_command.values import COUNT, Number, Whole

if TYPE_CHECKING:
    from openmm_sier_command.parser import Commands

PROGRAM = "openmm-sier"

EXIT_CODES = """exit codes:
  0    done
  1    an error, in one line on standard error
  2    wrong arguments
  3    energy or temperature ran away, for example because the step is too long. The last good checkpoint is kept
  4    the run that --restart should continue is already complete
  129, 130, 143
       ended by SIGHUP, SIGINT (Ctrl-C) or SIGTERM after a completed step: all files are written, checkpoint included,
       and --restart goes on. A second signal ends the run at once
"""


class _Version(argparse.Action):
    """Looks up the version only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"{PROGRAM} {version(PROGRAM)}")
        parser.exit()


#: Commands of earlier versions that are studies now, and where.
MOVED = {
    "paper": "studies.paper",
    "equipartition": "studies.equipartition",
    "schemes": "studies.schemes",
    "acceptance": "studies.acceptance",
    "bench": "studies.bench",
    "study": "studies.step_study",
}


def build_parser() -> argparse.ArgumentParser:
    """The parser of `openmm-sier`. What it returns has the name of the command as `command`."""
    parser = Parser(prog=PROGRAM, description="Symplectic integration of rigid molecules with OpenMM.")
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for add in (_add_run, _add_ensemble, _add_properties, _add_validate, _add_tune, _add_info):
        added = add(commands)
        added.add_argument("--debug", action="store_true", help="show the traceback of an error (default: one line)")
    return parser


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """What a command line says.

    Raises:
        SystemExit: arguments are wrong, which has been said in one line; or `--help` or `--version` has been printed.
    """
    parser = build_parser()
    command, *_ = [*(sys.argv[1:] if arguments is None else arguments), ""]
    if command in MOVED:
        parser.exit(MISUSED, f"{PROGRAM}: {command} is now `python -m {MOVED[command]}` in a copy of the repository\n")
    return parser.parse_args(arguments)


def _add_run(commands: Commands) -> Parser:
    parser = commands.add_parser(
        "run",
        help="simulate a PDB file",
        description="Read a PDB file, equilibrate it at a temperature and simulate it at constant energy, temperature "
        "or pressure. Writes a trajectory of the atoms that the PDB file lists, a log (CSV) and a checkpoint, from "
        "which --restart goes on without a gap and --start begins a new run, in another ensemble say.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_options(parser)
    return parser


def _add_ensemble(commands: Commands) -> Parser:
    parser = commands.add_parser(
        "ensemble",
        help="carry out many runs, on this machine or on a cluster",
        description="Carry out a plan of many runs, each in a directory and a process of its own. What is complete is "
        "not done again, and what was cut off goes on from its checkpoint.",
    )
    parser.add_argument("plan", metavar="PLAN.toml", type=Path, help="options of the runs, and what varies among them")
    parser.add_argument("--out", metavar="DIR", type=Path, help="for the runs (default: the plan's name)")
    parser.add_argument(
        "--processes",
        metavar="N",
        type=reading(COUNT),
        help="at a time (default: one for each core that is there to use)",
    )
    parser.add_argument(
        "--threads",
        metavar="N",
        type=reading(COUNT),
        help="of each (default: 1; more if cores are left; with a scheduler 1, or OPENMM_CPU_THREADS of its workers)",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="of dask.distributed, whose workers take the runs (default: none)"
    )
    parser.add_argument(
        "--list", action="store_true", help="list the members and what is complete, and do nothing (default: no)"
    )
    return parser


def _add_runs(parser: argparse.ArgumentParser) -> None:
    """The arguments of commands that read runs."""
    parser.add_argument(
        "runs", metavar="RUN", type=Path, nargs="+", help="checkpoint of a run, or directory of an ensemble's member"
    )
    parser.add_argument(
        "--skip",
        metavar="PS",
        type=reading(Number("ps", 0, 1e9)),
        default=0.0,
        help="at the start of each (default: 0)",
    )


def _add_properties(commands: Commands) -> Parser:
    parser = commands.add_parser(
        "properties",
        help="density, energy, dielectric constant, diffusion and more from runs of a liquid",
        description="Properties of a liquid of one kind of molecule, from runs that differ in their seeds alone, with "
        "their standard errors and beside those of water. Writes a figure.",
    )
    _add_runs(parser)
    parser.add_argument("--box", metavar="BOX.pdb", type=Path, help="of the runs (default: the one in the checkpoint)")
    parser.add_argument(
        "--viscosity",
        metavar="MPA*S",
        type=reading(Number("mPa s", 0, 1e9, beyond=True)),
        help="of the same model: adds diffusion without the effect of the periodic box (default: that of the runs)",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("out"), help="for the figure (default: out)")
    return parser


def _add_validate(commands: Commands) -> Parser:
    parser = commands.add_parser(
        "validate",
        help="test whether runs sampled their ensembles, with physical_validation",
        description="Test the kinetic energies of runs by translation and rotation, their energies and volumes where "
        "two runs differ in temperature or pressure alone, and the order of the energy error where two runs at "
        "constant energy differ in their step. Runs that differ in their seeds alone count as one. Exit code 5 says "
        "that a check failed.",
    )
    _add_runs(parser)
    parser.add_argument(
        "--limit",
        metavar="N",
        type=reading(Number("", 0, 1e9, beyond=True)),
        default=4.0,
        help="standard errors beyond which a check fails (default: 4)",
    )
    return parser


def _add_tune(commands: Commands) -> Parser:
    parser = commands.add_parser(
        "tune",
        help="find step and trial length of hybrid Monte Carlo for a PDB file",
        description="Equilibrate a PDB file as `run --ensemble hmc` does, then find the step that has the wanted "
        "acceptance, beginning with --dt, and the number of steps in a trial that gives an independent potential "
        "energy for the fewest force evaluations. Writes no files: it prints the command line of a run.",
    )
    add_options(parser, OF_TUNING)
    parser.add_argument(
        "--acceptance",
        metavar="FRACTION",
        type=reading(Number("", 0.01, 0.99)),
        default=0.9,
        help="wanted fraction of accepted trials (default: 0.9)",
    )
    parser.add_argument(
        "--trials", metavar="N", type=reading(Whole(10)), default=40, help="at each step that is tried (default: 40)"
    )
    parser.add_argument(
        "--samples",
        metavar="N",
        type=reading(Whole(10)),
        default=200,
        help="trials of the first length, and for as many steps those of the other lengths (default: 200)",
    )
    return parser


def _add_info(commands: Commands) -> Parser:
    parser = commands.add_parser(
        "info",
        help="show what rigid bodies a PDB file has",
        description="Show the kinds of rigid body that a PDB file has.",
    )
    add_options(parser, ("box", "forcefield", "rigid", "constraints"))
    return parser
