"""Damping: a bath of 0 K is friction, whose trajectories and heat are exactly known.

Averages do not see what is of second order in the step, and a strong bath hides what one step does wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from hypothesis import strategies as st

from openmm_sier import RigidBodies, SIERLangevinIntegrator
from openmm_sier.dynamics.schemes import CATALOGUE
from tests.laws.law import Law, rejecting_refusals
from tests.laws.mixture_strategies import mixtures, mixtures_without_vibrations
from tests.laws.mixtures import Mixture, harden
from tests.laws.oracle import End, Oracle
from tests.laws.readings import rigid_atoms
from tests.support.waters import context_at, phase_point

#: ps: length of the trajectories, and steps.
TIME, STEPS = 0.004, (0.0005, 0.00025)

#: A bath is exact, and the scheme with it of second order. The next term of the error is of an order higher by one
#: where forces of the start come first: see `tests/laws/test_order.py`.
ORDER, SLACK = 2, 0.6

#: nm, and relative to the heat or 1 kJ/mol. Smaller errors say nothing: OpenMM rounds lengths of SETTLE to single
#: precision, 6e-8 of 0.2 nm, and what many atoms give and take cancels. What a force adds to velocities along
#: constraints in 0.25 fs, 0.1 nm/ps, has 0.01 kJ/mol.
NOISE, NOISE_OF_HEAT = 2e-8, 1e-5


@dataclass(frozen=True)
class Damping:
    """A mixture in a bath of 0 K.

    Attributes:
        mixture: what moves, without a box.
        scheme: name of the scheme.
        friction: 1/ps.
        turning: friction of rotation, 1/ps; None: the same.
        platform: name of the platform.
        engines: names of those that are tried, of which the native one has one friction.
        by_axes: whether the exact engine gets the frictions for each axis.
    """

    mixture: Mixture
    scheme: str = "sier2"
    friction: float = 200.0
    turning: float | None = None
    platform: str = "Reference"
    engines: tuple[str, ...] = ("exact", "native")
    by_axes: bool = False

    def check(self) -> None:
        built = self.mixture.build()
        oracle = Oracle(built, self.friction, self.friction)
        if self.turning is not None:
            bodies = RigidBodies.from_system(built.system, rigid=built.named, positions=built.positions)
            oracle = Oracle(built, self.friction, self.turning, rigid_atoms(built.system, bodies))
        expected = oracle.end(TIME)
        for engine in self.engines:
            if engine == "native" and self.turning is not None:
                continue
            ends = [self._end(engine, oracle, step) for step in STEPS]
            noise = NOISE_OF_HEAT * (1 + abs(expected.heat))
            self._assert_order(engine, "positions", [end.positions - expected.positions for end in ends], NOISE)
            self._assert_order(engine, "heat", [end.heat - expected.heat for end in ends], noise)

    def _assert_order(self, engine: str, name: str, differences: list, noise: float) -> None:
        errors = [float(np.abs(difference).max()) for difference in differences]
        shown = np.log2(errors[0] / errors[1]) if errors[1] > noise else np.inf
        assert shown > ORDER - SLACK, (
            f"{engine} engine: errors of the {name} of {errors[0]:.2g} and {errors[1]:.2g} in steps of "
            f"{STEPS[0] * 1000:g} and {STEPS[1] * 1000:g} fs are of order {shown:.2f}"
        )

    def _end(self, engine: str, oracle: Oracle, step: float) -> End:
        """Return the end of a run from the start of the oracle."""
        built = self.mixture.build()
        by_axes = self.by_axes and engine == "exact"
        integrator = SIERLangevinIntegrator(
            0.0,
            along_axes(self.friction) if by_axes else self.friction,
            step,
            self.scheme,
            rotationalFriction=along_axes(self.turning) if by_axes else self.turning,
            bodies=built.bodies,
            engine=engine,
            countsHeat=True,
        )
        # Momenta that lag behind by a part of a kick begin so too.
        start = built.positions, oracle.kicked(-integrator.scheme.momentum_lag * step)
        with rejecting_refusals(engine):
            context = context_at(built.system, integrator, start, self.platform)
        harden(context)
        integrator.step(round(TIME / step))
        return End(phase_point(context)[0], integrator.countedHeat)


def along_axes(friction: float | None) -> dict[str, tuple[float, float, float]] | None:
    """Return a friction of all bodies, the same along each axis."""
    return None if friction is None else {"default": (friction, friction, friction)}


@st.composite
def cases(draw: st.DrawFn, platform: str) -> Damping:
    """Draw a mixture in vacuum that is not prepared, and a bath, above all one in the middle of a drift."""
    turning = draw(st.sampled_from([None, None, 50.0, 0.0]))
    named = turning is not None
    # Without vibrations, whose errors are larger, heat shows what constraints leave of velocities.
    mixture = draw(st.one_of(mixtures_without_vibrations(named), mixtures(("vacuum",), ("no",), named)))
    scheme = draw(st.one_of(st.just("sier2"), st.sampled_from(list(CATALOGUE))))
    friction = draw(st.sampled_from([200.0, 50.0]))
    by_axes = draw(st.sampled_from([False, True]))
    return Damping(replace(mixture, remover=0), scheme, friction, turning, platform, by_axes=by_axes)


LAW = Law("damping", cases, few=15)


@LAW.numbers()
def test_a_bath_without_heat_is_friction(examples):
    LAW.hold(examples)
