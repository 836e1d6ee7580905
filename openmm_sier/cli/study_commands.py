"""The arguments of the commands that carry out studies."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from openmm_sier.cli.parser import FORCEFIELD_HELP
from openmm_sier.cli.values import any_number, positive, whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from openmm_sier.cli.parser import Commands

    Settings = TypeVar("Settings", bound=DataclassInstance)


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
    parser.add_argument(
        "--processes", metavar="N", type=whole, help="for the runs of water, at a time (default: the cores)"
    )
    parser.add_argument(
        "--phase-point", metavar="NAME", help="the runs of water from one of its starts alone, as in pme-3"
    )
    parser.set_defaults(execute=_paper)
    return parser


def _paper(options: argparse.Namespace) -> None:
    from openmm_sier.cli.console import REPORT
    from studies import paper

    if options.phase_point is None:
        paper.run(options.experiment, options.quick, options.out, options.seed, REPORT, options.processes)
    elif options.experiment == "water":
        paper.run_phase_point(options.phase_point, options.quick, options.out or Path(), options.seed, REPORT)
    else:
        raise ValueError(f"--phase-point needs the experiment water, got {options.experiment}")


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
    from studies import equipartition

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
    from studies import schemes

    schemes.run(_settings(schemes.SchemesSettings, options), options.out, REPORT)


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
    from studies import acceptance

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
    from studies import bench

    bench.run(_settings(bench.BenchSettings, options), options.out, REPORT)


#: Functions that add the commands.
ADDED = (_add_paper, _add_equipartition, _add_schemes, _add_acceptance, _add_bench)
