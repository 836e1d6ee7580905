"""Settings of an integrator in what OpenMM serializes, so that XML, copies and caches keyed by XML distinguish them.

A CustomIntegrator carries numbers in its variables, but these travel in checkpoints too, and a checkpoint must not
bring back the temperature of the run that wrote it. Tabulated functions are in no checkpoint: OpenMM serializes them
with the integrator only. Each setting is a tabulated function that no computation uses. Its name holds a text, its
values hold numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import openmm

from openmm_sier.dynamics import bodies as dynamics
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.stages import Stage
from openmm_sier.system.arguments import Bodies
from openmm_sier.system.find_bodies import RigidBodies

#: What the names of the functions begin with.
PREFIX = "sier "

#: Characters that, like letters, are stored as they are. OpenMM's XML reader damages names with quotes, braces and the
#: like.
READABLE = " ,.:/()+-<>_"


def store(integrator: openmm.CustomIntegrator, key: str, numbers: Iterable[float] = (), text: str = "") -> None:
    """Store a setting, or replace the numbers of a stored one.

    Args:
        integrator: the integrator that carries it.
        key: name of the setting, one word.
        numbers: its numbers.
        text: its text, which cannot be changed later.
    """
    # A function needs at least one value, so a zero is put before the numbers.
    values = [0.0, *map(float, numbers)]
    if (index := _find(integrator, key)) is not None:
        integrator.getTabulatedFunction(index).setFunctionParameters(values)
    else:
        name = PREFIX + key + " " + quote(text, safe=READABLE)
        integrator.addTabulatedFunction(name, openmm.Discrete1DFunction(values))


def stored(integrator: openmm.CustomIntegrator, key: str) -> tuple[str, np.ndarray] | None:
    """Text and numbers of a setting; None where it is not stored."""
    if (index := _find(integrator, key)) is None:
        return None
    text = integrator.getTabulatedFunctionName(index)[len(PREFIX + key) + 1 :]
    return unquote(text), np.array(integrator.getTabulatedFunction(index).getFunctionParameters()[1:])


def _find(integrator: openmm.CustomIntegrator, key: str) -> int | None:
    for i in range(integrator.getNumTabulatedFunctions()):
        if integrator.getTabulatedFunctionName(i).startswith(f"{PREFIX}{key} "):
            return i
    return None


def required(integrator: openmm.CustomIntegrator, key: str) -> tuple[str, np.ndarray]:
    """As `stored`.

    Raises:
        openmm.OpenMMException: the setting is not stored, as in XML of another version.
    """
    if (found := stored(integrator, key)) is None:
        raise openmm.OpenMMException(
            f"This SIER integrator was stored without its {key}, by another version of openmm_sier: create it anew"
        )
    return found


# --- what is stored ---


def store_scheme(integrator: openmm.CustomIntegrator, scheme: Scheme) -> None:
    """Store a splitting scheme with its name and source."""
    store(integrator, "scheme", text=scheme.name)
    store(integrator, "source", text=scheme.source)
    numbers = [value for stage in scheme.stages for value in (stage.fraction, stage.shift)]
    store(integrator, "stages", numbers, ", ".join(stage.operator for stage in scheme.stages))


def stored_scheme(integrator: openmm.CustomIntegrator) -> Scheme:
    """The scheme that `store_scheme` stored."""
    names, numbers = required(integrator, "stages")
    stages = [
        Stage(name, *map(float, pair)) for name, pair in zip(names.split(", "), numbers.reshape(-1, 2), strict=True)
    ]
    return Scheme(required(integrator, "scheme")[0], tuple(stages), required(integrator, "source")[0])


def place_of(thing: Callable[..., Any] | type) -> str:
    """Module and name by which `from_place` finds a class or function again."""
    name = getattr(thing, "__qualname__", None)
    if name is None or "<" in name:
        # A function without a name of its own: two of them must not look alike.
        return f"{thing!r}"
    return f"{thing.__module__}:{name}"


def from_place(place: str, what: str) -> Any:
    """The class or function at a place that `place_of` gave.

    Raises:
        openmm.OpenMMException: it cannot be imported.
    """
    module, _, name = place.partition(":")
    try:
        found = import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise openmm.OpenMMException(
            f"The {what} {place} of a stored SIER integrator cannot be imported here: {error}"
        ) from error
    return found


def store_bodies(integrator: openmm.CustomIntegrator, bodies: Bodies) -> None:
    """Store the bodies that a user gave: None, lists of particle indices, or `RigidBodies`."""
    if bodies is None:
        return
    if not isinstance(bodies, dynamics.RigidBodies):
        lists = [[int(i) for i in cluster] for cluster in bodies]
        store(integrator, "bodies", [n for cluster in lists for n in (len(cluster), *cluster)], "lists")
        return
    numbers: list[float] = [bodies.n_particles]
    for species in bodies.species:
        numbers += species.atoms.shape
        for values in (species.atoms, species.masses, species.sites, species.moments):
            numbers += values.ravel().tolist()
    store(integrator, "bodies", numbers, "species")


def stored_bodies(integrator: openmm.CustomIntegrator) -> Bodies:
    """The bodies that `store_bodies` stored, bit for bit; names of residues are not stored."""
    if (found := stored(integrator, "bodies")) is None:
        return None
    form, numbers = found
    read = _Reader(numbers)
    if form == "lists":
        lists = []
        while read.left:
            lists.append(read.integers(read.integer()).tolist())
        return lists
    n_particles, species = read.integer(), []
    while read.left:
        m, k = read.integer(), read.integer()
        atoms = read.integers(m * k).reshape(m, k)
        species.append(Species(atoms, read.floats(k), read.floats(3 * k).reshape(3, k), read.floats(3)))
    return RigidBodies(species, n_particles)


class _Reader:
    """Takes numbers one after the other."""

    def __init__(self, numbers: np.ndarray):
        self._numbers, self._at = numbers, 0

    @property
    def left(self) -> bool:
        return self._at < len(self._numbers)

    def floats(self, count: int) -> np.ndarray:
        self._at += count
        return self._numbers[self._at - count : self._at].copy()

    def integers(self, count: int) -> np.ndarray:
        return self.floats(count).astype(np.int64)

    def integer(self) -> int:
        return int(self.integers(1)[0])
