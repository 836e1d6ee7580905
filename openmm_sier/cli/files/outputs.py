"""The output files of a run: where they lie, what is checked before they are written, and when they are due."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.cli.beginning import Simulated
from openmm_sier.cli.files import body_states, checkpoints, trajectories
from openmm_sier.cli.files.records import Log, Noted
from openmm_sier.cli.plan import Plan, RunError
from openmm_sier.observe import conservation, pressure
from openmm_sier.observe.body_states import import_h5py

#: Files that grow, by their names in the notes of a checkpoint: the options that name them and set their intervals.
OUTPUTS = {
    "trajectory": ("out", "every"),
    "log": ("report", "report_every"),
    "tensors": ("pressure_tensor", "pressure_tensor_every"),
    # Last, since frames are made of a finished HDF5 file where the others have been found to be right.
    "bodies": ("bodies", "bodies_every"),
}


class OutputFiles:
    """The files that a run writes, before any is opened.

    Attributes:
        checkpoint: path of the checkpoint.
        paths: of the outputs, by their keys in `OUTPUTS`.
        formats: their classes.
        everything: all files, also those of which HDF5 files are made, the checkpoint first.
    """

    def __init__(self, plan: Plan, checkpoint: Path):
        """
        Raises:
            RecordError: a name has the wrong ending, or a package that its format needs is missing.
            ModuleNotFoundError: a package that body states need is missing.
        """
        named = {key: getattr(plan, option) for key, (option, _) in OUTPUTS.items()}
        self.checkpoint = checkpoint
        self.paths = {key: Path(path) for key, path in named.items() if path}
        if "bodies" in self.paths:
            import_h5py()
        self.formats: dict[str, Any] = dict.fromkeys(self.paths, Log)
        self.formats["trajectory"] = trajectories.trajectory_format(self.paths["trajectory"])
        self.formats |= {"bodies": body_states.BodyStates} if "bodies" in self.paths else {}
        growing = {key: self.formats[key].growing(path) for key, path in self.paths.items()}
        beside = [place for key, place in growing.items() if place != self.paths[key]]
        self.everything = [checkpoint, *self.paths.values(), *beside]

    def __str__(self) -> str:
        return ", ".join(str(path) for path in (self.checkpoint, *self.paths.values()))

    @property
    def are_finished(self) -> bool:
        """Whether all outputs are there and nothing is left to be done for them."""
        return not any(self.formats[key].unfinished(path) for key, path in self.paths.items())

    def remove(self) -> None:
        """Remove the outputs, the checkpoint first, so that it is never left with files that are not its own."""
        for path in (self.checkpoint, *self.paths.values()):
            Path(os.path.realpath(path)).unlink(missing_ok=True)

    def check(self, inputs: Collection[Path]) -> None:
        """Refuse outputs that cannot be written, and any that would destroy an input or another output.

        Args:
            inputs: files that are read.

        Raises:
            RunError: naming the file.
        """
        for path, other in product(self.everything, inputs):
            if same_file(path, other):
                raise RunError(f"{path} would destroy the input {other}: name another file")
        for path, other in combinations(self.everything, 2):
            if same_file(path, other):
                raise RunError(f"{path} and {other} are the same: outputs must be different files")
        for path in self.everything:
            # For example a device: /dev/null would be replaced by a file.
            if path.exists() and not path.is_file():
                raise RunError(f"{path} is no regular file")
            if not path.parent.is_dir():
                raise RunError(f"there is no directory {path.parent} for {path.name}")

    def refuse_existing(self) -> None:
        """Refuse to replace files.

        Raises:
            RunError: naming the file that is in the way.
        """
        for path in filter(os.path.lexists, self.everything):
            raise RunError(f"{path} exists. Go on from a checkpoint with --restart FILE, or allow --overwrite")

    def check_noted(self, notes: Mapping[str, Any]) -> None:
        """Check that the outputs are those of the run that a checkpoint notes; none is changed.

        Raises:
            RecordError: an output is of another run.
            OSError: one is missing.
        """
        for key, path in self.paths.items():
            self.formats[key].check(path, Noted(**notes[key]))


def same_file(one: Path, two: Path) -> bool:
    """Whether two names lead to the same file, also through symbolic or hard links; neither has to exist."""
    try:
        return os.path.samefile(one, two)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(two)


class Outputs:
    """The open files of a run, new or cut back to the lengths that a checkpoint notes.

    Attributes:
        checkpoint: its path.
        log: of the run.
        saved_step: of the last checkpoint; None before the first.
    """

    def __init__(
        self, files: OutputFiles, simulated: Simulated, context: openmm.Context, notes: Mapping[str, Any] | None
    ):
        """
        Args:
            files: of the run.
            simulated: what is simulated.
            context: at the start, or at the checkpoint.
            notes: of the checkpoint of a run that is continued, for which `OutputFiles.check_noted` has passed; None
                for a new run.
        """
        plan, box, bodies = simulated.plan, simulated.box, simulated.bodies
        self.checkpoint, self.saved_step = files.checkpoint, notes["step"] if notes else None
        self._plan, self._listed = plan, box.listed
        self._periodic = box.system.usesPeriodicBoundaryConditions()
        self._intervals = {key: plan.interval(getattr(plan, OUTPUTS[key][1])) for key in files.paths}
        layouts: dict[str, Sequence[Any]] = {
            "trajectory": (_subset(box.topology, box.listed), plan.step_time, self._intervals["trajectory"]),
            "log": (conservation.columns(context.getIntegrator()),),
            "bodies": (bodies, self._periodic),
            "tensors": (pressure.COLUMNS,),
        }
        noted = {key: Noted(**notes[key]) if notes else None for key in files.paths}
        self._files: dict[str, Any] = {
            key: files.formats[key](path, *layouts[key], noted[key]) for key, path in files.paths.items()
        }
        self._intervals["checkpoint"] = plan.interval(plan.checkpoint_every)
        self.log: Log = self._files["log"]
        self._pressure: pressure.MolecularPressure | None = None

    def next_due(self, step: int) -> int:
        """The next step after this one at which a file is due."""
        return min((step // interval + 1) * interval for interval in self._intervals.values())

    def due(self, step: int) -> list[str]:
        """The files that are due after a step: keys of `OUTPUTS`, and "checkpoint"."""
        return [what for what, interval in self._intervals.items() if step % interval == 0]

    def write(self, due: Collection[str], context: openmm.Context, values: Mapping[str, float]) -> None:
        """Write the files that are due, the checkpoint last, since it notes the lengths of the others.

        Args:
            due: as the method `due` gives them.
            context: at the last completed step.
            values: by column of the log; needed for the log and for a checkpoint.
        """
        if "trajectory" in due:
            self._write_frame(context)
        if "log" in due:
            self.log.write([values[name] for name in self.log.columns])
        if "bodies" in due:
            self._files["bodies"].write(context)
        if "tensors" in due:
            self._pressure = self._pressure or pressure.MolecularPressure(context)
            self._files["tensors"].write(self._pressure.row(context.getState(positions=True, velocities=True)))
        if "checkpoint" in due:
            self._write_checkpoint(context, values["Potential Energy (kJ/mole)"])

    def _write_frame(self, context: openmm.Context) -> None:
        state = context.getState(positions=True, enforcePeriodicBox=self._periodic and not self._plan.unwrapped)
        positions = state.getPositions(asNumpy=True)[self._listed]
        self._files["trajectory"].write(positions, state.getPeriodicBoxVectors())

    def _write_checkpoint(self, context: openmm.Context, potential: float) -> None:
        step = context.getStepCount()
        notes = {
            "plan": self._plan.noted(self.checkpoint),
            "step": step,
            "potential_energy": potential,
            **{key: asdict(file.noted()) for key, file in self._files.items()},
        }
        state = context.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
        checkpoints.write_checkpoint(self.checkpoint, state, notes)
        self.saved_step = step

    def finish(self) -> None:
        """Close all files and write those that are made at the end of a run."""
        # The trajectory last, since one that is made at the end can be continued only until then.
        for file in reversed(self._files.values()):
            file.finish()


def _subset(topology: app.Topology, listed: np.ndarray) -> app.Topology:
    """The Topology of some atoms, with names alone: a trajectory needs no more."""
    modeller = app.Modeller(topology, [openmm.Vec3(0, 0, 0)] * topology.getNumAtoms() * unit.nanometer)
    kept = set(listed.tolist())
    modeller.delete([atom for atom in topology.atoms() if atom.index not in kept])
    return modeller.topology
