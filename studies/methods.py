"""The integrators that studies compare: those of this package by scheme and free rotation, and OpenMM's own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import openmm

from openmm_sier.dynamics import rotation
from openmm_sier.dynamics.operators import Rotation
from openmm_sier.dynamics.schemes import CATALOGUE, SIER2, SIER4, Scheme
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator

#: `Method.bias` of SIER2 at constant energy: the modified Hamiltonian of kick, drift, kick has the inverse
#: mass (1 + (h w)^2/6)/m. With the bath in the middle of its drift it has none (`Scheme.with_bath`).
BIAS_NVE, BIAS_NVT = 1 / 6, 0.0


@dataclass(frozen=True)
class Method:
    """An integrator to compare.

    Attributes:
        name: for tables.
        forces: evaluations per step.
        order: of its energy error in the step.
        make: step in ps -> integrator.
        bias: a step h changes the temperature of a degree of freedom of frequency w by the fraction -bias (h w)^2, to
            leading order; NaN where there is no such law. There is none for Verlet: SETTLE's free rotation, which is
            not exact, has a bias of its own.
    """

    name: str
    forces: int
    order: int
    make: Callable[[float], openmm.Integrator]
    bias: float = math.nan


@dataclass(frozen=True)
class OwnMethod(Method):
    """An integrator of this package, with its scheme and the free-rotation map in it."""

    scheme: Scheme = SIER2
    rotation: Rotation = rotation.exact


def of_scheme(scheme: Scheme, turn: Rotation = rotation.exact, name: str = "", **options: Any) -> OwnMethod:
    """A scheme at constant energy.

    Args:
        scheme: what is done in a step.
        turn: the free-rotation map in it.
        name: for tables; that of the scheme unless given.
        options: of `SIERIntegrator`.
    """
    make = partial(SIERIntegrator, scheme=scheme, rotation=turn, **options)
    bias = BIAS_NVE if scheme is SIER2 and turn is rotation.exact else math.nan
    return OwnMethod(name or scheme.name, scheme.force_evaluations, scheme.order, make, bias, scheme, turn)


#: The four integrators that van Zon and Schofield (2007) compare.
PAPER = (
    of_scheme(SIER2, rotation.mrdl, "MRDL"),
    of_scheme(SIER2, rotation.sej4, "SEJ4"),
    of_scheme(SIER2),
    of_scheme(SIER4),
)

#: The schemes of the catalogue, by lower-case name.
SCHEMES = {name: of_scheme(scheme) for name, scheme in CATALOGUE.items()}

#: OpenMM's Verlet with SETTLE and the schemes of the catalogue.
CONSTANT_ENERGY: dict[str, Method] = {"verlet": Method("OpenMM Verlet", 1, 2, openmm.VerletIntegrator), **SCHEMES}

#: Trajectories that can be reversed, for hybrid Monte Carlo: Verlet with RATTLE solved to rounding, and the schemes.
REVERSIBLE = {"verlet": of_scheme(SIER2, rotation.rattle, "Verlet, RATTLE"), **SCHEMES}


def with_bath(temperature: float, friction: float, seed: int) -> dict[str, Method]:
    """OpenMM's LangevinMiddle and every scheme of the catalogue with a heat bath, by lower-case name."""

    def seeded(h: float, kind: Callable[..., openmm.Integrator]) -> openmm.Integrator:
        integrator = kind(temperature, friction, h)
        integrator.setRandomNumberSeed(seed)
        return integrator

    middle = partial(seeded, kind=openmm.LangevinMiddleIntegrator)
    methods = {"langevinmiddle": Method("OpenMM LangevinMiddle", 1, 2, middle)}
    for name, scheme in CATALOGUE.items():
        make = partial(seeded, kind=partial(SIERLangevinIntegrator, scheme=scheme))
        bias = BIAS_NVT if scheme is SIER2 else math.nan
        methods[name] = Method(f"{scheme.name} Langevin", scheme.force_evaluations, scheme.order, make, bias)
    return methods
