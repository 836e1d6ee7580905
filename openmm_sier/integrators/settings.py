"""Settings of an integrator: one frozen dataclass, stored as one JSON text in what OpenMM serializes.

XML, copies and caches keyed by XML so tell integrators apart. A CustomIntegrator carries numbers in its variables, but
these travel in checkpoints too, and a checkpoint must not bring back the temperature of the run that wrote it.
Tabulated functions are in no checkpoint: OpenMM serializes them with the integrator only. So the text is the values of
a tabulated function that no computation uses, a few characters in each value.

What is read may come from anywhere. Values must have the types of their fields, and are then checked as the arguments
of integrators are. Nothing is imported because a text names it: free-rotation maps are those of this package and those
that integrators were made with in this process; classes are those of this package and subclasses in modules that
somebody has imported.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

import numpy as np
import openmm

from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.bodies import RigidBodies as DynamicsBodies
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.choice import ENGINES
from openmm_sier.ensembles import ENSEMBLES
from openmm_sier.ensembles.ensemble import ConstantEnergy, Ensemble
from openmm_sier.system.arguments import Bodies, checked_bodies, group_mask, step_size
from openmm_sier.system.find_bodies import RigidBodies

#: The version of what is stored, and the name of the function that stores it.
LAYOUT, NAME = 4, "sier settings"

#: Bytes of text in each value: a double holds whole numbers of six bytes exactly.
WIDTH = 6

#: Free-rotation maps by name: those of this package, and any with which an integrator was made in this process.
ROTATIONS: dict[str, Rotation] = {name: getattr(rotation, name) for name in ("exact", "mrdl", "sej4", "rattle")}


class SettingsError(openmm.OpenMMException):
    """Stored settings cannot be used here."""


@dataclass(frozen=True)
class Settings:
    """All that an integrator was asked for; see `SIERIntegrator`, also for errors.

    Attributes:
        kind: module and name of its class.
        step: of the scheme, ps.
        fast_groups: bit mask of the force groups that act within drifts.
        finds_fast_groups: whether those of a prepared System are found in it.
        bodies: as users give them.
    """

    kind: str
    scheme: Scheme
    step: float
    engine: str = "auto"
    substeps: int | None = None
    fast_groups: int = 0
    finds_fast_groups: bool = True
    bodies: Bodies = None
    rotation: Rotation = rotation.exact
    ensemble: Ensemble = ConstantEnergy()  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        if not isinstance(self.scheme, Scheme):
            raise TypeError(f"scheme must be a Scheme, such as openmm_sier.SIER4, got {self.scheme!r}")
        step_size(self.step)
        engines = "auto", *ENGINES
        if self.engine not in engines:
            raise ValueError(f"engine must be one of {', '.join(engines)}, got {self.engine!r}")
        if self.substeps is not None and self.substeps < 1:
            raise ValueError(f"substeps must be at least 1, got {self.substeps}")
        group_mask("fast_groups", self.fast_groups)
        checked_bodies(self.bodies)

    def flow(self, seed: int = 0) -> Flow:
        """What an engine is to follow, with the noise of a seed."""
        plain = Flow(self.scheme, self.step, self.rotation, self.substeps, self.fast_groups)
        return self.ensemble.flow(plain, seed)


# --- in OpenMM's integrator ---


def store(integrator: openmm.CustomIntegrator, settings: Settings) -> None:
    """Store settings in an openmm.CustomIntegrator, in place of those stored before."""
    store_text(integrator, json.dumps(as_json(settings), separators=(",", ":"), allow_nan=False))


def store_text(integrator: openmm.CustomIntegrator, text: str) -> None:
    """Store the text of settings, see `store`."""
    # A function needs at least two values.
    characters = text.encode().ljust(2 * WIDTH)
    values = [float(int.from_bytes(characters[i : i + WIDTH], "big")) for i in range(0, len(characters), WIDTH)]
    found = _find(integrator)
    if found is None:
        integrator.addTabulatedFunction(NAME, openmm.Discrete1DFunction(values))
    else:
        integrator.getTabulatedFunction(found).setFunctionParameters(values)


def is_stored(integrator: openmm.CustomIntegrator) -> bool:
    """Whether an openmm.CustomIntegrator carries settings of this package, of any version."""
    names = map(integrator.getTabulatedFunctionName, range(integrator.getNumTabulatedFunctions()))
    return any(name.startswith("sier ") for name in names)


def stored(integrator: openmm.CustomIntegrator) -> Settings:
    """The settings that an openmm.CustomIntegrator carries.

    Raises:
        SettingsError: they are damaged, of another version, or name what is not known here; the message says which
            field.
    """
    if (found := _find(integrator)) is None:
        raise SettingsError(
            "This SIER integrator was stored by another version of openmm_sier, without its settings: create it anew"
        )
    values = integrator.getTabulatedFunction(found).getFunctionParameters()
    try:
        text = b"".join(int(value).to_bytes(WIDTH, "big").lstrip(b"\0") for value in values)
        table = json.loads(text.decode())
        layout = table.pop("layout", None) if isinstance(table, dict) else None
        if layout != LAYOUT:
            raise SettingsError(
                f"This SIER integrator was stored by another version of openmm_sier, in layout {layout!r} where "
                f"{LAYOUT} is read: create it anew"
            )
        return _decoded(Settings, table, "")
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise SettingsError(f"The settings stored in this SIER integrator are damaged: {error}") from None


def _find(integrator: openmm.CustomIntegrator) -> int | None:
    names = [integrator.getTabulatedFunctionName(i) for i in range(integrator.getNumTabulatedFunctions())]
    return names.index(NAME) if NAME in names else None


# --- as JSON ---


def as_json(settings: Settings) -> dict[str, Any]:
    """Settings as JSON values: a table for each dataclass."""
    return {"layout": LAYOUT, **_encoded(settings)}


def _encoded(value: Any) -> Any:
    if isinstance(value, DynamicsBodies):
        return {"particles": value.n_particles, "species": [_encoded(species) for species in value.species]}
    if is_dataclass(value):
        name = {"name": type(value).__name__} if isinstance(value, Ensemble) else {}
        return name | {field.name: _encoded(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_encoded(each) for each in value]
    return name_of_rotation(value) if callable(value) else value


def _decoded(kind: Any, value: Any, name: str) -> Any:
    """A value of a type from what `_encoded` gave; `name` is the path of its field, for messages."""
    if kind in (Bodies, Rotation, Ensemble):
        return {Bodies: _bodies, Rotation: _rotation, Ensemble: _ensemble}[kind](value)
    if get_origin(kind) is UnionType:
        return None if value is None else _decoded(get_args(kind)[0], value, name)
    if get_origin(kind) is tuple:
        return tuple(_decoded(get_args(kind)[0], each, name) for each in _demand(name, value, list))
    if kind is float:
        number = _demand(name, value, int, float)
        # Neither infinite nor NaN, nor a whole number beyond all floats.
        return float(number) if abs(number) <= sys.float_info.max else _refuse(name, "a finite number", value)
    if kind in (str, int, bool):
        return _demand(name, value, kind)
    names = [each.name for each in fields(kind)] if is_dataclass(kind) else kind.__match_args__
    types = {field: hint for field, hint in get_type_hints(kind).items() if field in names}
    given = _demand(name, value, dict if is_dataclass(kind) else list)
    if isinstance(given, list):
        given = dict(zip(types, given, strict=False)) if len(given) == len(types) else {}
    if set(given) != set(types):
        _refuse(name, f"a table of {', '.join(sorted(types))}", value)
    return kind(**{field: _decoded(hint, given[field], f"{name}.{field}".strip(".")) for field, hint in types.items()})


def name_of_rotation(function: Rotation) -> str:
    """The name by which a free-rotation map is stored; it can be read back in this process from now on.

    Functions without a name of their own, such as lambdas, cannot be read back, but do not look alike.
    """
    known = next((name for name, each in ROTATIONS.items() if each is function), None)
    if known is not None:
        return known
    if "<" in getattr(function, "__qualname__", "<"):
        return repr(function)
    ROTATIONS[place_of(function)] = function
    return place_of(function)


def _rotation(value: Any) -> Rotation:
    name = _demand("rotation", value, str)
    if name not in ROTATIONS:
        raise SettingsError(
            f"The free-rotation map {name} of a stored SIER integrator is not known here: make an integrator with it "
            f"first if it has a name; known are {', '.join(ROTATIONS)}"
        )
    return ROTATIONS[name]


def _ensemble(value: Any) -> Ensemble:
    given = dict(_demand("ensemble", value, dict))
    name = given.pop("name", None)
    if name not in ENSEMBLES:
        _refuse("ensemble.name", f"one of {', '.join(ENSEMBLES)}", name)
    return _decoded(ENSEMBLES[name], given, "ensemble")


def _bodies(value: Any) -> Bodies:
    """Bodies bit for bit; names of residues are not stored."""
    if value is None:
        return None
    if isinstance(value, list):
        return _decoded(tuple[tuple[int, ...], ...], value, "bodies")
    particles, species = (_demand("bodies", value, dict).get(name) for name in ("particles", "species"))
    made = [_species(_demand("bodies.species", each, dict)) for each in _demand("bodies.species", species, list)]
    return RigidBodies(made, _demand("bodies.particles", particles, int))


def _species(given: dict[str, Any]) -> Species:
    try:
        arrays = {field.name: np.array(given.get(field.name), dtype=float) for field in fields(Species)}
    except (TypeError, ValueError):
        _refuse("bodies.species", "arrays of numbers", given)
    k = arrays["atoms"].shape[-1] if arrays["atoms"].ndim == 2 else 0
    shapes = {name: found.shape for name, found in arrays.items() if name != "atoms"}
    finite = all(np.isfinite(found).all() for found in arrays.values())
    if not (k and finite and shapes == {"masses": (k,), "sites": (3, k), "moments": (3,)}):
        _refuse("bodies.species", "finite numbers for m bodies of k atoms", given)
    return Species(**(arrays | {"atoms": arrays["atoms"].astype(np.int64)}))


def _demand(name: str, value: Any, *kinds: type) -> Any:
    # A truth value is a whole number in Python, and none here.
    if type(value) not in kinds:
        _refuse(name, f"of type {' or '.join(kind.__name__ for kind in kinds)}", value)
    return value


def _refuse(name: str, expected: str, got: Any) -> NoReturn:
    raise SettingsError(f"The {name} of a stored SIER integrator must be {expected}, got {repr(got)[:80]}")


# --- classes ---


def place_of(thing: Callable[..., Any] | type) -> str:
    """Module and name of a class or function."""
    return f"{thing.__module__}:{thing.__qualname__}"


def class_at(place: str, base: type) -> type:
    """The subclass of a base at a place that `place_of` gave; no module is imported for it.

    Raises:
        SettingsError: there is no such class in a module that is imported.
    """
    module, _, name = place.partition(":")
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, "__dict__", {}).get(part)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise SettingsError(
            f"The class {place} of a stored SIER integrator is not known here: import its module first, if you trust it"
        )
    return found
