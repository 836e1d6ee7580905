"""The kinds of output that grow during a run: for each its options, its file and what a record holds."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.files.records import Log, Noted, RecordError
from openmm_sier.cli.files.trajectories import FORMATS
from openmm_sier.cli.plan import Plan
from openmm_sier.observe import conservation, pressure


class Output(ABC):
    """An output of one kind: a path, and during the run an open file.

    Attributes:
        name: of the kind, in the notes of a checkpoint.
        option, every: the options that name the file and set its interval.
        path: of the output.
        interval: number of steps between records.
        file: open from `open` on.
    """

    name: ClassVar[str]
    option: ClassVar[str]
    every: ClassVar[str]

    file: Any

    def __init__(self, plan: Plan):
        """
        Raises:
            RecordError: the name has the wrong ending.
        """
        self.path, self.interval = getattr(plan, self.option), plan.interval(getattr(plan, self.every))
        self._check_ending()

    def _check_ending(self) -> None:
        if self.path.suffix in FORMATS:
            raise RecordError(f"{self.path} is to be a table: name a file that ends in .csv")

    @abstractmethod
    def open(self, simulated: Simulated, context: openmm.Context, noted: Noted | None) -> None:
        """Open the file: new, or cut back to the length that a checkpoint notes."""

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

    def _check_ending(self) -> None:
        if self.path.suffix not in FORMATS:
            raise RecordError(f"a trajectory ends in {', '.join(FORMATS)}, got {self.path.name}")

    def open(self, simulated: Simulated, context: openmm.Context, noted: Noted | None) -> None:
        plan, box = simulated.plan, simulated.box
        self._listed = box.listed
        self._wrapped = box.system.usesPeriodicBoundaryConditions() and not plan.unwrapped
        topology = _subset(box.topology, box.listed)
        self.file = FORMATS[self.path.suffix](self.path, topology, plan.step_time, self.interval, noted)

    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        state = context.getState(positions=True, enforcePeriodicBox=self._wrapped)
        self.file.write(state.getPositions(asNumpy=True)[self._listed], state.getPeriodicBoxVectors())


class LogOutput(Output):
    """Energies, temperatures and what the integrator reports."""

    name, option, every = "log", "report", "report_every"

    def open(self, simulated: Simulated, context: openmm.Context, noted: Noted | None) -> None:
        self.file = Log(self.path, conservation.columns(context.getIntegrator()), noted)

    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        self.file.write([values[column] for column in self.file.columns])


class PressureTensorOutput(Output):
    """Molecular pressure tensors. They are computed in a second Context, which is made with the first record."""

    name, option, every = "tensors", "pressure_tensor", "pressure_tensor_every"

    _pressure: pressure.MolecularPressure | None = None

    def open(self, simulated: Simulated, context: openmm.Context, noted: Noted | None) -> None:
        self.file = Log(self.path, pressure.COLUMNS, noted)

    def write(self, context: openmm.Context, values: Mapping[str, float]) -> None:
        self._pressure = self._pressure or pressure.MolecularPressure(context)
        self.file.write(self._pressure.row(context.getState(positions=True, velocities=True)))


#: In the order in which they are checked and written.
KINDS: tuple[type[Output], ...] = (TrajectoryOutput, LogOutput, PressureTensorOutput)


def _subset(topology: app.Topology, listed: np.ndarray) -> app.Topology:
    """The Topology of some atoms, with names alone: a trajectory needs no more."""
    modeller = app.Modeller(topology, [openmm.Vec3(0, 0, 0)] * topology.getNumAtoms() * unit.nanometer)
    kept = set(listed.tolist())
    modeller.delete([atom for atom in topology.atoms() if atom.index not in kept])
    return modeller.topology
