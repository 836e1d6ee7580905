"""Langevin dynamics: a bath inside the scheme."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from openmm_sier.dynamics.friction import Friction
from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.ensembles.ensemble import UNITS, ConstantTemperature, make_number
from openmm_sier.system.arguments import along_axes


@dataclass(frozen=True)
class Langevin(ConstantTemperature):
    """Keep a constant temperature by friction and noise on each momentum, as `SIERLangevinIntegrator` does.

    Attributes:
        temperature: in K.
        friction: of translation, 1/ps: a number for all bodies, or a mapping from the names of types to a number or to
            three, along the principal axes. In place of a name "default" stands for all bodies that are not named.
        rotational_friction: of rotation, likewise, about the principal axes; None: that of translation, also after that
            was changed.
        counts_heat: tells whether engines other than the exact one count the heat of the bath; None: except on GPUs.
    """

    friction: Friction
    rotational_friction: Friction | None = None
    counts_heat: bool | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        _make_friction(self, "friction", "frictionCoeff")
        if self.rotational_friction is not None:
            _make_friction(self, "rotational_friction", "rotationalFriction")
        if self.counts_heat not in (None, True, False):
            raise TypeError(f"countsHeat must be True, False or None, got {self.counts_heat!r}")

    @property
    def turning(self) -> Friction:
        """Return the friction of rotation, 1/ps."""
        return self.friction if self.rotational_friction is None else self.rotational_friction

    @property
    def has_friction(self) -> bool:
        """Return whether translation has friction; that of rotation alone leaves the total momentum as it is."""
        return _is_felt(self.friction)

    def scheme_for(self, scheme: Scheme) -> Scheme:
        return scheme.with_bath()

    def method(self, method: IntegrationMethod) -> IntegrationMethod:
        """Return a method with the bath, or without it if there is no friction: then the scheme is followed alone."""
        has_bath = _is_felt(self.friction) or _is_felt(self.turning)
        scheme = method.scheme if has_bath else method.scheme.without_bath()
        bath = OrnsteinUhlenbeck(self.temperature, self.friction, self.turning)
        return replace(method, scheme=scheme, bath=bath, counts_heat=self.counts_heat)


def _is_felt(friction: Friction) -> bool:
    """Return whether some body has the friction."""
    return any(map(any, friction.values())) if isinstance(friction, Mapping) else friction > 0


def _make_friction(ensemble: Langevin, field: str, name: str) -> None:
    """Make a field a number in 1/ps, or a mapping from names of types to three numbers.

    Raises:
        ValueError: a number is negative or not finite, or a type has neither one nor three.
        TypeError: a key is no text, a value no number, or a quantity has the wrong dimension.
    """
    given = getattr(ensemble, field)
    if not isinstance(given, Mapping):
        make_number(ensemble, field, name, "1/ps", least=0)
        return
    frictions = {}
    for key, value in given.items():
        if not isinstance(key, str):
            raise TypeError(f"{name} must be a number, or numbers by the names of types, got the key {key!r}")
        frictions[key] = along_axes(f"{name}[{key!r}]", value, UNITS["1/ps"], "1/ps")
    object.__setattr__(ensemble, field, frictions)
