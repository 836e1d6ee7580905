"""Reporters for OpenMM's Simulation that know about rigid bodies."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import openmm
from openmm import app

from openmm_sier.observe import conservation, pressure
from openmm_sier.observe.body_states import BodyStateFile, body_frame, import_extras


class _Reporter:
    """OpenMM's protocol for all reporters: the steps between reports, and the parts of the State that they need."""

    def __init__(self, reportInterval: int, include: list[str]):
        if reportInterval < 1:
            raise ValueError(f"reportInterval must be at least 1, got {reportInterval}")
        self._interval = reportInterval
        self._include = include

    def describeNextReport(self, simulation: app.Simulation) -> dict:
        """Steps to the next report, for OpenMM's Simulation."""
        steps = self._interval - simulation.currentStep % self._interval
        return {"steps": steps, "periodic": None, "include": self._include}


class ConservationReporter(_Reporter):
    """Writes conserved quantities and the temperatures of translation and rotation as CSV.

    The columns are those of the log of `openmm-sier run`, `openmm_sier.observe.conservation.COLUMNS`, and those that
    the integrator adds, such as the acceptance of hybrid Monte Carlo; `row` in that module describes them.
    """

    def __init__(self, file: str | PathLike[str], reportInterval: int, append: bool = False) -> None:
        """
        Args:
            file: path of the CSV file.
            reportInterval: steps between two rows.
            append: continue an existing file; its header is not written again.

        Raises:
            ValueError: the interval is not positive, or the file to be continued has other columns.
        """
        super().__init__(reportInterval, ["energy"])
        self._table = _Table(Path(file), append, conservation.COLUMNS, type(self).__name__)

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write one row, and flush it.

        Raises:
            ValueError: the file to be continued is that of another kind of integrator.
        """
        columns = conservation.columns(simulation.integrator)
        self._table.write(columns, conservation.row(simulation.context, state))

    def close(self) -> None:
        """Close the file."""
        self._table.close()


class PressureReporter(_Reporter):
    """Writes the molecular pressure tensor of a periodic box, in bar, as CSV; for any integrator and any molecules.

    `openmm_sier.observe.pressure` says how it is computed. A row costs 12 energy evaluations, in a separate Context:
    the run is bit-identical to one without this reporter. The columns are `openmm_sier.observe.pressure.COLUMNS`.
    """

    def __init__(self, file: str | PathLike[str], reportInterval: int, append: bool = False) -> None:
        """
        Args:
            file: path of the CSV file.
            reportInterval: steps between two rows.
            append: continue an existing file; its header is not written again.

        Raises:
            ValueError: the interval is not positive, or the file to be continued has other columns; at the first
                report, the System is not periodic.
        """
        super().__init__(reportInterval, ["positions", "velocities"])
        self._table = _Table(Path(file), append, pressure.COLUMNS, type(self).__name__)
        self._pressure: pressure.MolecularPressure | None = None

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write one row, and flush it."""
        if self._pressure is None:
            self._pressure = pressure.MolecularPressure(simulation.context)
        self._table.write(pressure.COLUMNS, self._pressure.row(state))

    def close(self) -> None:
        """Close the file."""
        self._table.close()


class _Table:
    """A CSV file of numbers, whose first column counts steps."""

    def __init__(self, path: Path, append: bool, columns: tuple[str, ...], owner: str):
        """
        Args:
            path: of the file.
            append: continue an existing file.
            columns: the first columns that such a file must have.
            owner: name of the reporter.

        Raises:
            ValueError: the file to be continued has other columns.
        """
        fresh = not (append and path.exists() and path.stat().st_size)
        self._path, self._header = path, None if fresh else _header(path, columns, owner)
        self._out = path.open("a" if append else "w", newline="\n")

    def write(self, columns: tuple[str, ...], row: tuple[float, ...]) -> None:
        """Write one row, and flush it.

        Raises:
            ValueError: the file to be continued has other columns.
        """
        if self._header is None:
            self._header = columns
            self._out.write(conservation.csv_line(columns))
        if self._header != columns:
            raise ValueError(
                f"{self._path} cannot be continued: it has {len(self._header)} columns, and this integrator has "
                f"{len(columns)} to report"
            )
        self._out.write(conservation.csv_line(row))
        self._out.flush()

    def close(self) -> None:
        self._out.close()

    def __del__(self) -> None:
        if hasattr(self, "_out"):
            self._out.close()


def _header(path: Path, columns: tuple[str, ...], owner: str) -> tuple[str, ...]:
    with path.open() as file:
        found = file.readline().rstrip().split(",")
    if tuple(found[: len(columns)]) != columns:
        raise ValueError(
            f"{path} cannot be continued: it has {len(found)} columns that begin with {', '.join(found[:3])}, expected "
            f"the {len(columns)} of {owner}"
        )
    return tuple(found)


class BodyStateReporter(_Reporter):
    """Writes the bodies' phase points to an HDF5 file. Needs h5py and scipy, an extra (`openmm-sier[hdf5]`).

    `openmm_sier.observe.body_states` says what the file holds. Every frame is flushed, so that the file of a run that
    was killed can be read.
    """

    def __init__(
        self, file: str | PathLike[str], reportInterval: int, append: bool = False, unwrapped: bool = True
    ) -> None:
        """
        Args:
            file: path of the HDF5 file, which is replaced unless `append` is true.
            reportInterval: steps between two frames.
            append: continue after the last frame of the file, which must be of the same bodies; a missing file is
                created.
            unwrapped: write centres as they are in the Context, along continuous paths. Otherwise each centre is moved
                into the periodic box, as molecules are in OpenMM's trajectories by default (`enforcePeriodicBox`) and
                in those of `openmm-sier run`.

        Raises:
            ValueError: the interval is not positive; at the first report, the file to be continued is of other bodies.
            ModuleNotFoundError: h5py or scipy is missing.
        """
        super().__init__(reportInterval, [])
        h5py, _ = import_extras()
        self._path, self._unwrapped = Path(file), unwrapped
        self._append = append and self._path.exists()
        if not self._append:
            # An unwritable path fails here, before the run.
            h5py.File(self._path, "w", libver="earliest").close()
        self._file: BodyStateFile | None = None

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write one frame, and flush it."""
        if self._file is None:
            bodies = conservation.sier_integrator(simulation.context).bodies
            periodic = simulation.system.usesPeriodicBoundaryConditions()
            self._file = BodyStateFile(self._path, bodies, periodic, self._unwrapped, self._append)
        self._file.append(body_frame(simulation.context, state, self._unwrapped))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
