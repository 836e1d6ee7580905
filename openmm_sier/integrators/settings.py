"""Settings of an integrator: the checked arguments of its constructor, stored as JSON in the CustomIntegrator.

This makes XML, copies and XML-keyed caches distinguish integrators. Stored settings may be crafted. They are checked by
the constructors that users call: `Settings`, `Scheme`, `RigidBodies` and those of ensembles. No module is imported by
name: free-rotation maps are those of this package, and classes are those of this package and subclasses in modules that
are already imported.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import openmm

from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.motion import Motion
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.engines.choice import ENGINES
from openmm_sier.ensembles import ENSEMBLES
from openmm_sier.ensembles.ensemble import ConstantEnergy, Ensemble
from openmm_sier.system.arguments import group_mask, rigid_bodies, step_size, whole_number
from openmm_sier.system.find_bodies import RigidBodies

#: Version of the stored settings.
LAYOUT = 2

#: Tabulated function that stores the settings. Global variables will not do: loading a checkpoint would restore old
#: settings.
NAME = "sier settings"

#: Bytes of text in each value: a double represents whole numbers of six bytes exactly.
WIDTH = 6

#: Free-rotation maps by name.
ROTATIONS: dict[str, Rotation] = {name: getattr(rotation, name) for name in ("exact", "mrdl", "sej4", "rattle")}


class SettingsError(openmm.OpenMMException):
    """Stored settings cannot be used here."""


@dataclass(frozen=True)
class Settings:
    """The arguments of an integrator; see `SIERIntegrator`, also for errors.

    Attributes:
        kind: module and name of its class.
        scheme: with a bath if the ensemble has one.
        step: of the scheme, ps.
        engine: name of the engine, or "auto".
        substeps: number of substeps of a drift; None leaves it to the engine.
        fast_groups: bit mask of the force groups that act within drifts; None: those of a prepared System.
        bodies: the rigid bodies; None: those that the System's constraints form.
        rotation: free-rotation map.
        ensemble: rule for what happens between steps.
    """

    kind: str
    scheme: Scheme
    step: float
    engine: str = "auto"
    substeps: int | None = None
    fast_groups: int | None = None
    bodies: BodySet | None = None
    rotation: Rotation = rotation.exact
    ensemble: Ensemble = ConstantEnergy()  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        self._check_types()
        self._set("step", step_size(self.step))
        self._set("bodies", rigid_bodies(self.bodies))
        engines = "auto", *ENGINES
        if self.engine not in engines:
            raise ValueError(f"engine must be one of {', '.join(engines)}, got {self.engine!r}")
        if self.substeps is not None:
            self._set("substeps", whole_number("substeps", self.substeps, least=1))
        self._set("scheme", self.ensemble.scheme_for(self.scheme))
        if self.fast_groups is not None:
            self._set("fast_groups", group_mask("fast_groups", self.fast_groups))

    def _check_types(self) -> None:
        """Check the types of fields that are not checked elsewhere."""
        if not isinstance(self.kind, str):
            raise TypeError(f"kind must be the module and name of a class, got {self.kind!r}")
        if not isinstance(self.scheme, Scheme):
            raise TypeError(f"scheme must be a Scheme, such as openmm_sier.SIER4, got {self.scheme!r}")
        if not callable(self.rotation):
            raise TypeError(f"rotation must be a free-rotation map, such as rotation.exact, got {self.rotation!r}")
        if not isinstance(self.ensemble, Ensemble):
            raise TypeError(f"ensemble must be one of openmm_sier.ensembles, such as Langevin, got {self.ensemble!r}")

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def method(self, prepared: int = 0) -> IntegrationMethod:
        """Return the method for an engine.

        Args:
            prepared: the fast force groups of the System, a bit mask, for settings without fast groups.
        """
        fast_groups = prepared if self.fast_groups is None else self.fast_groups
        return self.ensemble.method(
            IntegrationMethod(self.scheme, self.step, self.rotation, self.substeps, fast_groups)
        )


# --- in OpenMM's integrator ---


def store(integrator: openmm.CustomIntegrator, settings: Settings) -> None:
    """Store settings in an openmm.CustomIntegrator; they replace earlier ones."""
    store_text(integrator, json.dumps(as_json(settings), separators=(",", ":"), allow_nan=False))


def store_text(integrator: openmm.CustomIntegrator, text: str) -> None:
    """Store the text of settings, see `store`."""
    # A function needs at least two values.
    characters = text.encode().ljust(2 * WIDTH)
    # The last number has fewer characters.
    end = len(characters) - len(characters) % WIDTH
    numbers = np.frombuffer(characters[:end], np.uint8).reshape(-1, WIDTH) @ 256 ** np.arange(WIDTH)[::-1]
    values = numbers.astype(float).tolist() + [float(int.from_bytes(characters[end:], "big"))] * (end < len(characters))
    names = _functions(integrator)
    if NAME in names:
        integrator.getTabulatedFunction(names.index(NAME)).setFunctionParameters(values)
    else:
        integrator.addTabulatedFunction(NAME, openmm.Discrete1DFunction(values))


def is_stored(integrator: openmm.CustomIntegrator) -> bool:
    """Return whether an openmm.CustomIntegrator contains settings of this package, in any layout."""
    return NAME in _functions(integrator)


def stored(integrator: openmm.CustomIntegrator) -> Settings:
    """Return the settings in an openmm.CustomIntegrator, see `is_stored`.

    Raises:
        SettingsError: they are damaged, of another version, or contain an unknown name.
    """
    values = integrator.getTabulatedFunction(_functions(integrator).index(NAME)).getFunctionParameters()
    try:
        text = b"".join(int(value).to_bytes(WIDTH, "big").lstrip(b"\0") for value in values)
        return from_json(json.loads(text.decode()))
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError, RecursionError) as error:
        raise SettingsError(f"The settings stored in this SIER integrator are damaged: {error!r}") from None


def _functions(integrator: openmm.CustomIntegrator) -> list[str]:
    return [integrator.getTabulatedFunctionName(i) for i in range(integrator.getNumTabulatedFunctions())]


# --- as JSON ---


def as_json(settings: Settings) -> dict[str, Any]:
    """Return settings as JSON values, each under the name of its field."""
    values = {field.name: getattr(settings, field.name) for field in fields(settings)}
    values["scheme"] = asdict(settings.scheme)
    values["rotation"] = _name_of_rotation(settings.rotation)
    values["ensemble"] = {"name": type(settings.ensemble).__name__, **asdict(settings.ensemble)}
    if isinstance(settings.bodies, BodySet):
        values["bodies"] = _table_of_bodies(settings.bodies)
    return {"layout": LAYOUT, **values}


def from_json(table: Any) -> Settings:
    """Return settings from the result of `as_json`.

    Raises:
        SettingsError: the table is of another version, or contains an unknown name.
        TypeError, ValueError, LookupError, OverflowError: a constructor refuses a value.
    """
    values = dict(table)
    if (layout := values.pop("layout", None)) != LAYOUT:
        raise SettingsError(
            f"This SIER integrator was stored by another version of openmm_sier, in layout {layout!r}, and this "
            f"version reads layout {LAYOUT}: create a new integrator"
        )
    values["scheme"] = Scheme(**values["scheme"])
    values["rotation"] = _rotation(values["rotation"])
    ensemble = dict(values["ensemble"])
    values["ensemble"] = ENSEMBLES[ensemble.pop("name")](**ensemble)
    if values["bodies"] is not None:
        values["bodies"] = _bodies(values["bodies"])
    return Settings(**values)


def _table_of_bodies(bodies: BodySet) -> dict[str, Any]:
    """Return all numbers of bodies exactly, without the names of residues."""
    numbers = [kind.tolist() for kind in bodies.numbers]
    species = [_table_of_species(kind) for kind in bodies.species]
    return {"particles": bodies.n_particles, "species": species, "numbers": numbers}


def _table_of_species(species: Species) -> dict[str, Any]:
    values = {field.name: getattr(species, field.name) for field in fields(species)}
    arrays = {name: value.tolist() for name, value in values.items() if isinstance(value, np.ndarray)}
    return {**arrays, "name": species.name, "motion": asdict(species.motion)}


def _bodies(table: dict[str, Any]) -> BodySet:
    species = [_species(kind) for kind in table["species"]]
    # Older versions numbered bodies species by species.
    numbers = [np.array(kind, dtype=np.int64) for kind in table["numbers"]] if "numbers" in table else None
    return RigidBodies(species, whole_number("particles", table["particles"]), numbers=numbers)


def _species(table: dict[str, Any]) -> Species:
    values = dict(table)
    name = str(values.pop("name", ""))
    motion = Motion(**values.pop("motion", {}))
    arrays = {field: np.array(numbers) for field, numbers in values.items()}
    return Species(**arrays, name=name, motion=motion)


def _name_of_rotation(function: Rotation) -> str:
    """Return the name of a free-rotation map; a map of users, which cannot be restored, has a text of its own."""
    return next((name for name, known in ROTATIONS.items() if known is function), repr(function))


def _rotation(name: Any) -> Rotation:
    if name not in ROTATIONS:
        raise SettingsError(
            f"The free-rotation map {name} of a stored SIER integrator is not known here; known are "
            f"{', '.join(ROTATIONS)}. A map of your own cannot be restored"
        )
    return ROTATIONS[name]


# --- classes ---


def place_of(member: Callable[..., Any] | type) -> str:
    """Return module and name of a class or function."""
    return f"{member.__module__}:{member.__qualname__}"


def class_at(place: str, base: type) -> type:
    """Return the subclass of `base` with a name from `place_of`, without importing a module.

    Raises:
        SettingsError: no imported module has such a class.
    """
    module, _, name = place.partition(":")
    member: Any = sys.modules.get(module)
    for attribute in name.split("."):
        member = getattr(member, "__dict__", {}).get(attribute)
    if not (isinstance(member, type) and issubclass(member, base)):
        raise SettingsError(
            f"The class {place} of a stored SIER integrator is not known here: import its module first, if you trust it"
        )
    return member
