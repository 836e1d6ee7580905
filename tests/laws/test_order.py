"""Order: against exact trajectories, errors of positions fall with the order of the scheme.

So they do for every System, scheme and number of inner steps, prepared or not, on both engines.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import openmm
import pytest
from hypothesis import strategies as st

from openmm_sier import FramedSystem, SIERIntegrator, prepare_system, with_frames
from openmm_sier.dynamics.schemes import CATALOGUE
from tests.laws.law import Law, rejecting_refusals
from tests.laws.mechanics import centre_of, masses_of, rigid_velocities
from tests.laws.mixture_strategies import mixtures, mixtures_without_vibrations
from tests.laws.mixtures import HEAVY, SURROUNDINGS, Built, Mixture, harden, is_frozen
from tests.laws.oracle import Oracle
from tests.support import opencl
from tests.support.waters import platform, properties_of

#: ps: length of the trajectories, and steps. The last one is for errors of the first two whose next term is large, such
#: as those of RATTLE in molecules that spin fast.
TIME, STEPS = 0.004, (0.0005, 0.00025, 0.000125)

#: nm. Smaller errors say nothing. OpenMM rounds lengths of SETTLE and of frames to single precision, 6e-8 of 0.2 nm. In
#: boxes forces end at the cut-off: a jump of 1 kJ/mol/nm displaces a hydrogen that crosses it within a step of 0.25 fs
#: by 1e-6 nm at most, and PME at OpenMM's default tolerance jumps by a tenth of that. Forces of single precision are
#: good to 1e-7 of some 10^4 kJ/mol/nm, which move a hydrogen by 3e-8 nm. Where drifts leave out constraints, or forces
#: use sites of the step before, errors at 0.25 fs are from 1e-7 nm for a single charge to 1e-4 nm.
NOISE = {"vacuum": 1e-8, "box": 2e-7}
NOISE_OF_SINGLE_PRECISION = {"vacuum": 1e-7, "box": 1e-6}

#: Factor on time and steps where nothing vibrates. The hydrogens of rigid water swing with 0.2/fs at most.
PACE = 4

#: By how much the order that two steps show may be below that of the scheme. The next term of the error is of an order
#: higher by two: at 0.5 fs it is at most a fifth of the first for bonds to hydrogens, (w h)^2/12 with w = 0.6/fs.
SLACK = 0.6

#: Those that move a mixture on any platform.
ENGINES = ("exact", "native")


@dataclass(frozen=True)
class Order:
    """A mixture that both engines move by a scheme; the native engine moves named bodies by frames.

    Attributes:
        mixture: what moves.
        scheme: name of the scheme.
        substeps: as the integrator's argument.
        platform: name of the platform.
        pace: factor on time and steps, for mixtures in which nothing vibrates.
        engines: names of those that are tried; mixtures that kernels refuse are left out.
    """

    mixture: Mixture
    scheme: str = "sier2"
    substeps: int | None = None
    platform: str = "Reference"
    pace: int = 1
    engines: tuple[str, ...] = ENGINES

    def check(self) -> None:
        built = self.mixture.build()
        expected = Oracle(built).end(self.pace * TIME).positions
        for engine in self.engines:
            ends = self._ends(built, engine)
            errors = [self._distance(built, found, expected) for found in islice(ends, 2)]
            if self._shown(errors) < self._order(engine) - SLACK:
                errors.append(self._distance(built, next(ends), expected))
            assert self._shown(errors) > self._order(engine) - SLACK, (
                f"{engine} engine: errors of {', '.join(f'{error:.2g}' for error in errors)} nm in steps of "
                f"{', '.join(f'{step * 1000:g}' for step in self._steps)} fs are of order {self._shown(errors):.2f}"
            )

    def _shown(self, errors: list[float]) -> float:
        """Return the order that the errors of the last two steps show."""
        return float(np.log2(errors[-2] / errors[-1])) if errors[-1] > self._noise() else math.inf

    @property
    def _steps(self) -> list[float]:
        return [self.pace * step for step in STEPS]

    def _order(self, engine: str) -> int:
        """Return the order of the trajectories."""
        order = CATALOGUE[self.scheme].order
        if engine != "native" or self.substeps in (None, 3, 5):
            return order
        # Without fast forces drifts are this number of RATTLE steps, of second order.
        return min(order, 2)

    def _noise(self) -> float:
        noise = NOISE if self.platform == "Reference" else NOISE_OF_SINGLE_PRECISION
        return noise["vacuum" if self.mixture.surroundings == "vacuum" else "box"]

    def _distance(self, built: Built, found: np.ndarray, expected: np.ndarray) -> float:
        """Return the largest error of a coordinate, nm."""
        apart = found - expected
        if self.mixture.remover:
            # Forces of PME move the centre of mass a little, which the remover stops.
            apart -= centre_of(masses_of(built.system), apart)
        return float(np.abs(apart).max())

    def _ends(self, built: Built, engine: str) -> Iterator[np.ndarray]:
        """Yield the positions of all particles of the mixture after `TIME`, for each of `STEPS`."""
        system, bodies, x, v = built.system, built.bodies, built.positions, built.velocities
        if engine == "native" and built.named:
            framed = with_frames(with_masses(built.plain, masses_of(built.system)), x, built.named)
            system, bodies, x, v = framed.system, None, framed.positions, framed_velocities(framed, built)
            if self.mixture.prepared != "no":
                prepare_system(system, hydrogenMass=HEAVY if self.mixture.prepared == "heavy" else None)
        scheme = CATALOGUE[self.scheme]
        integrator = SIERIntegrator(self._steps[0], scheme, bodies=bodies, engine=engine, substeps=self.substeps)
        with rejecting_refusals(engine):
            context = openmm.Context(
                system, integrator, platform(self.platform), properties_of(self.platform, "double")
            )
        harden(context)
        for step in self._steps:
            integrator.setStepSize(step)
            context.setPositions(x)
            context.setVelocities(v)
            integrator.step(round(self.pace * TIME / step))
            yield context.getState(positions=True).getPositions(asNumpy=True)._value[: len(built.positions)]


def with_masses(system: openmm.System, masses: np.ndarray) -> openmm.System:
    """Return a copy of a System with masses (N,) in dalton."""
    system = openmm.XmlSerializer.clone(system)
    for i, mass in enumerate(masses.tolist()):
        system.setParticleMass(i, mass)
    return system


def framed_velocities(framed: FramedSystem, built: Built) -> np.ndarray:
    """Return the velocities of all particles of a copy with frames."""
    masses = masses_of(built.system)
    velocities = np.zeros((framed.system.getNumParticles(), 3))
    velocities[: framed.numAtoms] = built.velocities
    for frame in framed.frames:
        of_atoms = masses[frame.atoms], built.positions[frame.atoms], built.velocities[frame.atoms]
        velocities[frame.particles] = rigid_velocities(*of_atoms, framed.positions[frame.particles])
        velocities[frame.atoms] = 0
    return velocities


@st.composite
def cases(draw: st.DrawFn, platform: str) -> Order:
    """Draw a mixture whose total momentum is constant or not removed, and a scheme."""
    # Reference's own PME is off in triclinic boxes, so that other platforms have other forces.
    surroundings = SURROUNDINGS if platform == "Reference" else SURROUNDINGS[:-1]
    mixture = draw(mixtures(surroundings, least=2))
    if is_frozen(mixture):
        mixture = replace(mixture, remover=0)
    return Order(mixture, draw(st.sampled_from(list(CATALOGUE))), draw(st.sampled_from([None, 1, 2, 3])), platform)


@st.composite
def slow_cases(draw: st.DrawFn, platform: str) -> Order:
    """Draw a mixture in which nothing vibrates, so that long steps show the order of what constraints do."""
    mixture = draw(mixtures_without_vibrations())
    scheme = draw(st.sampled_from(["sier4g", "sier4p", *CATALOGUE]))
    return Order(mixture, scheme, draw(st.sampled_from([None, 3])), platform, PACE)


LAW = Law("order", cases, few=18)
SLOW = Law("slow-order", slow_cases, few=8)


@LAW.numbers()
def test_errors_fall_with_the_order_of_the_scheme(examples):
    LAW.hold(examples)


@SLOW.numbers()
def test_errors_of_slow_motions_fall_with_the_order_of_the_scheme(examples):
    SLOW.hold(examples)


@LAW.numbers()
def test_errors_fall_with_the_order_of_the_scheme_on_the_cpu_platform(examples):
    LAW.hold(examples // 4, "CPU")


@pytest.mark.thorough
@pytest.mark.hundreds
@pytest.mark.timeout(3000)
def test_errors_fall_with_the_order_of_the_scheme_on_gpu_platforms():
    """OpenMM compiles some hundred kernels for each Context, so that examples are few."""
    platforms = opencl.gpu_platforms()
    if not platforms:
        pytest.skip("OpenMM has no CUDA, HIP or OpenCL platform here: pip install 'openmm-sier[opencl-test]'")
    for name in platforms:
        command = [
            sys.executable,
            "-m",
            "tests.laws",
            "--law",
            "order",
            "--platform",
            name,
            "--seed",
            "1",
            "--examples",
            "3",
        ]
        process = subprocess.run(
            command, capture_output=True, text=True, env=opencl.environment(optimizes=False), check=False
        )
        assert process.returncode == 0, process.stdout + process.stderr[-2000:]
