"""The arguments of `openmm-sier`. Each command has a module of its own, imported when it is needed."""

from __future__ import annotations

import argparse
import dataclasses
import signal
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from openmm_sier.cli import streams
from openmm_sier.cli.methods import METHODS, RECOMMENDED
from openmm_sier.cli.parser import FORCEFIELD_HELP, Parser, UsageError
from openmm_sier.cli.plan import Options
from openmm_sier.cli.values import any_number, not_negative, positive, whole
from openmm_sier.version import __version__

if TYPE_CHECKING:
    from openmm_sier.cli.parser import Commands

#: The keys of `measure.forcefields.CONSTRAINTS`, repeated here so that OpenMM is not imported.
CONSTRAINTS = ("none", "hbonds", "allbonds", "hangles")

#: Exit codes. An error may have its own `exit_code`, and after signal n the code is 128 + n.
FAILED, MISUSED, SIGNALLED = 1, 2, 128

#: Commands of earlier versions that are studies now, which are in the repository and not installed.
MOVED = {
    "paper": "studies.paper",
    "equipartition": "studies.equipartition",
    "schemes": "studies.schemes",
    "acceptance": "studies.acceptance",
    "bench": "studies.bench",
    "study": "studies.step_study",
}

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

RIGID_HELP = "names of residues, besides water, to be held rigid in the geometry that they have in the PDB file"

CONSTRAINTS_HELP = (
    "constraints besides those of water: of bonds to hydrogen, of all bonds, or of bonds and angles of hydrogens "
    "(default: none)"
)

SCHEME_HELP = (
    f"scheme of this package (default: {RECOMMENDED}), or for comparison one of OpenMM's own integrators: verlet, with "
    "an AndersenThermostat at constant temperature, or langevinmiddle; MonteCarloBarostat keeps their pressure"
)

STEP_HELP = (
    "step in fs (default: " + ", ".join(f"{method.usual_step:g} for {key}" for key, method in METHODS.items()) + ")"
)


def main(arguments: list[str] | None = None) -> int:
    """Execute a command line and return the exit code."""
    command, *_ = [*(sys.argv[1:] if arguments is None else arguments), ""]
    if command in MOVED:
        print(
            f"{streams.PROGRAM}: {command} is now `python -m {MOVED[command]}` in a copy of the repository",
            file=sys.stderr,
        )
        sys.exit(MISUSED)
    try:
        options = build_parser().parse_args(arguments)
    except UsageError as error:
        print(error, file=sys.stderr)
        sys.exit(MISUSED)
    if not streams.open_closed_streams():
        streams.complain("standard output is closed; send it to a file, or to /dev/null")
        return FAILED
    try:
        with warnings.catch_warnings():
            warnings.showwarning = streams.note_warning
            options.execute(options)
    except KeyboardInterrupt as stop:
        streams.complain(str(stop) or "interrupted")
        return SIGNALLED + getattr(stop, "signum", signal.SIGINT)
    except BrokenPipeError:
        # Whatever read our output has ended, as `head` does: there is nobody to tell.
        streams.discard(sys.stdout)
        streams.discard(sys.stderr)
        return FAILED
    except Exception as error:
        if options.debug:
            raise
        streams.complain(streams.described(error))
        return getattr(error, "exit_code", FAILED)
    return 0


def build_parser() -> argparse.ArgumentParser:
    parser = Parser(prog=streams.PROGRAM, description="Symplectic integration of rigid molecules with OpenMM.")
    parser.add_argument("--version", action="version", version=f"{streams.PROGRAM} {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (_add_run, _add_ensemble, _add_properties, _add_validate, _add_info):
        added = add(commands)
        added.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


# --- run ---


def _add_run(commands: Commands) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        "run",
        help="simulate a PDB file",
        description="Read a PDB file, equilibrate it at a temperature and simulate it at constant energy, temperature "
        "or pressure. Writes a trajectory of the atoms that the PDB file lists, a log (CSV) and a checkpoint, from "
        "which --restart goes on without a gap and --start begins a new run, in another ensemble say.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "box", metavar="BOX.pdb", type=Path, help="whole molecules with hydrogens; virtual sites are added"
    )
    parser.add_argument("--forcefield", metavar="XML", nargs="+", help=FORCEFIELD_HELP)
    parser.add_argument("--rigid", metavar="RESIDUE", nargs="+", help=RIGID_HELP)
    parser.add_argument("--constraints", choices=CONSTRAINTS, help=CONSTRAINTS_HELP)
    parser.add_argument("--scheme", choices=tuple(METHODS), help=SCHEME_HELP)
    parser.add_argument("--dt", metavar="FS", type=positive, help=STEP_HELP)
    parser.add_argument("--ensemble", choices=("nve", "nvt", "npt", "hmc"), help="default: nve; nvt for langevinmiddle")
    parser.add_argument(
        "--friction",
        metavar="1/PS",
        type=not_negative,
        help="of the heat bath, or the rate of collisions of verlet (default: 1; hmc draws all momenta for each trial "
        "without it)",
    )
    parser.add_argument(
        "--pressure", metavar="BAR", type=any_number, help="with npt (default: 1) or hmc (default: constant volume)"
    )
    parser.add_argument(
        "--steps-per-trial",
        metavar="N",
        type=whole,
        help="with hmc, after which files are written (default: 10)",
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        "--steps", type=whole, help="length of the whole trajectory, of which a restart does what is left"
    )
    length.add_argument("--time", metavar="PS", type=positive, help="the same in ps (default: 10)")
    parser.add_argument(
        "--temperature", metavar="K", type=not_negative, help="default: 297, or that of the run of --start"
    )
    parser.add_argument(
        "--equilibrate",
        metavar="PS",
        type=not_negative,
        help="how long (default: until temperatures and potential energy have settled, 3 to 20; not at all with "
        "--start)",
    )
    parser.add_argument(
        "--minimize",
        action=argparse.BooleanOptionalAction,
        help="minimize the energy first (default: if the start has forces that a liquid has not)",
    )
    parser.add_argument("--out", metavar="FILE", type=Path, help="trajectory, .dcd, .xtc or .h5 (default: BOX.dcd)")
    parser.add_argument(
        "--unwrapped", action="store_true", default=None, help="frames have molecules where they went, not in the box"
    )
    parser.add_argument("--report", metavar="CSV", type=Path, help="log (default: as the trajectory, with .csv)")
    parser.add_argument("--every", metavar="PS", type=positive, help="between frames (default: 0.1)")
    parser.add_argument("--report-every", metavar="PS", type=positive, help="between rows of the log (default: 0.04)")
    parser.add_argument("--checkpoint-every", metavar="PS", type=positive, help="between checkpoints (default: 1)")
    parser.add_argument(
        "--bodies", metavar="FILE.h5", type=Path, help="write centres, quaternions and momenta of the bodies there"
    )
    parser.add_argument("--bodies-every", metavar="PS", type=positive, help="between them (default: as --every)")
    parser.add_argument(
        "--pressure-tensor", metavar="CSV", type=Path, help="write the molecular pressure tensor there, for viscosity"
    )
    parser.add_argument(
        "--pressure-tensor-every",
        metavar="PS",
        type=positive,
        help="between rows of it, each of which costs 12 energies (default: 0.02)",
    )
    parser.add_argument("--seed", type=whole, help="of velocities, equilibration and heat bath (default: 1)")
    parser.add_argument("--platform", help="of OpenMM (default: the fastest)")
    parser.add_argument(
        "--start",
        metavar="FILE",
        type=Path,
        help="checkpoint (.chk) of any run, whose positions, velocities and box a new run begins with; unless given, "
        "--forcefield, --rigid and --temperature are those of that run",
    )
    parser.add_argument("--restart", metavar="FILE", type=Path, help="checkpoint (.chk) to go on from")
    parser.add_argument("--overwrite", action="store_true", help="replace files of an earlier run")
    parser.set_defaults(execute=_run)
    return parser


def _run(options: argparse.Namespace) -> None:
    from openmm_sier.cli import run

    run.run(Options(**{field.name: getattr(options, field.name) for field in dataclasses.fields(Options)}))


# --- ensemble ---


def _add_ensemble(commands: Commands) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        "ensemble",
        help="carry out many runs, on this machine or on a cluster",
        description="Carry out a plan of many runs, each in a directory and a process of its own. What is complete is "
        "not done again, and what was cut off goes on from its checkpoint.",
    )
    parser.add_argument("plan", metavar="PLAN.toml", type=Path, help="options of the runs, and what varies among them")
    parser.add_argument("--out", metavar="DIR", type=Path, help="for the runs (default: the plan's name)")
    parser.add_argument("--processes", metavar="N", type=whole, help="at a time (default: one for each core)")
    parser.add_argument("--threads", metavar="N", type=whole, help="of each (default: 1; more if cores are left)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="of dask.distributed, whose workers take the runs")
    parser.add_argument("--list", action="store_true", help="list the members and what is complete, and do nothing")
    parser.set_defaults(execute=_ensemble)
    return parser


def _ensemble(options: argparse.Namespace) -> None:
    from openmm_sier.cli import ensembles

    ensembles.run(options.plan, options.out, options.processes, options.threads, options.scheduler, options.list)


# --- properties ---


def _add_runs(parser: argparse.ArgumentParser) -> None:
    """The arguments of commands that read runs."""
    parser.add_argument(
        "runs", metavar="RUN", type=Path, nargs="+", help="checkpoint of a run, or directory of an ensemble's member"
    )
    parser.add_argument(
        "--skip", metavar="PS", type=not_negative, default=0.0, help="at the start of each (default: 0)"
    )


def _add_properties(commands: Commands) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        "properties",
        help="density, energy, dielectric constant, diffusion and more from runs of a liquid",
        description="Properties of a liquid of one kind of molecule, from runs that differ in their seeds alone, with "
        "their standard errors and beside those of water. Writes a figure.",
    )
    _add_runs(parser)
    parser.add_argument("--box", metavar="BOX.pdb", type=Path, help="default: the one that the run was of")
    parser.add_argument(
        "--viscosity",
        metavar="MPA*S",
        type=positive,
        help="of the same model: adds diffusion without the effect of the periodic box",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("out"), help="for the figure")
    parser.set_defaults(execute=_properties)
    return parser


def _properties(options: argparse.Namespace) -> None:
    from openmm_sier.cli import properties

    properties.properties_of(options.runs, options.box, options.skip, options.viscosity, options.out)


# --- validate ---


def _add_validate(commands: Commands) -> argparse.ArgumentParser:
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
        type=positive,
        default=4.0,
        help="standard errors beyond which a check fails (default: 4)",
    )
    parser.set_defaults(execute=_validate)
    return parser


def _validate(options: argparse.Namespace) -> None:
    from openmm_sier.cli import validate

    validate.validate(options.runs, options.skip, options.limit)


# --- info ---


def _add_info(commands: Commands) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        "info",
        help="show what rigid bodies a PDB file has",
        description="Show the kinds of rigid body that a PDB file has.",
    )
    parser.add_argument("box", metavar="BOX.pdb", type=Path)
    parser.add_argument("--forcefield", metavar="XML", nargs="+", help=FORCEFIELD_HELP)
    parser.add_argument("--rigid", metavar="RESIDUE", nargs="+", help=RIGID_HELP)
    parser.add_argument("--constraints", choices=CONSTRAINTS, help=CONSTRAINTS_HELP)
    parser.set_defaults(execute=_info)
    return parser


def _info(options: argparse.Namespace) -> None:
    from openmm_sier.cli import info

    info.info(options.box, options.forcefield, options.rigid, options.constraints)


if __name__ == "__main__":
    sys.exit(main())
