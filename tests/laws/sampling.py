"""Runs of mixtures of `exact_models`, and their averages in standard errors from the exact ones."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import openmm
from scipy.stats import chi, norm

from openmm_sier import RigidBodies
from openmm_sier.dynamics.constants import BAR, GAS_CONSTANT
from tests.laws.exact_models import FAST, Assembly, Conditions, Exact, FastBonds, Wells
from tests.laws.mechanics import centre_of, masses_of
from tests.laws.samplers import Sampler, Trials
from tests.support.seeded import seeded
from tests.support.waters import platform as platform_of
from tests.support.waters import properties_of

#: Averages of kinds that depend on the motion of the centre of mass.
WITH_CENTRE = ("translation", "translation^2", "p^2", "qp", "kinetic", "kinetic^2")

#: Largest correlation of neighbouring blocks, which the standard error takes into account.
CORRELATED = 0.6


class Length(NamedTuple):
    """How long a series is, and how far its averages may be off.

    Attributes:
        blocks: of which standard errors are estimated.
        most: rows.
        bound: in standard errors.
        least: steps that let a barostat find the size of its moves, in strides.
    """

    blocks: int
    most: int
    bound: float
    least: int


#: Student's distribution for 200 blocks has 1e-10 beyond 6.9, so that a right program fails in one of some 30 averages
#: with 1e-9 at most; the correlation of blocks makes the error uncertain by another tenth. For 64 blocks these are 7.7
#: and a fifth, and hundreds of mixtures find what one of them does not.
LONG = Length(200, 6400, 7.5, 800)
BRIEF = Length(64, 512, 10.0, 400)

#: Margins of averages of anharmonic motions, by the square of their pace. SIER2 is exact where they are harmonic, and
#: cosines of dipoles with a pace of 0.3 were right within 0.2 %. Where constraints are solved in each drift, these are
#: off by 0.2 times the square of the pace.
ERROR, CONSTRAINED_ERROR = 0.03, 0.3


class Series:
    """A Context of an assembly, at a draw of its exact distribution.

    Attributes:
        exact: exact averages of a row of `rows`, by name.
    """

    def __init__(
        self, method: Sampler, kinds: tuple, copies: int, seed: int, platform: str = "Reference", length: Length = LONG
    ):
        """
        Args:
            method: of the sampling.
            kinds: of molecules.
            copies: of each.
            seed: of places and of the integrator.
            platform: name of the platform.
            length: of the series.
        """
        self._method = method
        self._length = length
        self._kinds = kinds
        self._thermal = GAS_CONSTANT * method.temperature
        assembly = Assembly(np.random.default_rng(seed), is_pressed=bool(method.pressure))
        responds = getattr(method, "pushed", None)
        at = Conditions(self._thermal, method.step, method.oscillator, partial(_margin, method), method.keeps, responds)
        for kind in kinds:
            kind.put(assembly, copies, at)
        self._assembly = assembly
        self._is_stopped = isinstance(method, Trials) and method.remover
        self._pressure = (assembly.molecules + 1) * self._thermal / assembly.box**3
        self._has_memory = (
            method.keeps is not None and not method.pressure and any(part.remembered for part in assembly.parts)
        )
        self._integrator = self._make_integrator(kinds, seed)
        self._context = self._make_context(seed, platform)
        self._masses = masses_of(assembly.system)
        # The motion of the centre of mass stays as it is where nothing holds it.
        self._is_held = not self._is_stopped and any(not kind.is_free for kind in kinds)
        self._freedoms = assembly.freedoms - (0 if self._is_held else 3)
        #: Steps from one sample to the next.
        self.stride = self._strides()
        self.exact = self._averages()

    def _make_integrator(self, kinds: tuple, seed: int) -> openmm.CustomIntegrator:
        options, method, assembly = {}, self._method, self._assembly
        positions = np.concatenate(assembly.positions)
        if assembly.types:
            options["bodies"] = RigidBodies.from_types(assembly.system, assembly.types, positions)
        elif method.engine != "native":
            options["bodies"] = RigidBodies.from_system(assembly.system, None, assembly.bodies, positions)
        if self._is_stopped:
            assembly.system.addForce(openmm.CMMotionRemover(1))
        if any(isinstance(kind, FastBonds) for kind in kinds):
            options["fastForceGroups"] = {FAST}
        if method.pressure:
            assembly.system.setDefaultPeriodicBoxVectors(*(assembly.box * np.eye(3)))
            _make_periodic(assembly.system)
        if method.pressure == "moves":
            options |= {"pressure": self._pressure / BAR, "barostatInterval": 1}
        elif method.pressure:
            barostat = openmm.MonteCarloBarostat(self._pressure / BAR, method.temperature, 1)
            assembly.system.addForce(seeded(barostat, seed + 1))
        return seeded(method.integrator(**options), seed + 1)

    def _make_context(self, seed: int, platform: str) -> openmm.Context:
        context = openmm.Context(
            self._assembly.system, self._integrator, platform_of(platform), properties_of(platform, "mixed")
        )
        context.setPositions(np.concatenate(self._assembly.positions))
        context.setVelocitiesToTemperature(self._method.temperature, seed + 1)
        return context

    def _strides(self) -> int:
        """Return a fifth of the slowest relaxation, by friction or against it; it is a few moves for the volume."""
        method = self._method
        if not method.is_ergodic:
            return method.every
        if method.pressure:
            return 4
        if method.is_exact:
            return 1
        pace = min(part.pace for part in self._assembly.parts)
        return max(1, min(20, round(1 / (5 * min(method.friction, pace, pace**2 / method.friction)))))

    # --- averages ---

    def _averages(self) -> dict[str, Exact]:
        assembly, result = self._assembly, {}
        # Sums over oscillators of one frequency exchange energy.
        if self._method.is_ergodic or [type(kind) for kind in self._kinds] == [Wells]:
            for number, part in enumerate(assembly.parts):
                result |= {f"{number} {name}": exact for name, exact in part.exact.items()}
                if self._has_memory:
                    result |= {f"{number} {name}": exact for name, exact in (part.remembered or {}).items()}
        freedoms = self._freedoms
        if self._is_stopped:
            result = {name: exact for name, exact in result.items() if name.split()[1] not in WITH_CENTRE}
        if self._is_stopped or not self._method.is_ergodic:
            result |= {"K": Exact(1.0), "K^2": Exact(1 + 2 / freedoms)}
        if not self._method.is_ergodic and not self._is_held:
            # Without forces the kinetic energy changes by the bath alone, and velocities by a factor.
            kept = math.exp(-self._method.rate * self._method.every)
            result["K kept"] = Exact(2 / freedoms * kept)
            probability = _reversed(kept, freedoms)
            # Of fewer reversals there may be none, with a probability of 1e-11, which gives no error either.
            if probability * self._first_rows() > 25:
                result["reversed"] = Exact(probability)
        if self._method.pressure:
            molecules = assembly.molecules
            result |= {
                "PV": Exact(1.0),
                "(PV)^2": Exact((molecules + 2) / (molecules + 1)),
                "1/PV": Exact((molecules + 1) / molecules),
            }
        return result

    def rows(self, number: int) -> np.ndarray:
        """Make steps, and return so many rows of averages over the molecules, of the names in `exact`."""
        step, get = self._integrator.step, partial(self._context.getState, positions=True, velocities=True)
        before, after, volumes = [], [], []
        for _ in range(number):
            if self.stride > 1:
                step(self.stride - 1)
            if self._has_memory:
                before.append(_atoms(get()))
            step(1)
            state = get()
            after.append(_atoms(state))
            volumes.append(state.getPeriodicBoxVolume()._value)
        x, v = np.swapaxes(after, 0, 1)
        values = self._of_molecules(np.swapaxes(before, 0, 1) if before else None, x, v)
        values |= self._of_all(v, np.array(volumes))
        return np.stack([values[name] for name in self.exact], axis=1)

    def _of_molecules(self, earlier: np.ndarray | None, x: np.ndarray, v: np.ndarray) -> dict[str, np.ndarray]:
        """Return means over copies of what each kind observes."""
        result = {}
        for number, part in enumerate(self._assembly.parts):
            values = part.observe(x[:, part.atoms], v[:, part.atoms])
            if earlier is not None and part.remember is not None:
                values |= part.remember(*earlier[:, :, part.atoms], x[:, part.atoms], v[:, part.atoms])
            result |= {f"{number} {name}": each.mean(axis=-1) for name, each in values.items()}
        return result

    def _of_all(self, v: np.ndarray, volumes: np.ndarray) -> dict[str, np.ndarray]:
        """Return the kinetic energy and the volume over their means, and moments of these."""
        kinetic = self._kinetic(v)
        scaled = self._pressure * volumes / self._thermal / (self._assembly.molecules + 1)
        result = {"K": kinetic, "K^2": kinetic**2, "PV": scaled, "(PV)^2": scaled**2, "1/PV": 1 / scaled}
        # The first row has none before it.
        result["K kept"] = (kinetic - 1) * (np.concatenate([kinetic[1:2], kinetic[:-1]]) - 1)
        v = self._of_molecules_alone(v)
        along = (v * np.concatenate([v[1:2], v[:-1]])).sum(axis=1)
        return result | {"reversed": (along < 0).astype(float)}

    def _of_molecules_alone(self, v: np.ndarray) -> np.ndarray:
        """Return velocities of the molecules of the first kind relative to their mean, (s, 3n), of (s, N, 3)."""
        atoms = self._assembly.parts[0].atoms
        masses = self._masses[atoms[0]]
        centres = centre_of(masses, v[:, atoms])
        return (centres - centres.mean(axis=1, keepdims=True)).reshape(len(v), -1)

    def _kinetic(self, v: np.ndarray) -> np.ndarray:
        """Return kinetic energies over their mean, without that of a free centre of mass, (s,), of (s, N, 3)."""
        centre = np.zeros((1, 3)) if self._is_held else centre_of(self._masses, v)
        return ((v - centre[:, None]) ** 2).sum(axis=2) @ self._masses / (self._freedoms * self._thermal)

    def prepare(self) -> None:
        """Go on until the start is forgotten, and make trials so short that a third of them is accepted."""
        made = 50 if self._method.pressure != "barostat" else self._length.least
        self._integrator.step(made * self.stride)
        if not self._method.is_exact:
            return
        while self._integrator.acceptanceRate < 0.35:
            self._integrator.setSchemeStepSize(self._integrator.getSchemeStepSize() / 1.3)
            self._integrator.resetStatistics()
            self._integrator.step(made)

    def _first_rows(self) -> int:
        """Return a number of rows: few with moves of the volume, which are slow, and many where faults show little.

        So they do in the few averages of rescaling, where rejections find momenta that last, and in second chances.
        """
        blocks = self._length.blocks
        method = self._method
        if method.pressure:
            return 2 * blocks
        if not method.is_ergodic:
            # A kinetic energy lasts for so many rows.
            lasting = math.ceil(1 / (method.rate * method.every))
            return max(4 if self._length is BRIEF else 16, lasting) * blocks
        if self._length is BRIEF:
            return 4 * blocks
        lasts = isinstance(method, Trials) and (method.share > 0.5 or method.chances > 1)
        return 16 * blocks if lasts or self._is_stopped else 4 * blocks

    def distances(self) -> dict[str, float]:
        """Return the distances of averages from the exact ones, beyond the margins, in standard errors."""
        self.prepare()
        rows = self.rows(self._first_rows())
        blocks = self._length.blocks
        while _means(rows, blocks)[2].max() > CORRELATED and len(rows) < self._length.most:
            rows = np.concatenate([rows, self.rows(len(rows))])
        found, errors, _ = _means(rows, blocks)
        values, margins = np.array(list(self.exact.values())).T
        beyond = np.sign(found - values) * np.maximum(np.abs(found - values) - margins, 0.0)
        # Averages that do not vary, such as a sum of squares of cosines, have the error of rounding.
        return dict(zip(self.exact, beyond / (errors + 1e-12), strict=True))


def _reversed(kept: float, freedoms: int) -> float:
    """Return the probability that velocity rescaling reverses velocities, of which it keeps a part.

    Along the old velocities, of a norm with the chi distribution, is a normal deviate of the width sqrt(1 - kept).
    """
    nodes = chi.ppf((np.arange(4000) + 0.5) / 4000, freedoms)
    return float(norm.cdf(-math.sqrt(kept / (1 - kept)) * nodes).mean())


def _means(rows: np.ndarray, blocks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means of columns, their standard errors, and correlations of neighbouring blocks.

    The errors are those of blocks whose correlation decays exponentially.
    """
    means = rows.reshape(blocks, -1, rows.shape[1]).mean(axis=1)
    off = means - means.mean(axis=0)
    variances = (off**2).mean(axis=0)
    correlations = (off[1:] * off[:-1]).mean(axis=0) / np.where(variances > 0, variances, 1.0)
    kept = np.clip(correlations, 0.0, 0.95)
    errors = np.sqrt(variances / (blocks - 1) * (1 + kept) / (1 - kept))
    return means.mean(axis=0), errors, correlations


def _margin(method: Sampler, pace: float) -> float:
    """Return a bound of relative errors of averages of a motion: twice that of a harmonic one, and `ERROR`."""
    if method.is_exact:
        return 0.0
    more = CONSTRAINED_ERROR if method.engine == "native" else ERROR
    return 2 * abs(method.oscillator(pace).q2 - 1) + more * pace**2


def _atoms(state: openmm.State) -> tuple[np.ndarray, np.ndarray]:
    return state.getPositions(asNumpy=True)._value, state.getVelocities(asNumpy=True)._value


def _make_periodic(system: openmm.System) -> None:
    """Add a Force that needs the box and does nothing. A list of neighbours would take most of the time."""
    force = openmm.HarmonicBondForce()
    force.setUsesPeriodicBoundaryConditions(True)
    system.addForce(force)
