"""The kinds of output that grow during a run: for each its options, the format of its file and what a record holds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.files import body_states, trajectories
from openmm_sier.cli.files.records import GrowingFile, Log, Noted, RecordError
from openmm_sier.cli.plan import Plan
from openmm_sier.observe import conservation, pressure
from openmm_sier.observe.body_states import import_h5py


class Output(ABC):
    """An output of one kind: a path, and during the run an open file.

    Attributes:
        name: of the kind, in the notes of a checkpoint.
        option, every: the options that name the file and set its interval.
        path: of the output.
        format: class of its file.
        file: open from `open` on.
        interval: number of steps between records, known from `open` on.
    """

    name: ClassVar[str]
    option: ClassVar[str]
    every: ClassVar[str]

    file: Any
    interval: int

    def __init__(self, path: Path):
        """
        Raises:
            RecordError: the name has the wrong ending, or a package that its format needs is missing.
            ModuleNotFoundError: a package that body states need is missing.
        """
        self.path = path
        self.format: type[GrowingFile] = self._format()

    def open(self, simulated: Simulated, context: openmm.Context, noted: Noted | None) -> None:
        """Open the file: new, or cut back to the length that a checkpoint notes."""
        self.interval = simulated.plan.interval(getattr(simulated.plan, self.every))
        make: Any = self.format
        self.file = make(self.path, *self._layout(simulated, context), noted)

    def _format(self) -> type[GrowingFile]:
        if self.path.suffix in (*trajectories.FORMATS, *body_states.ENDINGS):
            raise RecordError(f"{self.path} is to be a table: name a file that ends in .csv")
        return Log

    @abstractmethod
    def _layout(self, simulated: Simulated, context: openmm.Context) -> tuple[Any, ...]:
        """What the class of the file takes between its path and the notes of a checkpoint."""

    @abstractmethod
    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        """Append a record of the Context at its last completed step.

        Args:
            context: of the run.
            values: of the log, by column; empty where neither log nor checkpoint is due.
        """


class TrajectoryOutput(Output):
    """Positions of the atoms that are listed in the PDB file."""

    name, option, every = "trajectory", "out", "every"

    def _format(self) -> type[GrowingFile]:
        return trajectories.trajectory_format(self.path)

    def _layout(self, simulated: Simulated, context: openmm.Context) -> tuple[Any, ...]:
        plan, box = simulated.plan, simulated.box
        self._listed = box.listed
        self._wrapped = box.system.usesPeriodicBoundaryConditions() and not plan.unwrapped
        return _subset(box.topology, box.listed), plan.step_time, self.interval

    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        state = context.getState(positions=True, enforcePeriodicBox=self._wrapped)
        self.file.write(state.getPositions(asNumpy=True)[self._listed], state.getPeriodicBoxVectors())


class LogOutput(Output):
    """Energies, temperatures and what the integrator reports."""

    name, option, every = "log", "report", "report_every"

    def _layout(self, simulated: Simulated, context: openmm.Context) -> tuple[Any, ...]:
        return (conservation.columns(context.getIntegrator()),)

    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        self.file.write([values[column] for column in self.file.columns])


class PressureTensorOutput(Output):
    """Molecular pressure tensors. They are computed in a second Context, which is made with the first record."""

    name, option, every = "tensors", "pressure_tensor", "pressure_tensor_every"

    _pressure: pressure.MolecularPressure | None = None

    def _layout(self, simulated: Simulated, context: openmm.Context) -> tuple[Any, ...]:
        return (pressure.COLUMNS,)

    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        self._pressure = self._pressure or pressure.MolecularPressure(context)
        self.file.write(self._pressure.row(context.getState(positions=True, velocities=True)))


class BodyStateOutput(Output):
    """Phase points of the rigid bodies."""

    name, option, every = "bodies", "bodies", "bodies_every"

    def _format(self) -> type[GrowingFile]:
        if self.path.suffix not in body_states.ENDINGS:
            raise RecordError(f"{self.path} is to hold body states: name a file that ends in .h5")
        import_h5py()
        return body_states.BodyStates

    def _layout(self, simulated: Simulated, context: openmm.Context) -> tuple[Any, ...]:
        return simulated.bodies, simulated.box.system.usesPeriodicBoundaryConditions()

    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        self.file.write(context)


#: In the order in which they are checked and written. They are finished from the last to the first: a trajectory that
#: is made at the end can be continued only until then. Body states are checked last, since frames are made of a
#: finished HDF5 file where the others have been found to be right.
KINDS: tuple[type[Output], ...] = (TrajectoryOutput, LogOutput, PressureTensorOutput, BodyStateOutput)


def outputs_of(plan: Plan) -> dict[str, Output]:
    """The outputs that a plan names, by the names of their kinds.

    Raises:
        RecordError, ModuleNotFoundError: as for `Output`.
    """
    return {kind.name: kind(Path(path)) for kind in KINDS if (path := getattr(plan, kind.option))}


def _subset(topology: app.Topology, listed: np.ndarray) -> app.Topology:
    """The Topology of some atoms, with names alone: a trajectory needs no more."""
    modeller = app.Modeller(topology, [openmm.Vec3(0, 0, 0)] * topology.getNumAtoms() * unit.nanometer)
    kept = set(listed.tolist())
    modeller.delete([atom for atom in topology.atoms() if atom.index not in kept])
    return modeller.topology
