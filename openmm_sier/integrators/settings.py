"""Settings of an integrator: one frozen dataclass, stored as one JSON text in what OpenMM serializes.

XML, copies and caches keyed by XML so tell integrators apart. A CustomIntegrator carries numbers in its variables, but
these travel in checkpoints too, and a checkpoint must not bring back the temperature of the run that wrote it.
Tabulated functions are in no checkpoint: OpenMM serializes them with the integrator only. So the text is the values of
a tabulated function that no computation uses, a few characters in each value.

What is read may come from anywhere. It is checked as the arguments of integrators are, and nothing is imported because
a text names it: free-rotation maps are those of this package and those that integrators were made with in this process;
classes are those of this package and subclasses in modules that somebody has imported.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.bodies import RigidBodies as DynamicsBodies
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.dynamics.stages import Stage
from openmm_sier.ensembles.ensemble import ConstantEnergy, Ensemble
from openmm_sier.ensembles.langevin import Langevin
from openmm_sier.ensembles.metropolis import Metropolis
from openmm_sier.system.arguments import GROUPS, Bodies
from openmm_sier.system.find_bodies import RigidBodies

#: The version of what is stored, and the name of the function that stores it.
LAYOUT, NAME = 1, "sier settings"

ENGINES = ("auto", "exact", "native")

#: Bytes of text in each value: a double holds whole numbers of six bytes exactly.
WIDTH = 6

#: JSON has no infinity.
INFINITE = "infinite"

ENSEMBLES: dict[str, type[Any]] = {cls.name: cls for cls in (ConstantEnergy, Langevin, Metropolis)}

#: Free-rotation maps by name: those of this package, and any with which an integrator was made in this process.
ROTATIONS: dict[str, Rotation] = {name: getattr(rotation, name) for name in ("exact", "mrdl", "sej4", "rattle")}


class SettingsError(openmm.OpenMMException):
    """Stored settings cannot be used here."""


@dataclass(frozen=True)
class Settings:
    """All that an integrator was asked for.

    Attributes:
        kind: module and name of its class.
        scheme: the splitting scheme.
        step: of the scheme, ps.
        engine: "auto", "exact" or "native".
        substeps: see `SIERIntegrator`; None leaves it to the engine.
        fast_groups: bit mask of the force groups that act within drifts.
        finds_fast_groups: whether those of a prepared System are found in it.
        bodies: as users give them.
        rotation: free-rotation map.
        ensemble: what happens between flows.
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


# --- in OpenMM's integrator ---


def store(integrator: openmm.CustomIntegrator, settings: Settings) -> None:
    """Store settings in an openmm.CustomIntegrator, in place of those stored before."""
    store_text(integrator, json.dumps(as_json(settings), separators=(",", ":")))


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
        return from_json(json.loads(text.decode()))
    except SettingsError:
        raise
    except (ValueError, OverflowError, RecursionError) as error:
        raise SettingsError(f"The settings stored in this SIER integrator are damaged: {error}") from None


def _find(integrator: openmm.CustomIntegrator) -> int | None:
    for i in range(integrator.getNumTabulatedFunctions()):
        if integrator.getTabulatedFunctionName(i) == NAME:
            return i
    return None


# --- as JSON ---


def as_json(settings: Settings) -> dict[str, Any]:
    """Settings as JSON values."""
    scheme = settings.scheme
    return {
        "layout": LAYOUT,
        "kind": settings.kind,
        "scheme": {
            "name": scheme.name,
            "source": scheme.source,
            "stages": [[stage.operator, stage.fraction, stage.shift] for stage in scheme.stages],
        },
        "step": settings.step,
        "engine": settings.engine,
        "substeps": settings.substeps,
        "fast_groups": settings.fast_groups,
        "finds_fast_groups": settings.finds_fast_groups,
        "bodies": _bodies_as_json(settings.bodies),
        "rotation": name_of_rotation(settings.rotation),
        "ensemble": _ensemble_as_json(settings.ensemble),
    }


def from_json(values: Any) -> Settings:
    """The settings that `as_json` gave.

    Raises:
        SettingsError: see `stored`.
    """
    given = _table("settings", values)
    if given.get("layout") != LAYOUT:
        raise SettingsError(
            f"This SIER integrator was stored by another version of openmm_sier, in layout {given.get('layout')!r} "
            f"where {LAYOUT} is read: create it anew"
        )
    wanted = {field.name for field in fields(Settings)}
    _demand_fields("settings", given, wanted | {"layout"})
    return Settings(
        kind=_text("kind", given["kind"]),
        scheme=_scheme(given["scheme"]),
        step=_number("step", given["step"], 0.0),
        engine=_choice("engine", given["engine"], ENGINES),
        substeps=None if given["substeps"] is None else _whole("substeps", given["substeps"], 1),
        fast_groups=_whole("fast_groups", given["fast_groups"], 0, 2**GROUPS - 1),
        finds_fast_groups=_choice("finds_fast_groups", given["finds_fast_groups"], (True, False)),
        bodies=_bodies(given["bodies"]),
        rotation=_rotation(given["rotation"]),
        ensemble=_ensemble(given["ensemble"]),
    )


def _scheme(value: Any) -> Scheme:
    given = _table("scheme", value)
    _demand_fields("scheme", given, {"name", "source", "stages"})
    stages = []
    for row in _list("scheme.stages", given["stages"]):
        if not isinstance(row, list) or len(row) != 3:
            raise SettingsError(_wrong("scheme.stages", "rows of operator, fraction and shift", row))
        operator = _text("scheme.stages", row[0])
        stages.append(Stage(operator, *(_number("scheme.stages", number) for number in row[1:])))
    try:
        return Scheme(_text("scheme.name", given["name"]), tuple(stages), _text("scheme.source", given["source"]))
    except ValueError as error:
        raise SettingsError(f"The scheme of a stored SIER integrator is none: {error}") from None


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
    name = _text("rotation", value)
    if name not in ROTATIONS:
        raise SettingsError(
            f"The free-rotation map {name} of a stored SIER integrator is not known here: make an integrator with it "
            f"first if it has a name; known are {', '.join(ROTATIONS)}"
        )
    return ROTATIONS[name]


def _ensemble_as_json(ensemble: Ensemble) -> dict[str, Any]:
    values = {name: value for name, value in vars(ensemble).items() if name != "volume_move"}
    if (move := getattr(ensemble, "volume_move", None)) is not None:
        values |= {"pressure": move.pressure, "interval": move.interval}
    return {"name": ensemble.name} | {k: INFINITE if v == math.inf else v for k, v in values.items()}


def _ensemble(value: Any) -> Ensemble:
    given = dict(_table("ensemble", value))
    cls = ENSEMBLES[_choice("ensemble.name", given.pop("name", None), tuple(ENSEMBLES))]
    move = None
    if {"pressure", "interval"} & set(given):
        pressure, interval = given.pop("pressure", None), given.pop("interval", None)
        move = MonteCarloVolumeMove(_number("ensemble.pressure", pressure), _whole("ensemble.interval", interval, 1))
    names = {field.name for field in fields(cls)}
    _demand_fields("ensemble", given, names - {"volume_move"})
    if "volume_move" in names:
        values: dict[str, Any] = {"volume_move": move}
    elif move is None:
        values = {}
    else:
        raise SettingsError(_wrong("ensemble.pressure", f"none for {cls.name}", move.pressure))
    for name, number in given.items():
        if name == "steps_per_trial":
            values[name] = _whole(f"ensemble.{name}", number, 1)
        elif number is None and name == "rotational_friction":
            values[name] = None
        elif number == INFINITE and cls is Metropolis and name == "friction":
            values[name] = math.inf
        else:
            values[name] = _number(f"ensemble.{name}", number, 0.0)
    return cls(**values)


def _bodies_as_json(bodies: Bodies) -> Any:
    if bodies is None:
        return None
    if not isinstance(bodies, DynamicsBodies):
        return [[int(i) for i in cluster] for cluster in bodies]
    species = [
        {name: getattr(each, name).tolist() for name in ("atoms", "masses", "sites", "moments")}
        for each in bodies.species
    ]
    return {"particles": bodies.n_particles, "species": species}


def _bodies(value: Any) -> Bodies:
    """Bodies bit for bit; names of residues are not stored."""
    if value is None:
        return None
    if isinstance(value, list):
        return [[_whole("bodies", i, 0) for i in _list("bodies", cluster)] for cluster in value]
    given = _table("bodies", value)
    _demand_fields("bodies", given, {"particles", "species"})
    species = []
    for each in _list("bodies.species", given["species"]):
        parts = _table("bodies.species", each)
        _demand_fields("bodies.species", parts, {"atoms", "masses", "sites", "moments"})
        atoms = _array("bodies.species.atoms", parts["atoms"], (None, None)).astype(np.int64)
        k = atoms.shape[1]
        shapes = {"masses": (k,), "sites": (3, k), "moments": (3,)}
        arrays = [_array(f"bodies.species.{name}", parts[name], shape) for name, shape in shapes.items()]
        species.append(Species(atoms, *arrays))
    try:
        return RigidBodies(species, _whole("bodies.particles", given["particles"], 0))
    except ValueError as error:
        raise SettingsError(f"The bodies of a stored SIER integrator are none: {error}") from None


# --- classes ---


def place_of(thing: Callable[..., Any] | type) -> str:
    """Module and name of a class or function."""
    return f"{thing.__module__}:{thing.__qualname__}"


def class_at(place: str, base: type) -> type:
    """The class at a place that `place_of` gave; no module is imported for it.

    Args:
        place: module and name.
        base: what it must be a subclass of.

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


# --- values ---


def _wrong(name: str, expected: str, got: Any) -> str:
    shown = repr(got)
    return f"The {name} of a stored SIER integrator must be {expected}, got {shown[:80]}"


def _table(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise SettingsError(_wrong(name, "a table", value))
    return value


def _demand_fields(name: str, given: Mapping[str, Any], wanted: set[str]) -> None:
    if set(given) != wanted:
        raise SettingsError(_wrong(name, f"a table of {', '.join(sorted(wanted))}", sorted(given)))


def _list(name: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise SettingsError(_wrong(name, "a list", value))
    return value


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise SettingsError(_wrong(name, "a text", value))
    return value


def _choice(name: str, value: Any, choices: tuple[Any, ...]) -> Any:
    if not any(value is each or (isinstance(value, str) and value == each) for each in choices):
        raise SettingsError(_wrong(name, f"one of {', '.join(map(str, choices))}", value))
    return value


def _number(name: str, value: Any, least: float = -math.inf) -> float:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < sys.float_info.max
    if not is_number or value < least:
        raise SettingsError(_wrong(name, "a finite number" + f" from {least:g}" * math.isfinite(least), value))
    return float(value)


def _whole(name: str, value: Any, least: int, most: int = 2**53) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise SettingsError(_wrong(name, f"a whole number from {least} to {most}", value))
    return value


def _array(name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise SettingsError(_wrong(name, "an array of numbers", value)) from None
    fits = found.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, found.shape, strict=True))
    if not fits or not np.isfinite(found).all():
        raise SettingsError(_wrong(name, f"finite numbers of shape {shape}", value))
    return found
