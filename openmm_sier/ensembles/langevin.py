"""Langevin dynamics: a bath inside the scheme."""

from dataclasses import dataclass, field, replace

from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.thermostat import OrnsteinUhlenbeck
from openmm_sier.ensembles.ensemble import ConstantTemperature, make_number


@dataclass(frozen=True)
class Langevin(ConstantTemperature):
    """Keep a constant temperature by friction and noise on each momentum, as `SIERLangevinIntegrator` does.

    Attributes:
        temperature: in K.
        friction: of translation, 1/ps.
        rotational_friction: 1/ps; None: that of translation, also after that was changed.
        counts_heat: tells whether the native engine counts the heat of the bath; None counts it except on GPUs.
    """

    friction: float
    rotational_friction: float | None = None
    counts_heat: bool | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        make_number(self, "friction", "frictionCoeff", "1/ps", least=0)
        if self.rotational_friction is not None:
            make_number(self, "rotational_friction", "rotationalFriction", "1/ps", least=0)
        if self.counts_heat not in (None, True, False):
            raise TypeError(f"countsHeat must be True, False or None, got {self.counts_heat!r}")

    @property
    def turning(self) -> float:
        """Return the friction of rotation, 1/ps."""
        return self.friction if self.rotational_friction is None else self.rotational_friction

    @property
    def has_friction(self) -> bool:
        """Return whether translation has friction; that of rotation alone leaves the total momentum as it is."""
        return self.friction > 0

    def scheme_for(self, scheme: Scheme) -> Scheme:
        return scheme.with_bath()

    def method(self, method: IntegrationMethod) -> IntegrationMethod:
        """Return a method with the bath, or without it if there is no friction: then the scheme is followed alone."""
        scheme = method.scheme.without_bath() if self.friction == self.turning == 0 else method.scheme
        bath = OrnsteinUhlenbeck(self.temperature, self.friction, self.turning)
        return replace(method, scheme=scheme, bath=bath, counts_heat=self.counts_heat)
