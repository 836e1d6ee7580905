"""The output files of a run: their paths, checks before they are written, and the steps at which they are due."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.cli.files import records, trajectories
from openmm_sier.cli.files.body_states import BodyStates
from openmm_sier.cli.plan import FILES, Plan, RunError
from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.measure.forcefields import Box
from openmm_sier.observe import pressure
from openmm_sier_command.options import CONTINUED

#: Names of outputs that grow in the notes of a checkpoint, by kind.
NOTED_AS = {"trajectory": "trajectory", "log": "log", "body states": "bodies", "pressure tensor": "tensors"}


def output_paths(plan: Plan, checkpoint: Path) -> dict[str, Path]:
    """The output files of a run by kind, the checkpoint first.

    Raises:
        RecordError: a name has the wrong ending, or a package that its format needs is missing.
        ModuleNotFoundError: a package that body states need is missing.
    """
    trajectories.trajectory_format(Path(plan.out))
    paths = {"checkpoint": checkpoint, "trajectory": Path(plan.out), "log": Path(plan.report)}
    if plan.bodies:
        BodyStates.check_possible(Path(plan.bodies))
        paths["body states"] = Path(plan.bodies)
    if plan.pressure_tensor:
        paths["pressure tensor"] = Path(plan.pressure_tensor)
    return paths


def _growing(paths: Mapping[str, Path]) -> dict[str, type[records.GrowingFile]]:
    """The outputs that grow, all but the checkpoint, by kind."""
    formats = {"trajectory": trajectories.trajectory_format(paths["trajectory"]), "body states": BodyStates}
    return {kind: formats.get(kind, records.Log) for kind in paths if kind != "checkpoint"}


def files_of(paths: Mapping[str, Path]) -> dict[str, Path]:
    """All files that a run writes, its temporary ones too, by a name for messages, the checkpoint first."""
    companions = {kind: made.companions(paths[kind]) for kind, made in _growing(paths).items()}
    companions["checkpoint"] = [records.temporary_checkpoint(paths["checkpoint"])]
    return {
        f"{kind} {path}" if place == path else f"{kind} {path}, by way of {place}": place
        for kind, path in paths.items()
        for place in (path, *companions[kind])
    }


def is_finished(paths: Mapping[str, Path]) -> bool:
    """Whether all outputs of a run are there and nothing is left to be done for them."""
    return not any(made.unfinished(paths[kind]) for kind, made in _growing(paths).items())


def check_belonging(paths: Mapping[str, Path], notes: Mapping[str, Any]) -> dict[str, records.Noted]:
    """Refuse outputs that are not those of the run whose checkpoint is to be continued, before any is changed.

    Returns:
        What the checkpoint notes of them, by kind.

    Raises:
        RecordError: an output is missing, or is of another run; or the checkpoint lacks what tells them apart.
    """
    noted = {}
    for kind, made in _growing(paths).items():
        if (name := NOTED_AS[kind]) not in notes:
            raise records.RecordError(f"{paths['checkpoint']}: {name} is missing, what is noted of {paths[kind]}")
        noted[kind] = records.Noted(**notes[name])
        made.check(paths[kind], noted[kind], notes["run"])
    return noted


def run_identity(plan: Plan, context: openmm.Context) -> str:
    """Identity of a run that is to begin: a digest of its settings and of its first phase point.

    It is not drawn at random, so that the same run gives the same bytes again. Runs with one identity are one run, and
    differ in their length alone.
    """
    settings = {name: getattr(plan, name) for name in CONTINUED if name not in FILES}
    state = context.getState(positions=True, velocities=True)
    digest = hashlib.blake2b(json.dumps(settings, default=str).encode(), digest_size=16)
    for values in (
        state.getPositions(asNumpy=True),
        state.getVelocities(asNumpy=True),
        state.getPeriodicBoxVectors(asNumpy=True),
    ):
        digest.update(np.asarray(values._value, dtype=float).tobytes())
    return digest.hexdigest()


def check_outputs(paths: Mapping[str, Path], inputs: Iterable[Path]) -> None:
    """Refuse outputs that cannot be written, and any that would destroy an input or another output.

    Args:
        paths: as `output_paths` gives them.
        inputs: files that are read.

    Raises:
        RunError: naming the file.
    """
    everything = files_of(paths)
    inputs = list(inputs)
    for what, path in everything.items():
        for other in inputs:
            if same_file(path, other):
                raise RunError(f"the {what} would destroy the input {other}: name another file")
    for (one, path), (two, other) in combinations(everything.items(), 2):
        if same_file(path, other):
            raise RunError(f"the {two} would be the same file as the {one}: outputs must be different files")
    for path in everything.values():
        _check_writable(path)


def check_existing(paths: Mapping[str, Path], existing: str) -> None:
    """Refuse files that are in the way.

    Args:
        paths: as `output_paths` gives them.
        existing: what to do with files that exist: "refuse", "replace", or "continue".

    Raises:
        RunError: naming the file.
    """
    for path in filter(os.path.lexists, files_of(paths).values()):
        if existing == "refuse":
            raise RunError(f"{path} exists. Go on from a checkpoint with --restart FILE, or allow --overwrite")
        if existing == "continue" and not os.access(path, os.W_OK):
            raise RunError(f"{path} cannot be written: permission denied")


def same_file(one: Path, two: Path) -> bool:
    """Whether two names lead to the same file, also through symbolic or hard links; neither has to exist."""
    try:
        return os.path.samefile(one, two)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(two)


def _check_writable(path: Path) -> None:
    if path.is_dir():
        raise RunError(f"{path} is a directory, expected the name of a file")
    # For example a device: /dev/null would be replaced by a file.
    if path.exists() and not path.is_file():
        raise RunError(f"{path} is no regular file")
    if not path.parent.is_dir():
        raise RunError(f"there is no directory {path.parent} for {path.name}")
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise RunError(f"{path} cannot be written: {error.strerror} in {path.parent}") from error


class Outputs:
    """Trajectory, log, body states and checkpoint of a run, new or cut back to the lengths that a checkpoint notes.

    Attributes:
        checkpoint: its path.
        saved_step: of the last checkpoint; None before the first.
    """

    def __init__(
        self,
        plan: Plan,
        box: Box,
        bodies: RigidBodies,
        checkpoint: Path,
        run: str,
        columns: Sequence[str],
        noted: Mapping[str, records.Noted],
        saved_step: int | None,
    ):
        """
        Args:
            plan: of the run.
            box: what is simulated.
            bodies: its rigid bodies.
            checkpoint: its path.
            run: its identity.
            columns: of the log.
            noted: what `check_belonging` gives for a run that is continued; empty for a new one.
            saved_step: of the checkpoint that is continued; None for a new run.
        """
        self._plan, self._listed, self.checkpoint, self._run = plan, box.listed, checkpoint, run
        out, every = Path(plan.out), plan.interval(plan.every)
        topology = _subset(box.topology, box.listed)
        make = trajectories.trajectory_format(out)
        self.trajectory = make(out, topology, plan.step_time, every, run, noted.get("trajectory"))
        self.log = records.Log(Path(plan.report), columns, noted.get("log"))
        self._growing: dict[str, records.GrowingFile] = {"trajectory": self.trajectory, "log": self.log}
        self._intervals = {"frame": every, "row": plan.interval(plan.report_every)}
        if plan.bodies:
            periodic = box.system.usesPeriodicBoundaryConditions()
            self.bodies = BodyStates(Path(plan.bodies), bodies, periodic, run, noted.get("body states"))
            self._growing["body states"] = self.bodies
            self._intervals["bodies"] = plan.interval(plan.bodies_every)
        if plan.pressure_tensor:
            self.tensors = records.Log(Path(plan.pressure_tensor), pressure.COLUMNS, noted.get("pressure tensor"))
            self._growing["pressure tensor"] = self.tensors
            self._intervals["tensor"] = plan.interval(plan.pressure_tensor_every)
            self._pressure: pressure.MolecularPressure | None = None
        self._intervals["checkpoint"] = plan.interval(plan.checkpoint_every)
        self.saved_step = saved_step

    def next_due(self, step: int) -> int:
        """The next step after this one at which a file is due."""
        return min((step // interval + 1) * interval for interval in self._intervals.values())

    def due(self, step: int) -> list[str]:
        """Names of the files that are due after a step."""
        return [what for what, interval in self._intervals.items() if step % interval == 0]

    def write(
        self,
        due: Iterable[str],
        context: openmm.Context,
        values: Mapping[str, float] | None,
        start_energy: float | None,
    ) -> None:
        """Write the files that are due, the checkpoint last, since it notes the lengths of the others.

        Args:
            due: names, as the method `due` gives them.
            context: at the last completed step.
            values: by column of the log; needed for a row of the log and for a checkpoint.
            start_energy: conserved energy at the start of the run, kJ/mol, which the checkpoint notes.

        Raises:
            OSError: naming the file.
        """
        writers: dict[str, Callable] = {
            "frame": lambda: self._write_frame(context),
            "row": lambda: self.log.write([(values or {})[name] for name in self.log.columns]),
            "bodies": lambda: self.bodies.write(context),
            "tensor": lambda: self._write_tensor(context),
            "checkpoint": lambda: self._write_checkpoint(
                context, (values or {})["Potential Energy (kJ/mole)"], start_energy
            ),
        }
        due = set(due)
        for what, write in writers.items():
            if what in due:
                write()

    def _write_frame(self, context: openmm.Context) -> None:
        periodic = context.getSystem().usesPeriodicBoundaryConditions()
        state = context.getState(positions=True, enforcePeriodicBox=periodic and not self._plan.unwrapped)
        self.trajectory.write(state.getPositions(asNumpy=True)[self._listed], state.getPeriodicBoxVectors())

    def _write_tensor(self, context: openmm.Context) -> None:
        if self._pressure is None:
            self._pressure = pressure.MolecularPressure(context)
        self.tensors.write(self._pressure.row(context.getState(positions=True, velocities=True)))

    def _write_checkpoint(self, context: openmm.Context, potential: float, start_energy: float | None) -> None:
        for file in self._growing.values():
            file.sync()
        step = context.getStepCount()
        notes = {
            "run": self._run,
            "plan": self._plan.noted(self.checkpoint),
            "step": step,
            "potential_energy": potential,
            "start_energy": start_energy,
            **{NOTED_AS[kind]: asdict(file.noted()) for kind, file in self._growing.items()},
        }
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        records.write_checkpoint(self.checkpoint, state, notes)
        self.saved_step = step

    def finish(self) -> None:
        """Close all files and write those that are made at the end of a run."""
        # The trajectory last, since one that is made at the end can be continued only until then.
        for file in reversed(self._growing.values()):
            file.finish()


def _subset(topology: app.Topology, listed: np.ndarray) -> app.Topology:
    """The Topology of some atoms, with names alone: a trajectory needs no more."""
    modeller = app.Modeller(topology, [openmm.Vec3(0, 0, 0)] * topology.getNumAtoms() * unit.nanometer)
    kept = set(listed.tolist())
    modeller.delete([atom for atom in topology.atoms() if atom.index not in kept])
    return modeller.topology
