"""Reporters for OpenMM's Simulation that know of rigid bodies."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from openmm import unit

from openmm_sier.context.integrator import SIERIntegrator
from openmm_sier.dynamics.bodies import BodyState, RigidBodies

#: Columns of a conservation log.
COLUMNS = (
    "Step",
    "Time (ps)",
    "Total Energy (kJ/mol)",
    "Conserved Energy (kJ/mol)",
    "Translational Temperature (K)",
    "Rotational Temperature (K)",
    *(f"Momentum {axis} (dalton nm/ps)" for axis in "xyz"),
    *(f"Angular Momentum {axis} (dalton nm^2/ps)" for axis in "xyz"),
    "Box Volume (nm^3)",
)


#: Datasets of body states and their units.
UNITS = {
    "step": "1",
    "time": "ps",
    "q": "nm",
    "quaternion": "1",
    "p": "dalton nm/ps",
    "L": "dalton nm^2/ps",
    "heat": "kJ/mol",
    "masses": "dalton",
    "moments": "dalton nm^2",
}


class _Reporter:
    """What OpenMM's protocol asks of both reporters: when to report, and what of the State they need."""

    def __init__(self, reportInterval: int, include: list[str]):
        if reportInterval < 1:
            raise ValueError(f"reportInterval must be at least 1, got {reportInterval}")
        self._interval = reportInterval
        self._include = include

    def describeNextReport(self, simulation) -> dict:
        """Steps to the next report, for OpenMM's Simulation."""
        steps = self._interval - simulation.currentStep % self._interval
        return {"steps": steps, "periodic": None, "include": self._include}

    @staticmethod
    def _integrator(simulation) -> SIERIntegrator:
        integrator = simulation.context.getIntegrator()
        if not isinstance(integrator, SIERIntegrator):
            raise TypeError(f"this reporter needs a SIER integrator, the Simulation has a {type(integrator).__name__}")
        return integrator


class ConservationReporter(_Reporter):
    """Writes what should be conserved, and the temperatures of translation and rotation, as CSV.

    The conserved energy is the total energy less the heat that a thermostat of this package gave. Angular momentum is
    about the origin, with positions as they stand in the Context; periodic boundaries do not conserve it.
    """

    def __init__(self, file, reportInterval: int, append: bool = False):
        """
        Args:
            file: path of the CSV file.
            reportInterval: steps between two rows.
            append: go on with an existing file; its header is not written again.
        """
        super().__init__(reportInterval, ["energy"])
        path = Path(file)
        fresh = not (append and path.exists() and path.stat().st_size)
        self._out = path.open("a" if append else "w", newline="")
        self._rows = csv.writer(self._out)
        if fresh:
            self._rows.writerow(COLUMNS)

    def report(self, simulation, state) -> None:
        """Write one row, and flush it."""
        integrator = self._integrator(simulation)
        bodies, motion = integrator.bodies, integrator.getBodyState()
        energy = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole) + sum(
            bodies.kinetic_energies(motion)
        )
        removed = 3 if integrator.removesCentreOfMassMotion else 0
        momentum, angular_momentum = bodies.total_momenta(motion)
        values = [
            state.getTime().value_in_unit(unit.picosecond),
            energy,
            energy - motion.heat,
            *bodies.temperatures(motion, removed),
            *momentum,
            *angular_momentum,
            state.getPeriodicBoxVolume().value_in_unit(unit.nanometer**3),
        ]
        self._rows.writerow([simulation.currentStep, *(repr(float(value)) for value in values)])
        self._out.flush()

    def close(self) -> None:
        """Close the file."""
        self._out.close()

    def __del__(self):
        if hasattr(self, "_out"):
            self._out.close()


class BodyStateReporter(_Reporter):
    """Writes the bodies' phase points to an HDF5 file. Needs h5py, an extra (`openmm-sier[hdf5]`).

    Datasets over frames T and bodies n: step (T,), time (T,), q (T, n, 3), quaternion (T, n, 4), p (T, n, 3),
    L (T, n, 3) and heat (T,); and over bodies masses (n,), moments (n, 3). The quaternion (w, x, y, z) is that of the
    rotation that turns the principal axes of a body into the lab frame, the matrix A^T, with w >= 0. Each dataset has
    its unit as an attribute. Every frame is flushed, so that the file of a run that was killed can be read.
    """

    def __init__(self, file, reportInterval: int):
        """
        Args:
            file: path of the HDF5 file, which is replaced.
            reportInterval: steps between two frames.

        Raises:
            ModuleNotFoundError: h5py is missing.
        """
        super().__init__(reportInterval, [])
        try:
            import h5py
            from scipy.spatial.transform import Rotation  # noqa: F401
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("BodyStateReporter needs h5py: pip install 'openmm-sier[hdf5]'") from error
        # The oldest file format marks no file as open for writing, which would keep readers out after a kill.
        self._file = h5py.File(file, "w", libver="earliest")
        self._file.flush()
        self._ready = False

    def report(self, simulation, state) -> None:
        """Write one frame, and flush it."""
        integrator = self._integrator(simulation)
        motion = integrator.getBodyState()
        if not self._ready:
            create_datasets(self._file, integrator.bodies)
            self._ready = True
        frame = body_frame_values(simulation.currentStep, state.getTime().value_in_unit(unit.picosecond), motion)
        for name, value in frame.items():
            dataset = self._file[name]
            dataset.resize(dataset.shape[0] + 1, axis=0)
            dataset[-1] = value
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def frame_shapes(n: int) -> dict[str, tuple[int, ...]]:
    """Shapes of one frame's values of n bodies, by dataset."""
    return {"step": (), "time": (), "q": (n, 3), "quaternion": (n, 4), "p": (n, 3), "L": (n, 3), "heat": ()}


def body_frame_values(step: int, time: float, motion: BodyState) -> dict[str, Any]:
    """One frame of body states, with the shapes of `frame_shapes`.

    Args:
        step: number of the step.
        time: ps.
        motion: the bodies' phase point.
    """
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(motion.A.transpose(2, 1, 0))
    return {
        "step": step,
        "time": time,
        "q": motion.q.T,
        "quaternion": turns.as_quat(canonical=True, scalar_first=True),
        "p": motion.p.T,
        "L": motion.L.T,
        "heat": motion.heat,
    }


def create_datasets(file: Any, bodies: RigidBodies) -> None:
    """Make the datasets of body states, without frames, in an open h5py.File."""
    for name, shape in frame_shapes(bodies.n).items():
        # Chunks of about 64 kB.
        frames = max(1, 8192 // max(1, int(np.prod(shape))))
        kind = "i8" if name == "step" else "f8"
        file.create_dataset(name, (0, *shape), kind, maxshape=(None, *shape), chunks=(frames, *shape))
    file["masses"] = bodies.masses
    file["moments"] = bodies.moments.T
    for name, symbol in UNITS.items():
        file[name].attrs["unit"] = symbol
