"""What users do to a Context, as data that Hypothesis draws, orders and shrinks.

Each action is a frozen dataclass with a method `act`, which does it, and `shows`, which asserts that the Context shows
what was asked for. An error of `act` that is one of its `refusals` is a refusal, and must have changed nothing.
"""

from dataclasses import dataclass

import numpy as np
import openmm
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from openmm_sier.dynamics.constants import GAS_CONSTANT
from tests.laws.mechanics import centre_of
from tests.laws.runs import SINGLE_ENERGY, update_shares
from tests.support.faults import lines_run

#: Chance of a kinetic energy outside of the bounds for a temperature, on either side: that of 6.1 standard errors.
CHANCE = 5e-10

#: nm/ps: velocities that bodies and constraints allow are known to 1e-3 where atoms are off by 1e-5 nm; what is missed
#: is as large as thermal velocities.
ALLOWED = 1e-3


#: nm/ps: in a few steps. PME exerts a small net force; a centre that is not stopped moves with 0.01 nm/ps or more.
NET = 2e-3


#: Iterations of a minimizer that may find no lower energy. kJ/mol/nm, for the root mean square of forces along what
#: moves: those of atoms and bodies in their minima are below 1, and thermal ones are hundreds.
FEW, STEEP = 10, 100.0

#: nm: 1e-5 of the length of a constraint.
SLIP = 2e-6


class Action:
    """The base class. What it leaves out holds for questions.

    Attributes:
        changes: whether the Context may differ.
        refusals: errors by which it may be refused; others are faults of the action or the package.
    """

    changes = True
    refusals = (openmm.OpenMMException, ValueError)

    def applies(self, run):
        """Return whether a run can be asked for this."""
        return True

    def act(self, run):
        raise NotImplementedError

    def shows(self, run, before, after):
        """Assert that the Context shows what was asked for, by the views before and after."""


# --- steps ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step(Action):
    count: int

    def act(self, run):
        run.integrator.step(self.count)

    def shows(self, run, before, after):
        assert after.steps == before.steps + self.count
        step = run.integrator.getStepSize()._value
        assert abs(after.time - before.time - self.count * step) < 1e-12
        run.assert_rigid(after, 1e-6)
        frozen = run.masses == 0
        frozen[run.sites] = False
        assert np.array_equal(after.positions[frozen], before.positions[frozen]), "frozen atoms moved"
        assert after.parameters == before.parameters
        if run.method.kind == "SIERIntegrator" and run.mixture.remover and not frozen.any():
            self._centre_moves(run, before, after)

    def _centre_moves(self, run, before, after):
        """Assert that the centre of mass moves as the force of `Run` says, and is stopped when it must be."""
        velocity = centre_of(run.masses, before.velocities)
        pulled = sum(run.pull.getParticleParameters(k)[1][0] for k in range(run.pull.getNumParticles()))
        for number in range(before.steps, after.steps):
            # OpenMM's remover acts before each step that its frequency divides.
            velocity = velocity * (number % run.mixture.remover != 0)
            velocity[2] -= before.parameters["pull"] * pulled / run.masses.sum() * run.integrator.getStepSize()._value
        wrong = np.abs(centre_of(run.masses, after.velocities) - velocity).max()
        assert wrong < NET, f"the velocity of the centre of mass is off by {wrong:.1e} nm/ps"


@dataclass(frozen=True)
class InterruptedStep(Action):
    """Make steps, with a KeyboardInterrupt at a line of the package. OpenMM's own steps are left where one occurs."""

    count: int
    line: int

    def applies(self, run):
        return run.method.engine == "exact"

    def act(self, run):
        lines_run(lambda: run.integrator.step(self.count), self.line, KeyboardInterrupt)


# --- atoms ------------------------------------------------------------------------------------------------------------


def assert_drawn(run, before, after, temperature):
    """Assert that all velocities were drawn: those that bodies and constraints allow, and as many as freedoms."""
    projected = run.projected(after)
    massive = run.masses > 0
    kept = (after.velocities == before.velocities).all(axis=1) & massive
    assert run.repeats or not kept.any(), f"velocities of atoms {np.flatnonzero(kept)} are those of before"
    excess = np.abs(projected - after.velocities)[massive].max()
    assert excess < ALLOWED, f"{excess:.1e} nm/ps are not allowed"
    energy = 2 * run.kinetic_energy(after) / (GAS_CONSTANT * temperature)
    # Twice the kinetic energy in kT has the chi-square distribution.
    low, high = 2 * gammaincinv(run.freedoms(after) / 2, [CHANCE, 1 - CHANCE])
    assert low <= energy <= high, f"twice the kinetic energy is {energy} kT, not from {low} to {high}"


@dataclass(frozen=True)
class DrawVelocities(Action):
    temperature: float
    seed: int

    def act(self, run):
        run.context.setVelocitiesToTemperature(self.temperature, self.seed)
        run.repeats, run.drawn = run.drawn == self, self

    def shows(self, run, before, after):
        assert np.array_equal(after.positions, before.positions)
        assert_drawn(run, before, after, self.temperature)


@dataclass(frozen=True)
class SetVelocities(Action):
    seed: int

    def velocities(self, run):
        spread = np.sqrt(np.divide(1.0, run.masses, out=np.zeros_like(run.masses), where=run.masses > 0))
        return np.random.default_rng(self.seed).normal(size=(len(spread), 3)) * spread[:, None]

    def act(self, run):
        run.context.setVelocities(self.velocities(run))

    def shows(self, run, before, after):
        assert np.array_equal(after.positions, before.positions)
        massive = run.masses > 0
        # GPUs in mixed precision keep doubles.
        assert np.array_equal(after.velocities[massive], self.velocities(run)[massive])


@dataclass(frozen=True)
class SetPositions(Action):
    """Displace and turn a molecule as a whole, and perhaps each atom by a little, which constraints do not allow."""

    molecule: int
    seed: int
    off: float = 0.0

    def positions(self, run, before):
        rng = np.random.default_rng(self.seed)
        atoms = run.molecules[self.molecule % len(run.molecules)]
        images = run.built.images @ before.box
        moved = before.positions - images
        centre = moved[atoms].mean(axis=0)
        turn = Rotation.from_rotvec(rng.normal(scale=0.02, size=3))
        moved[atoms] = turn.apply(moved[atoms] - centre) + centre + rng.normal(scale=0.005, size=3)
        return moved + images + self.off * rng.uniform(-1, 1, moved.shape)

    def act(self, run):
        run.context.setPositions(self.positions(run, run.view()))

    def shows(self, run, before, after):
        assert np.array_equal(after.velocities, before.velocities)
        asked = self.positions(run, before)
        assert np.array_equal(np.delete(after.positions, run.sites, 0), np.delete(asked, run.sites, 0))


@dataclass(frozen=True)
class SetBoth(Action):
    """Positions and then velocities."""

    positions: SetPositions
    velocities: SetVelocities

    def act(self, run):
        self.positions.act(run)
        self.velocities.act(run)

    def shows(self, run, before, after):
        asked = self.positions.positions(run, before)
        assert np.array_equal(np.delete(after.positions, run.sites, 0), np.delete(asked, run.sites, 0))
        massive = run.masses > 0
        assert np.array_equal(after.velocities[massive], self.velocities.velocities(run)[massive])


@dataclass(frozen=True)
class ApplyConstraints(Action):
    def act(self, run):
        run.context.applyConstraints(1e-9)

    def shows(self, run, before, after):
        assert np.array_equal(after.velocities, before.velocities)
        for (i, j), length in zip(*run.constraints, strict=True):
            distance = np.linalg.norm(after.positions[i] - after.positions[j])
            assert abs(distance - length) < 1e-6 * length


@dataclass(frozen=True)
class ApplyVelocityConstraints(Action):
    def act(self, run):
        run.context.applyVelocityConstraints(1e-9)

    def shows(self, run, before, after):
        assert np.array_equal(after.positions, before.positions)
        massive = run.masses > 0
        wrong = np.abs(run.projected(before) - after.velocities)[massive].max()
        assert wrong < ALLOWED, f"velocities are {wrong:.1e} nm/ps from the nearest that are allowed"


@dataclass(frozen=True)
class Minimize(Action):
    """Minimize the energy from positions that satisfy the constraints: others may have less than those at the end.

    The first few iterations may lead up, from where it goes back to the start.
    """

    iterations: int

    def act(self, run):
        run.context.applyConstraints(1e-9)
        run.energy_before, run.slope_before = run.potential_energy(), run.slope()
        # OpenMM's minimizer satisfies constraints to `SLIP` at its end.
        run.slip = SLIP * np.abs(run.forces()).max() if len(run.constraints[0]) else 0.0
        openmm.LocalEnergyMinimizer.minimize(run.context, 1.0, self.iterations)

    def shows(self, run, before, after):
        assert after.steps == before.steps
        assert np.array_equal(after.box, before.box)
        energy = run.potential_energy()
        rounding = (SINGLE_ENERGY if run.name == "CPU" else 1e-6) * (1 + abs(energy)) + run.slip
        assert energy <= run.energy_before + rounding, f"the energy rose from {run.energy_before} to {energy} kJ/mol"
        if self.iterations > FEW and run.slope_before > STEEP:
            assert energy < run.energy_before - rounding, f"the energy stays at {energy} kJ/mol"
        run.assert_rigid(after, 1e-4, moves=False)


# --- what forces depend on --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SetBox(Action):
    factor: float

    def applies(self, run):
        return run.is_periodic

    def act(self, run):
        run.context.setPeriodicBoxVectors(*(self.factor * run.view().box))

    def shows(self, run, before, after):
        assert np.array_equal(after.box, self.factor * before.box)
        assert np.array_equal(after.positions, before.positions)


@dataclass(frozen=True)
class SetParameter(Action):
    name: str
    value: float

    def act(self, run):
        run.context.setParameter(self.name, self.value)

    def shows(self, run, before, after):
        assert after.parameters == before.parameters | {self.name: self.value}
        assert run.context.getParameter(self.name) == self.value


@dataclass(frozen=True)
class UpdateParameters(Action):
    """Change a Force in the System and in the Context."""

    share: float

    def act(self, run):
        update_shares(run, [(self.share * (1 + k % 2),) for k in range(run.pull.getNumParticles())])


@dataclass(frozen=True)
class HardenBonds(Action):
    """Change the constants of all bonds in the System and in the Context."""

    factor: float

    def act(self, run):
        run.harden_bonds(self.factor)


# --- saving and loading -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Save(Action):
    """Save a checkpoint or a State. The run goes on as a restart does, so that this is no mere question."""

    way: str

    def act(self, run):
        run.saved.append((run.view(), run.save(self.way)))

    def shows(self, run, before, after):
        after.assert_near(before, 0)


@dataclass(frozen=True)
class Load(Action):
    number: int

    def applies(self, run):
        return bool(run.saved)

    def act(self, run):
        run.saved[self.number % len(run.saved)][1](run.context)

    def shows(self, run, before, after):
        after.assert_near(run.saved[self.number % len(run.saved)][0], 0)


@dataclass(frozen=True)
class Reinitialize(Action):
    preserve: bool

    def act(self, run):
        view = run.view()
        run.context.reinitialize(preserveState=self.preserve)
        if not self.preserve:
            view.show_in(run.context)

    def shows(self, run, before, after):
        after.assert_near(before, 0)
