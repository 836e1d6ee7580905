"""Starting points of test systems: stored in files, and displaced by the option `--displaced`."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import openmm
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

DIRECTORY = Path(__file__).parents[1] / "data" / "starts"

#: nm by which `--displaced` moves each unit: far above the rounding of coordinates, 1e-16, and far below the tolerances
#: to which tests know them.
DISTANCE = 1e-10


class Options:
    """Options of the tests' own `conftest`.

    Attributes:
        seed: of the directions of displacements; None displaces nothing.
        makes: whether starts that are not stored are made and stored.
    """

    seed: int | None = None
    makes = False


def stored(name: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of a start.

    They come from a file, since minimization and dynamics end elsewhere on another processor.

    Args:
        name: of the start, and of its file.
        make: returns the arrays; it is called only where the option `--make-starts` is given and the file is missing.
    """
    path = DIRECTORY / f"{name}.npz"
    if not path.exists():
        if not Options.makes:
            raise FileNotFoundError(
                f"there is no start {path.name} in {path.parent}; `pytest --make-starts`, with the names of the tests "
                "that need it, makes and stores it"
            )
        path.parent.mkdir(exist_ok=True)
        np.savez_compressed(path, **make())
    with np.load(path) as arrays:
        return dict(arrays)


def displaced(positions: np.ndarray, system: openmm.System, bodies: Sequence[Sequence[int]] = ()) -> np.ndarray:
    """Positions (N, 3) in nm, displaced by `DISTANCE` if the option `--displaced` is given.

    Atoms that constraints, virtual sites or `bodies` join move as one, so that shapes stay as they are. Where one of
    them is frozen, none of them moves.
    """
    if Options.seed is None:
        return positions
    count, unit, frozen = _units(system, bodies)
    directions = np.random.default_rng(Options.seed).normal(size=(count, 3))
    directions *= DISTANCE / np.linalg.norm(directions, axis=1, keepdims=True)
    directions[unit[frozen]] = 0.0
    return positions + directions[unit]


def _units(system, bodies):
    """The number of units, for each particle (N,) that of its own, and the frozen particles."""
    n = system.getNumParticles()
    joined = [system.getConstraintParameters(k)[:2] for k in range(system.getNumConstraints())]
    joined += [(body[0], i) for body in bodies for i in body[1:]]
    frozen = []
    for i in range(n):
        if system.isVirtualSite(i):
            site = system.getVirtualSite(i)
            joined += [(i, site.getParticle(k)) for k in range(site.getNumParticles())]
        elif system.getParticleMass(i)._value == 0:
            frozen.append(i)
    rows, columns = np.array(joined, dtype=int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    return *connected_components(graph, directed=False), frozen
