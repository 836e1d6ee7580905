"""Trajectories of bodies with their orientations, as GSD files. Requires the extra gsd."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
import openmm
from openmm import app, unit

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.species import Species
from openmm_sier.observe import conservation
from openmm_sier.observe.reporters import IntervalReporter


class GSDReporter(IntervalReporter):
    """Reporter of centres and orientations of bodies to a GSD file, which OVITO and HOOMD-blue's tools read.

    Requires the extra `openmm-sier[gsd]`.

    >>> simulation.reporters.append(GSDReporter("run.gsd", 10))

    Each body is a particle, in the order of the bodies, with the name of its `BodyType` as type, or of its residue. Its
    orientation is that of `RigidBodies.orientations`. Lengths are in nm, velocities in nm/ps, masses in dalton, all in
    single precision. Positions are in a box about the origin, as in all GSD files, with images by which the box was
    crossed; a System without a box gets a cube around the bodies.
    """

    def __init__(self, file: str | PathLike[str], reportInterval: int, append: bool = False) -> None:
        """
        Args:
            file: path of the GSD file, which is replaced unless `append` is true.
            reportInterval: number of steps between two frames, at least 1.
            append: True continues after the last frame of the file, which must have as many bodies. A missing file is
                started.

        Raises:
            ValueError: the interval is not a whole number of at least 1, or, at the first report, the file has another
                number of bodies.
            ModuleNotFoundError: gsd is missing.
        """
        super().__init__(reportInterval)
        try:
            import gsd.hoomd
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("GSDReporter requires gsd: pip install 'openmm-sier[gsd]'") from error
        self._path = Path(file)
        self._make_frame = gsd.hoomd.Frame
        self._file = gsd.hoomd.open(str(self._path), "a" if append else "w")
        self._begun = False

    def report(self, simulation: app.Simulation, state: openmm.State) -> None:
        """Write one frame, and flush it."""
        integrator = conservation.sier_integrator(simulation.context)
        bodies = integrator.bodies
        if not self._begun:
            self._refuse_other_bodies(bodies)
        motion = integrator.getBodyState()
        is_periodic = simulation.context.getSystem().usesPeriodicBoundaryConditions()
        box = _box_of(state) if is_periodic else _cube_around(motion.q)
        frame = self._make_frame()
        frame.configuration.step = state.getStepCount()
        frame.configuration.box = _box_of_gsd(box)
        frame.particles.N = bodies.n
        frame.particles.types, frame.particles.typeid = _types_of(bodies)
        frame.particles.mass = bodies.masses
        frame.particles.position, frame.particles.image = _in_box(motion.q.T, box)
        frame.particles.orientation = bodies.orientations(motion)
        frame.particles.velocity = (motion.p / bodies.masses).T
        self._file.append(frame)
        self._file.flush()
        self._begun = True

    def _refuse_other_bodies(self, bodies: BodySet) -> None:
        before = self._file[-1].particles.N if len(self._file) else bodies.n
        if before != bodies.n:
            raise ValueError(f"{self._path} cannot be continued: it has {before} bodies, and this System {bodies.n}")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _types_of(bodies: BodySet) -> tuple[list[str], np.ndarray]:
    """Return the names of types, and the number of the type of each body, (n,)."""
    names = [_name_of(species, bodies.labels) for species in bodies.species]
    types = list(dict.fromkeys(names))
    kinds = np.empty(bodies.n, dtype=np.uint32)
    for name, columns in zip(names, bodies.columns, strict=True):
        kinds[columns] = types.index(name)
    return types, kinds


def _name_of(species: Species, labels: Sequence[str] | None) -> str:
    """Return the name of a kind of body: its type, or the residue of its first atom, if known."""
    if species.name or labels is None:
        size = species.atoms.shape[1]
        return species.name or ("point" if size == 1 else f"body of {size} atoms")
    return labels[species.atoms[0, 0]].split()[0]


def _box_of(state: openmm.State) -> np.ndarray:
    """Return the box vectors of a State as rows, (3, 3), nm."""
    return np.array(state.getPeriodicBoxVectors(asNumpy=True).value_in_unit(unit.nanometer))


def _cube_around(q: np.ndarray) -> np.ndarray:
    """Return the vectors of a cube about the origin with room for points (3, n), as rows, nm."""
    return 2.0 * (1.0 + np.abs(q).max(initial=0.0)) * np.eye(3)


def _box_of_gsd(box: np.ndarray) -> list[float]:
    """Return lengths and tilts of a box of OpenMM: lx, ly, lz, xy, xz, yz."""
    (lx, _, _), (xy, ly, _), (xz, yz, lz) = box.tolist()
    return [lx, ly, lz, xy / ly, xz / lz, yz / lz]


def _in_box(q: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) in a box about the origin, and the numbers of box vectors by which they were moved."""
    images = np.rint(np.linalg.solve(box.T, q.T).T)
    return q - images @ box, images.astype(np.int32)
