"""The command `openmm-sier ensemble`: a plan in TOML, and its members on a pool of processes or on dask's workers.

A plan names the options of `openmm-sier run` that all members share, and the values of those that vary:

    [options]
    time = 20
    ensemble = "npt"
    [members]
    box = ["spce-512.pdb", "tip3p-512.pdb"]
    scheme = ["sier2", "sier4g"]
    seed = [1, 2, 3]

Members are all combinations, here twelve. Several tables [[members]] add up, for example for methods that each have
their own steps. Files are looked for beside the plan, then among the project's own boxes, then under the given path.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from concurrent.futures import Executor
from itertools import product
from pathlib import Path
from typing import Any

from openmm_sier.cli import main
from openmm_sier.cli.console import REPORT, note, table
from openmm_sier.measure.ensemble import EnsembleError, Member, Outcome, ensemble, is_complete
from openmm_sier.measure.forcefields import SHIPPED

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: Tables of a plan.
KEYS = ("options", "members")

#: Options that the ensemble itself sets.
TAKEN = ("out", "restart", "overwrite")


class PlanError(ValueError):
    """No ensemble can be made from a plan."""


def run(
    plan: Path, out: Path | None, processes: int | None, threads: int | None, scheduler: str | None, only_list: bool
) -> None:
    """Run `openmm-sier ensemble`.

    Raises:
        PlanError, EnsembleError, OSError: as their messages say.
    """
    members = read_plan(plan)
    directory = out or plan.with_suffix("")
    complete = [is_complete(member, directory) for member in members]
    note(f"{plan}: {len(members)} members in {directory}, {sum(complete)} of them complete")
    if only_list:
        rows = [[m.name, "complete" if done else ""] for m, done in zip(members, complete, strict=True)]
        table(str(plan), ("member", ""), rows, 2)
        return
    if scheduler is not None and processes is not None:
        raise PlanError("--processes is for this machine: the workers of --scheduler take as many as they are told")
    executor = None if scheduler is None else _workers(scheduler)
    try:
        outcomes = ensemble(members, directory, executor, processes, threads, REPORT)
    except EnsembleError as error:
        _tell(error.outcomes)
        raise
    _tell(outcomes)


def _tell(outcomes: list[Outcome] | tuple[Outcome, ...]) -> None:
    rows = [[o.name, o.error or "complete", str(o.restarts), f"{o.seconds:.1f}"] for o in outcomes]
    table("Members", ("member", "", "restarts", "s"), rows, 2)


def _workers(address: str) -> Executor:
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        message = "--scheduler needs dask.distributed; install it with: pip install 'openmm-sier[cluster]'"
        raise ModuleNotFoundError(message) from error
    # The result of a member does not depend on its arguments alone, but also on the files that it already has.
    return Client(address).get_executor(pure=False)


# --- the plan ---


def read_plan(path: Path) -> list[Member]:
    """The members of a plan.

    Raises:
        PlanError: an option is unknown, has a wrong value, or is set by the ensemble itself; or two members have the
            same name.
        OSError: the file cannot be read.
    """
    try:
        plan = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise PlanError(f"{path} is no TOML file: {error}") from None
    if unknown := sorted(set(plan) - set(KEYS)):
        raise PlanError(f"{path}: expected {', '.join(KEYS)}, got {', '.join(unknown)}")
    shared, tables = plan.get("options", {}), plan.get("members", {})
    tables = tables if isinstance(tables, list) else [tables]
    if not all(isinstance(table, dict) for table in (shared, *tables)):
        raise PlanError(f"{path}: options and members are tables, [options] and [members]")
    members = [member for table in tables for member in _combinations(path, shared, table)]
    names = [member.name for member in members]
    if len(set(names)) < len(names):
        raise PlanError(
            f"{path}: more than one member is called {max(names, key=names.count)}: names have the values of lists, so "
            "what differs between members must be in lists"
        )
    return members


def _combinations(path: Path, shared: dict[str, Any], table: dict[str, Any]) -> list[Member]:
    """All members of one table: its lists vary, and its other values are options of all its members."""
    for key, value in table.items():
        if value == []:
            raise PlanError(f"{path}: {key} in [members] must have values, got an empty list")
        if key in shared:
            raise PlanError(f"{path}: {key} is in [options] and in [members]")
    for key in (*shared, *table):
        if key.replace("_", "-") in TAKEN:
            raise PlanError(f"{path}: {key} is set by the ensemble for each member: leave it out")
    axes = {key: values for key, values in table.items() if isinstance(values, list)}
    fixed = shared | {key: value for key, value in table.items() if key not in axes}
    return [
        _member(path, fixed | dict(zip(axes, values, strict=True)), list(axes)) for values in product(*axes.values())
    ]


def _member(path: Path, options: Mapping[str, Any], varied: list[str]) -> Member:
    arguments = ["run"]
    if "box" in options:
        arguments.append(_text(path, options["box"]))
    for key, value in options.items():
        if key != "box":
            arguments += _option(path, key, value)
    settings = _parsed(path, arguments)
    # The command line accepts abbreviated options, but a plan is kept and read again.
    if short := [key for key in options if key.replace("-", "_") not in vars(settings)]:
        raise PlanError(f"{path}: run has no option {', '.join(short)}")
    name = "-".join(_label(key, options[key]) for key in varied) or "run"
    return Member(name, tuple(arguments), settings.time or 0.0)


def _option(path: Path, key: str, value: Any) -> list[str]:
    name = f"--{key.replace('_', '-')}"
    if value is True:
        return [name]
    if value is False:
        return [f"--no-{name[2:]}"]
    return [name, *(_text(path, item) for item in (value if isinstance(value, list) else [value]))]


def _text(path: Path, value: Any) -> str:
    """A value as an argument; files by their absolute path, since members have directories of their own."""
    if isinstance(value, str):
        for directory in (path.parent, *SHIPPED):
            if (directory / value).is_file():
                return str((directory / value).resolve())
    return str(value)


def _parsed(path: Path, arguments: list[str]) -> argparse.Namespace:
    """The arguments as the command takes them."""
    try:
        return main.build_parser().parse_args(arguments)
    except main.UsageError as error:
        raise PlanError(f"{path}: {error}") from None


def _label(key: str, value: Any) -> str:
    """A part of a member's name: what varies, in characters that every file system accepts."""
    text = Path(value).stem if isinstance(value, str) else str(value)
    text = "".join(c if c.isalnum() or c in "._" else "_" for c in text)
    return text if key in ("box", "scheme", "ensemble") else f"{key}{text}"
