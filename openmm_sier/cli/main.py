"""The arguments of `openmm-sier`. Each command has a module of its own, imported when it is needed."""

from __future__ import annotations

import argparse
import dataclasses
import signal
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeVar

from openmm_sier.cli import streams
from openmm_sier.cli.plan import RECOMMENDED, Options, usual_step
from openmm_sier.cli.values import any_number, not_negative, positive, whole
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.version import __version__

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    #: The action to which commands are added.
    Commands = argparse._SubParsersAction["Parser"]
    Settings = TypeVar("Settings", bound=DataclassInstance)

SCHEMES = tuple(CATALOGUE)

#: The keys of `measure.forcefields.CONSTRAINTS`, which are here without OpenMM.
CONSTRAINTS = ("none", "hbonds", "allbonds", "hangles")

#: Exit codes; further ones are an error's own `exit_code`, and 128 + n after signal n.
FAILED, MISUSED, SIGNALLED = 1, 2, 128

EXIT_CODES = """exit codes:
  0    done
  1    an error, in one line on standard error
  2    wrong arguments
  3    energy or temperature ran away, for example because the step is too long. The last good checkpoint is kept
  4    nothing is left of the run that --restart is to go on with
  129, 130, 143
       ended by SIGHUP, SIGINT (Ctrl-C) or SIGTERM after a completed step: all files are written, checkpoint included,
       and --restart goes on. A second signal ends the run at once
"""

RIGID_HELP = "names of residues, besides water, to be held rigid in the geometry that they have in the PDB file"

CONSTRAINTS_HELP = (
    "constraints besides those of water: of bonds of hydrogen, of all bonds, or of bonds and angles of hydrogens "
    "(default: none)"
)

FORCEFIELD_HELP = (
    "force-field files, OpenMM's or your own. Without it the file named in a record 'REMARK  99 FORCEFIELD file.xml' "
    "of the PDB file; without such a record the water model whose geometry the file has, if only one has it. Otherwise "
    "the error lists the models to choose from"
)

STEP_HELP = "step in fs (default: " + ", ".join(f"{usual_step(name):g} for {name}" for name in SCHEMES) + ")"


class UsageError(ValueError):
    """Arguments are wrong; the message begins with the command."""


class Parser(argparse.ArgumentParser):
    """Reports errors in one line."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{self.prog}: {message} (see {self.prog} --help)")


def main(arguments: list[str] | None = None) -> int:
    """Carry out a command line; returns the exit code."""
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
        # The reader of our output has gone, as `head` does: there is nobody to tell.
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
    for add in (
        _add_run,
        _add_ensemble,
        _add_properties,
        _add_info,
        _add_paper,
        _add_equipartition,
        _add_schemes,
        _add_acceptance,
        _add_bench,
    ):
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
    parser.add_argument("--scheme", choices=SCHEMES, help=f"default: {RECOMMENDED}")
    parser.add_argument("--dt", metavar="FS", type=positive, help=STEP_HELP)
    parser.add_argument("--ensemble", choices=("nve", "nvt", "npt", "hmc"), help="default: nve")
    parser.add_argument(
        "--friction",
        metavar="1/PS",
        type=not_negative,
        help="of the heat bath (default: 1; hmc draws all momenta for each trial without it)",
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


def _add_properties(commands: Commands) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        "properties",
        help="density, energy, dielectric constant, diffusion and more from runs of a liquid",
        description="Properties of a liquid of one kind of molecule, from runs that differ in their seeds alone, with "
        "their standard errors and beside those of water. Writes a figure.",
    )
    parser.add_argument(
        "runs", metavar="RUN", type=Path, nargs="+", help="checkpoint of a run, or directory of an ensemble's member"
    )
    parser.add_argument("--box", metavar="BOX.pdb", type=Path, help="default: the one that the run was of")
    parser.add_argument(
        "--skip", metavar="PS", type=not_negative, default=0.0, help="at the start of each (default: 0)"
    )
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


# --- paper ---


def _add_paper(commands: Commands) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        "paper",
        help="repeat the paper's experiments",
        description="Repeat the numerical experiments of van Zon and Schofield (2007).",
    )
    parser.add_argument("experiment", choices=("free-rotation", "dipole", "water", "all"))
    parser.add_argument("--quick", action="store_true", help="less of everything, to see it work")
    parser.add_argument("--out", metavar="DIR", type=Path, help="where tables and figures go")
    parser.add_argument("--seed", type=whole, default=1, help="default: 1")
    parser.set_defaults(execute=_paper)
    return parser


def _paper(options: argparse.Namespace) -> None:
    from openmm_sier.cli.console import REPORT
    from openmm_sier.studies import paper

    paper.run(options.experiment, options.quick, options.out, options.seed, REPORT)


# --- comparisons ---


def _add_comparison(commands: Commands, name: str, title: str, description: str) -> argparse.ArgumentParser:
    """A parser with the arguments that all comparisons of integrators share."""
    parser = commands.add_parser(name, help=title, description=description)
    parser.add_argument("box", metavar="BOX.pdb", type=Path, nargs="?", help="default: 512 molecules of TIP3P water")
    parser.add_argument("--forcefield", metavar="XML", nargs="+", help=FORCEFIELD_HELP)
    parser.add_argument("--platform", help="of OpenMM (default: the fastest)")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("out"), help="for the numbers and the figure")
    return parser


def _settings(cls: type[Settings], options: argparse.Namespace) -> Settings:
    """The settings of a comparison from the options of its command; what was not given keeps its default."""
    given = {field.name: getattr(options, field.name, None) for field in dataclasses.fields(cls)}
    given = {
        name: tuple(value) if isinstance(value, list) and name != "forcefield" else value
        for name, value in given.items()
        if value is not None
    }
    if "box" not in given:
        from openmm_sier.measure.forcefields import shipped_box

        given["box"] = shipped_box()
    return cls(**given)


def _add_equipartition(commands: Commands) -> argparse.ArgumentParser:
    parser = _add_comparison(
        commands,
        "equipartition",
        "compare the temperatures of rotation and translation",
        "T_trans, T_rot, mean potential energy and density with OpenMM's integrators and ours, at several steps.",
    )
    parser.add_argument("--dt", metavar="FS", type=positive, nargs="+", help="per force evaluation (default: 0.5 to 4)")
    parser.add_argument("--ensemble", choices=("nve", "nvt", "npt"), help="default: nve")
    parser.add_argument("--methods", metavar="NAME", nargs="+", help="default: all; see the error for a wrong one")
    parser.add_argument("--time", metavar="PS", type=positive, help="of each run (default: 20)")
    parser.add_argument("--replicas", type=whole, help="runs of each, with seeds that follow --seed (default: 1)")
    parser.add_argument(
        "--pool",
        metavar="DIR",
        type=Path,
        nargs="+",
        help="instead of runs: pool those of earlier --out directories",
    )
    parser.add_argument("--equilibrate", metavar="PS", type=positive, help="default: 10")
    parser.add_argument("--temperature", metavar="K", type=positive, help="default: 297")
    parser.add_argument("--friction", metavar="1/PS", type=positive, help="default: 1")
    parser.add_argument("--pressure", metavar="BAR", type=any_number, help="default: 1")
    parser.add_argument("--seed", type=whole, help="default: 1")
    parser.set_defaults(execute=_equipartition)
    return parser


def _equipartition(options: argparse.Namespace) -> None:
    from openmm_sier.cli.console import REPORT
    from openmm_sier.studies import equipartition

    if options.pool:
        if options.box is not None:
            raise ValueError(f"--pool reads what earlier runs wrote: it takes no box, got {options.box}")
        equipartition.pool(options.pool, options.out, REPORT)
    else:
        equipartition.run(_settings(equipartition.EquipartitionSettings, options), options.out, REPORT)


def _add_schemes(commands: Commands) -> argparse.ArgumentParser:
    parser = _add_comparison(
        commands,
        "schemes",
        "compare the energy conservation of all schemes",
        "Energy error and long-run drift of every scheme and of OpenMM's Verlet, against force evaluations per ps.",
    )
    parser.add_argument("--dt", metavar="FS", type=positive, nargs="+", help="per force evaluation (default: 1 to 2.5)")
    parser.add_argument("--time", metavar="PS", type=positive, help="of each run (default: 4)")
    parser.add_argument("--schemes", metavar="NAME", nargs="+", help="default: all; see the error for a wrong one")
    parser.add_argument("--seed", type=whole, help="default: 1")
    parser.set_defaults(execute=_schemes)
    return parser


def _schemes(options: argparse.Namespace) -> None:
    from openmm_sier.cli.console import REPORT
    from openmm_sier.studies import scheme_comparison

    scheme_comparison.run(_settings(scheme_comparison.SchemesSettings, options), options.out, REPORT)


def _add_acceptance(commands: Commands) -> argparse.ArgumentParser:
    parser = _add_comparison(
        commands,
        "acceptance",
        "measure the acceptance of hybrid Monte Carlo against the number of molecules",
        "Energy errors of trajectories and their acceptance with every scheme, and with Verlet by RATTLE, in boxes of "
        "several sizes. Boxes and trials are kept in --out as they are done, and are not made again. The default takes "
        "an hour or two of one core.",
    )
    parser.add_argument("--sizes", metavar="N", type=whole, nargs="+", help="in molecules (default: 64 512 4096 32768)")
    parser.add_argument("--schemes", metavar="NAME", nargs="+", help="default: all; see the error for a wrong one")
    parser.add_argument("--dt", metavar="FS", type=positive, nargs="+", help="per force evaluation (default: 2)")
    parser.add_argument(
        "--trials", metavar="N", type=whole, nargs="+", help="of each, or for each size (default: 400 to 10)"
    )
    parser.add_argument("--time", metavar="PS", type=positive, help="of a trajectory (default: 0.06)")
    parser.add_argument("--equilibrate", metavar="PS", type=positive, help="at each size (default: 1)")
    parser.add_argument("--temperature", metavar="K", type=positive, help="default: 297")
    parser.add_argument("--seed", type=whole, help="default: 1")
    parser.set_defaults(execute=_acceptance)
    return parser


def _acceptance(options: argparse.Namespace) -> None:
    from openmm_sier.cli.console import REPORT
    from openmm_sier.studies import acceptance

    acceptance.run(_settings(acceptance.AcceptanceSettings, options), options.out, REPORT)


def _add_bench(commands: Commands) -> argparse.ArgumentParser:
    parser = _add_comparison(
        commands,
        "bench",
        "measure what a step and what accuracy cost",
        "Cost of a step over that of its forces and over OpenMM's integrators, of the free rotation and of the layer "
        "above the forces alone; energy error against cost, beside LAMMPS (lmp) and GROMACS (gmx) where they are on "
        "the PATH. Takes some 10 minutes of two cores; --parts and --copies make it shorter. With --platform, instead: "
        "steps and forces per second, cost over the forces, and simulated time per second at equal energy error on "
        "that platform, by --molecules.",
    )
    parser.add_argument("--parts", nargs="+", help="of steps, rotations, layer, accuracy (default: all)")
    parser.add_argument("--copies", type=whole, nargs="+", help="of the box along each edge (default: 1 2 4)")
    parser.add_argument(
        "--molecules", type=whole, nargs="+", help="with --platform: multiples of the box (default: 512 to 98304)"
    )
    parser.add_argument("--bodies", type=whole, nargs="+", help="without forces (default: 512 4096 32768 131072)")
    parser.add_argument("--rounds", type=whole, help="default: 8")
    parser.add_argument("--time", metavar="PS", type=positive, help="of runs for the energy error (default: 1)")
    parser.add_argument("--seed", type=whole, help="default: 1")
    parser.set_defaults(execute=_bench)
    return parser


def _bench(options: argparse.Namespace) -> None:
    from openmm_sier.cli.console import REPORT
    from openmm_sier.studies import bench

    bench.run(_settings(bench.BenchSettings, options), options.out, REPORT)


if __name__ == "__main__":
    sys.exit(main())
