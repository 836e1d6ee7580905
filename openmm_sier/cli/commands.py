"""The commands of `openmm-sier` with their options. `command_line.py` describes them."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from openmm_sier.cli.many.seeds import read_seeds
from openmm_sier.cli.settings import InputSettings, RunSettings, TrialSettings
from openmm_sier.inputs.completion import FILES, PADDING, PH, SALT

#: The fields of a model are options of the command.
FLAT = Parameter(name="*")

Overwrite = Annotated[bool, Parameter(negative="", help="replace existing files (default: refuse to)")]

Debug = Annotated[bool, Parameter(negative="", help="show the traceback of an error (default: one line)")]


def _in_words(default: str, of: str, **limits: Any) -> Parameter:
    return Parameter(help=f"{of} (default: {default})", validator=Number(**limits) if limits else None)


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
    from openmm_sier.cli import run as command

    command.execute(settings, config, None if seeds is None else read_seeds(seeds), workers, scheduler)


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
    from openmm_sier.cli import setup as command

    command.execute(structure, out, forcefield, shape, padding, salt, ph, leave_out, ends, seed, overwrite)


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
    from openmm_sier.cli import tune as command

    command.execute(settings, acceptance, trials)


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
    from openmm_sier.cli import summary as command

    command.execute(logs, json, plot, skip, overwrite)


def info(settings: Annotated[InputSettings, FLAT] = InputSettings(), *, debug: Debug = False) -> None:
    from openmm_sier.cli import info as command

    command.execute(settings)
