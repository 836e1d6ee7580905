"""The output files of a run: their paths, checks before they are written, and the steps at which they are due."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.cli import records
from openmm_sier.cli.body_states import BodyStates
from openmm_sier.cli.plan import Plan, RunError
from openmm_sier.dynamics.bodies import RigidBodies
from openmm_sier.measure.forcefields import Box
from openmm_sier.observe import conservation, pressure


def output_paths(plan: Plan, checkpoint: Path) -> dict[str, Path]:
    """The output files of a run by kind, the checkpoint first.

    Raises:
        RecordError: a name has the wrong ending, or a package that its format needs is missing.
        ModuleNotFoundError: a package that body states need is missing.
    """
    records.trajectory_format(Path(plan.out))
    paths = {"checkpoint": checkpoint, "trajectory": Path(plan.out), "log": Path(plan.report)}
    if plan.bodies:
        BodyStates.check(Path(plan.bodies))
        paths["body states"] = Path(plan.bodies)
    if plan.pressure_tensor:
        paths["pressure tensor"] = Path(plan.pressure_tensor)
    return paths


def _companions(kind: str, path: Path) -> list[Path]:
    """Temporary files of an output."""
    if kind == "checkpoint":
        return [records.temporary_checkpoint(path)]
    if kind == "trajectory":
        return records.trajectory_format(path).companions(path)
    return BodyStates.companions(path) if kind == "body states" else []


def check_outputs(paths: Mapping[str, Path], inputs: Iterable[Path], existing: str) -> None:
    """Refuse outputs that cannot be written, and any that would destroy an input or another output.

    Args:
        paths: as `output_paths` gives them.
        inputs: files that are read.
        existing: what to do with outputs that exist: "refuse", "replace", or "continue".

    Raises:
        RunError: naming the file.
    """
    everything = {
        f"{kind} {path}" if place == path else f"{kind} {path}, by way of {place}": place
        for kind, path in paths.items()
        for place in (path, *_companions(kind, path))
    }
    inputs = list(inputs)
    for what, path in everything.items():
        for other in inputs:
            if same_file(path, other):
                raise RunError(f"the {what} would destroy the input {other}: name another file")
    for (one, path), (two, other) in combinations(everything.items(), 2):
        if same_file(path, other):
            raise RunError(f"the {two} would be the same file as the {one}: outputs must be different files")
    for path in everything.values():
        _check_writable(path, existing)


def same_file(one: Path, two: Path) -> bool:
    """Whether two names lead to the same file, also through symbolic or hard links; neither has to exist."""
    try:
        return os.path.samefile(one, two)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(two)


def _check_writable(path: Path, existing: str) -> None:
    if path.is_dir():
        raise RunError(f"{path} is a directory, expected the name of a file")
    if os.path.lexists(path):
        # For example a device: /dev/null would be replaced by a file.
        if path.exists() and not path.is_file():
            raise RunError(f"{path} is no regular file")
        if existing == "refuse":
            raise RunError(f"{path} exists. Go on from a checkpoint with --restart FILE, or allow --overwrite")
        if existing == "continue" and not os.access(path, os.W_OK):
            raise RunError(f"{path} cannot be written: permission denied")
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
        notes: dict[str, Any],
        columns: Sequence[str] = conservation.COLUMNS,
    ):
        """
        Args:
            plan: of the run.
            box: what is simulated.
            bodies: its rigid bodies.
            checkpoint: its path.
            notes: of the checkpoint that is continued; empty for a new run.
            columns: of the log.
        """
        self._plan, self._listed, self.checkpoint = plan, box.listed, checkpoint
        out, every = Path(plan.out), plan.interval(plan.every)
        topology = _subset(box.topology, box.listed)
        make = records.trajectory_format(out)
        self.trajectory = make(out, topology, plan.dt / 1000, every, **notes.get("trajectory", {}))
        self.log = records.Log(Path(plan.report), columns, **notes.get("log", {}))
        self._growing: dict[str, records.GrowingFile] = {"trajectory": self.trajectory, "log": self.log}
        self._intervals = {"frame": every, "row": plan.interval(plan.report_every)}
        if plan.bodies:
            periodic = box.system.usesPeriodicBoundaryConditions()
            self.bodies = BodyStates(Path(plan.bodies), bodies, periodic, **notes.get("bodies", {}))
            self._growing["bodies"] = self.bodies
            self._intervals["bodies"] = plan.interval(plan.bodies_every)
        if plan.pressure_tensor:
            self.tensors = records.Log(Path(plan.pressure_tensor), pressure.COLUMNS, **notes.get("tensors", {}))
            self._growing["tensors"] = self.tensors
            self._intervals["tensor"] = plan.interval(plan.pressure_tensor_every)
            self._pressure: pressure.MolecularPressure | None = None
        self._intervals["checkpoint"] = plan.interval(plan.checkpoint_every)
        self.saved_step: int | None = notes.get("step")

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
            "plan": self._plan.noted(self.checkpoint),
            "step": step,
            "potential_energy": potential,
            "start_energy": start_energy,
            **{name: file.length() for name, file in self._growing.items()},
        }
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        records.write_checkpoint(self.checkpoint, state, notes)
        self.saved_step = step

    def finish(self) -> None:
        """Close all files and write those that are made at the end of a run."""
        self.log.close()
        if self._plan.pressure_tensor:
            self.tensors.close()
        if self._plan.bodies:
            self.bodies.finish()
        self.trajectory.finish()


def _subset(topology: app.Topology, listed: np.ndarray) -> app.Topology:
    """The Topology of some atoms, with names alone: a trajectory needs no more."""
    modeller = app.Modeller(topology, [openmm.Vec3(0, 0, 0)] * topology.getNumAtoms() * unit.nanometer)
    kept = set(listed.tolist())
    modeller.delete([atom for atom in topology.atoms() if atom.index not in kept])
    return modeller.topology
