"""The command `openmm-sier ensemble`: a plan in TOML, and its members on a pool of processes or on dask's workers.

`docs/guide/command.md` says what a plan is. Files that runs read are looked for beside it, then among the project's.
"""

from __future__ import annotations

import sys
from concurrent.futures import Executor
from itertools import product
from pathlib import Path
from typing import Any

from openmm_sier.cli import streams
from openmm_sier.cli.console import REPORT, note, table
from openmm_sier.cli.files import checkpoints, records
from openmm_sier.cli.files.locks import FileLocks
from openmm_sier.cli.member import CHECKPOINT
from openmm_sier.cli.options import OPTIONS, OptionError, Options, check_table
from openmm_sier.cli.plan import RunError, new_plan, noted_plan
from openmm_sier.cli.pool import EnsembleError, Member, Outcome, ensemble, is_complete
from openmm_sier.measure.forcefields import SHIPPED
from openmm_sier.measure.inputs import fingerprints, source_of
from openmm_sier.measure.pdb_files import ForceFieldError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: Tables of a plan, and the command that its members execute.
KEYS, COMMAND = ("options", "members"), "run"

#: Options that the ensemble itself sets.
TAKEN = ("out", "restart", "overwrite")


class PlanError(ValueError):
    """No ensemble can be made from a plan."""


def run_plan(
    plan: Path, out: Path | None, processes: int | None, threads: int | None, scheduler: str | None, list: bool
) -> None:
    """Run `openmm-sier ensemble`.

    Raises:
        PlanError, EnsembleError, OSError: as their messages say.
        RunError: another process carries out an ensemble in the same directory, or a file that its members read was
            edited since.
    """
    members = read_plan(plan)
    directory = out or plan.with_suffix("")
    complete = [is_complete(member, directory) for member in members]
    note(f"{plan}: {len(members)} members in {directory}, {sum(complete)} of them complete")
    if list:
        rows = [[m.name, "complete" if done else ""] for m, done in zip(members, complete, strict=True)]
        table(str(plan), ("member", ""), rows, 2)
        return
    for member in members:
        _refuse_edited(directory / member.name / CHECKPOINT)
    if scheduler is not None and processes is not None:
        raise PlanError("--processes is for this machine: the workers of --scheduler take as many as they are told")
    executor = None if scheduler is None else _workers(scheduler)
    directory.mkdir(parents=True, exist_ok=True)
    with FileLocks() as locks:
        locks.hold([directory / "members"])
        try:
            outcomes = ensemble(members, directory, executor, processes, threads, REPORT)
        except EnsembleError as error:
            _list_outcomes(error.outcomes)
            raise
    _list_outcomes(outcomes)


def _refuse_edited(checkpoint: Path) -> None:
    """Refuse to add to members whose files were edited since, so that no ensemble holds runs of two systems."""
    try:
        notes = checkpoints.read_notes(checkpoint)
        plan = noted_plan(checkpoint, notes["plan"])
    except (OSError, records.RecordError, OptionError, KeyError):
        # There is none yet, or it is damaged, which its member finds.
        return
    for use, digest in notes.get("inputs", {}).items():
        place = source_of(use, plan.box, plan.topology)
        if place.is_file() and fingerprints({use: place}) != {use: digest}:
            raise RunError(
                f"{place} was edited since {checkpoint} was written: name another directory by --out, or remove that "
                "of this member"
            )


def _list_outcomes(outcomes: list[Outcome] | tuple[Outcome, ...]) -> None:
    rows = [[o.name, o.error or "complete", str(o.restarts), f"{o.seconds:.1f}"] for o in outcomes]
    table("Members", ("member", "", "restarts", "s"), rows, 2)


def _workers(address: str) -> Executor:
    from distributed import Client

    # The result of a member does not depend on its arguments alone, but also on the files that it already has.
    return Client(address).get_executor(pure=False)


# --- the plan ---


def read_plan(path: Path) -> list[Member]:
    """The members of a plan.

    Raises:
        PlanError, OptionError: an option is unknown, has a wrong value, or is set by the ensemble itself; there is no
            such box; or two members have the same name.
        OSError: the file cannot be read.
    """
    try:
        plan = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise PlanError(f"{path} is no TOML file: {error}") from None
    if unknown := sorted(set(plan) - set(KEYS)):
        raise PlanError(f"{path}: expected {', '.join(KEYS)}, got {', '.join(unknown)}")
    shared, tables = plan.get("options", {}), plan.get("members", {})
    tables = tables if isinstance(tables, list) else [tables]
    if not all(isinstance(table, dict) for table in (shared, *tables)):
        raise PlanError(f"{path}: options and members are tables, [options] and [members]")
    shared, *tables = ({key.replace("-", "_"): value for key, value in table.items()} for table in (shared, *tables))
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
        if key in TAKEN:
            raise PlanError(f"{path}: {key} is set by the ensemble for each member: leave it out")
    axes = {key: values for key, values in table.items() if isinstance(values, list)}
    fixed = shared | {key: value for key, value in table.items() if key not in axes}
    return [
        _member(path, fixed | dict(zip(axes, values, strict=True)), list(axes)) for values in product(*axes.values())
    ]


def _member(path: Path, options: dict[str, Any], varied: list[str]) -> Member:
    # A single name may stand for a list of one.
    options = {
        key: [value] if key in OPTIONS and OPTIONS[key].kind.each and not isinstance(value, list) else value
        for key, value in options.items()
    }
    check_table(str(path), options)
    if "box" not in options:
        raise PlanError(f"{path}: box is missing")
    options = {
        key: _found(path, value) if OPTIONS[key].kind.file == "input" else value for key, value in options.items()
    }
    box = options["box"]
    if not (Path(box).is_absolute() and Path(box).is_file()):
        raise PlanError(f"{path}: box {box} is neither a file beside the plan nor one of the project's own boxes")
    checked = check_table(str(path), options)
    try:
        new_plan(Options(**checked))
    except (RunError, ForceFieldError, FileNotFoundError) as error:
        raise PlanError(f"{path}: {streams.described(error)}") from None
    for key, value in checked.items():
        if OPTIONS[key].kind.file == "output" and len(value.parts) != 1:
            raise PlanError(f"{path}: {key}: outputs lie in the directory of each member: give a name alone")
    arguments = [COMMAND, box]
    for key, value in options.items():
        if key != "box":
            arguments += OPTIONS[key].words(value)
    name = "-".join(_label(key, options[key]) for key in varied) or COMMAND
    return Member(name, tuple(arguments), checked.get("time") or 0.0)


def _found(path: Path, name: Any) -> Any:
    """The absolute path of a file beside the plan or among the project's own; otherwise the name, of OpenMM's files.

    Members have directories of their own, where a relative path means another file. Of a list, all of them.
    """
    if isinstance(name, list):
        return [_found(path, each) for each in name]
    for directory in (path.parent, *SHIPPED):
        if (directory / name).is_file():
            return str((directory / name).resolve())
    return name


def _label(key: str, value: Any) -> str:
    """A part of a member's name: what varies, in characters that every file system accepts."""
    values = value if isinstance(value, list) else [value]
    text = "_".join(Path(item).stem if isinstance(item, str) else str(item) for item in values)
    text = "".join(c if c.isalnum() or c in "._" else "_" for c in text)
    # Names that begin with a dot are hidden, or lead elsewhere.
    text = "_" * (len(text) - len(text.lstrip("."))) + text.lstrip(".")
    return text if key in ("box", "scheme", "ensemble") else f"{key}{text}"
