"""Reporters of rigid bodies for OpenMM's Simulation."""

from os import PathLike
from pathlib import Path

import openmm
from openmm import app

from openmm_sier.observe import body_states, conservation, pressure
from openmm_sier.system.arguments import whole_number
from openmm_sier.system.user_warnings import warn


class IntervalReporter:
    """Base class with OpenMM's protocol of reporters, for reports every so many steps."""

    INCLUDE: tuple[str, ...] = ()

    def __init__(self, reportInterval: int):
        self._interval = whole_number("reportInterval", reportInterval, least=1)

    def describeNextReport(self, simulation: app.Simulation) -> dict:
        """Return the number of steps to the next report, for OpenMM's Simulation."""
        steps = self._interval - simulation.currentStep % self._interval
        return {"steps": steps, "periodic": None, "include": list(self.INCLUDE)}


class _TableReporter(IntervalReporter):
    """Reporter of rows of numbers, the first of which is the step, as CSV."""

    #: First columns of a file.
    COLUMNS: tuple[str, ...]

    def __init__(self, file: str | PathLike[str], reportInterval: int, append: bool = False) -> None:
        """
        Args:
            file: path of the CSV file.
            reportInterval: number of steps between two rows, at least 1.
            append: True continues an existing file without a second header, and removes an incomplete last row of a
                killed run with a warning. False replaces the file.

        Raises:
            ValueError: the interval is not a whole number of at least 1, or the existing file has other columns.
            OSError: the file cannot be opened.
        """
        super().__init__(reportInterval)
        self._path = Path(file)
        continued = append and self._path.exists() and self._path.stat().st_size
        self._header = self._read_columns() if continued else None
        if continued:
            self._cut_incomplete_row()
        self._out = self._path.open("a" if append else "w", newline="\n")

    def _read_columns(self) -> tuple[str, ...]:
        with self._path.open() as file:
            heading = file.readline()
        if not heading.endswith("\n"):
            raise ValueError(f"{self._path} cannot be continued: its heading was cut off. Remove the file")
        names = heading.rstrip().split(",")
        if tuple(names[: len(self.COLUMNS)]) != self.COLUMNS:
            raise ValueError(
                f"{self._path} cannot be continued: it has {len(names)} columns that begin with "
                f"{', '.join(names[:3])}, expected the {len(self.COLUMNS)} columns of {type(self).__name__}"
            )
        return tuple(names)

    def _cut_incomplete_row(self) -> None:
        with self._path.open("r+b") as file:
            row = file.read().rpartition(b"\n")[2]
            file.truncate(file.tell() - len(row))
        if row:
            warn(f"{self._path} ended within a row, as a killed run leaves it: removed the {len(row)} bytes of the row")

    def _write(self, columns: tuple[str, ...], row: tuple[float, ...]) -> None:
        """Write one row, and flush it."""
        if self._header is None:
            self._header = columns
            self._out.write(conservation.csv_line(columns))
        if self._header != columns:
            raise ValueError(
                f"{self._path} cannot be continued: it has {len(self._header)} columns, but this integrator reports "
                f"{len(columns)}. Name another file"
            )
        self._out.write(conservation.csv_line(row))
        self._out.flush()

    def close(self) -> None:
        """Close the file."""
        self._out.close()


class ConservationReporter(_TableReporter):
    """Reporter of conserved quantities and of temperatures of translation and rotation, as CSV.

    >>> simulation.reporters.append(ConservationReporter("run.csv", 10))

    The columns are `openmm_sier.observe.conservation.COLUMNS`, as in the log of `openmm-sier run`, and additional ones
    of the integrator, such as the acceptance of hybrid Monte Carlo. `openmm_sier.observe.conservation.row` describes
    them, and `openmm_sier.analysis.read_log` reads the file.

    At constant energy the conserved and the total energy may differ by a constant, 3/2 kT on average: `createSystem`
    adds a CMMotionRemover, which stops the drift of the box in the first step, and the energy of the drift counts as
    heat.
    """

    COLUMNS = conservation.COLUMNS
    INCLUDE = ("energy",)

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write one row, and flush it.

        Raises:
            ValueError: the existing file belongs to another kind of integrator.
        """
        self._write(conservation.columns(simulation.integrator), conservation.row(simulation.context, state))


class PressureReporter(_TableReporter):
    """Reporter of the molecular pressure tensor of a periodic box, in bar, as CSV, for any integrator and molecules.

    >>> simulation.reporters.append(PressureReporter("pressure.csv", 5))

    See `openmm_sier.observe.pressure` for the method. A row costs 12 energy evaluations, in a separate Context: the run
    is bit-identical to one without this reporter. The columns are `openmm_sier.observe.pressure.COLUMNS`.
    """

    COLUMNS = pressure.COLUMNS
    INCLUDE = ("positions", "velocities")

    _pressure: pressure.MolecularPressure | None = None

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write one row, and flush it.

        Raises:
            ValueError: the System is not periodic.
        """
        if self._pressure is None:
            self._pressure = pressure.MolecularPressure(simulation.context)
        self._write(self.COLUMNS, self._pressure.row(state))


class BodyStateReporter(IntervalReporter):
    """Reporter of the bodies' centres, attitudes and momenta to an HDF5 file. Requires the extra `openmm-sier[hdf5]`.

    >>> simulation.reporters.append(BodyStateReporter("run.h5", 10))

    See `openmm_sier.observe.body_states` for the format. Every frame is flushed, so that the file of a killed run is
    readable.
    """

    def __init__(
        self,
        file: str | PathLike[str],
        reportInterval: int,
        append: bool = False,
        unwrapped: bool = True,
        names: body_states.Names = None,
    ) -> None:
        """
        Args:
            file: path of the HDF5 file, which is replaced unless `append` is true.
            reportInterval: number of steps between two frames, at least 1.
            append: True continues after the last frame of the file, which must have the same bodies. A missing or empty
                file is started.
            unwrapped: True writes centres along continuous paths, as in the Context. False wraps each centre into the
                periodic box, as OpenMM's trajectories do by default (`enforcePeriodicBox`).
            names: names of bodies, as returned by `select_bodies`, or a mapping from names to particle indices. Other
                bodies have an empty name.

        Raises:
            ValueError: the interval is not a whole number of at least 1; at the first report, the existing file has
                other bodies, or a name does not belong to exactly one body.
            ModuleNotFoundError: h5py is missing.
        """
        super().__init__(reportInterval)
        try:
            import h5py
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("BodyStateReporter requires h5py: pip install 'openmm-sier[hdf5]'") from error
        self._path = Path(file)
        self._unwrapped = unwrapped
        self._names = names
        self._begun = False
        # The oldest file format does not mark files as open for writing; a mark would lock out readers after a kill.
        self._file = h5py.File(self._path, "a" if append else "w", libver="earliest")
        self._file.flush()

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write one frame, and flush it."""
        frame = body_states.body_frame(simulation.context, state, self._unwrapped)
        if not self._begun:
            try:
                body_states.begin(self._file, simulation.integrator.bodies, frame, self._unwrapped, self._names)
            except ValueError as error:
                raise ValueError(
                    f"{self._path} cannot be {'continued' if len(self._file) else 'begun'}: {error}"
                ) from None
            self._begun = True
        body_states.append(self._file, frame)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
