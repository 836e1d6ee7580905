"""The Context of a SIER integrator, which tells it of changes."""

import contextlib
import functools
import inspect
from typing import Any

import openmm
from openmm import unit

from openmm_sier.dynamics.bodies import RigidityError
from openmm_sier.engines.records import Changes
from openmm_sier.engines.session import Session
from openmm_sier.integrators.impl import IntegratorImpl
from openmm_sier.integrators.storage import load_checkpoint, set_state, store
from openmm_sier.system import tables

#: The parameters of OpenMM's method.
GET_STATE = inspect.signature(openmm.Context.getState)


class SIERContext(openmm.Context):
    """An openmm.Context that was created with a SIER integrator.

    OpenMM tells a Python integrator nothing about its Context. So each Context becomes one of this class when it is
    created, and others stay as they are. Methods do what OpenMM's do and, beyond that:

    - `reinitialize` binds the integrator again.
    - `setState` accepts a State of any other integrator, and brings back no noise that was used. OpenMM sets half of
      such a State and fails, and replicas that start from one State would repeat each other.
    - All methods that change something tell the integrator. Without it the engines would go on with earlier bodies,
      forces and constraints, and a hot start would count as a runaway. A comparison in each call of `step` would read
      all atoms from a GPU.
    - `setVelocitiesToTemperature`, `applyConstraints` and `applyVelocityConstraints` are this package's where OpenMM's
      solvers cannot satisfy the constraints.
    - `createCheckpoint` and, with the integrator's parameters, `getState` let the integrator write what a restart needs
      to its variables, and the run goes on exactly as a restart from their result does. Forces on one thread of the CPU
      platform depend on a list of neighbours that no file holds.

    They are for users. Engines call those of openmm.Context, but for `NativeEngine.select_groups`, which binds the
    integrator again.
    """

    @property
    def impl(self) -> IntegratorImpl:
        """Return the Python part of the integrator."""
        return self.getIntegrator().impl

    @property
    def session(self) -> Session:
        """Return the session of the integrator, which hears of changes."""
        return self.impl.session

    def reinitialize(self, preserveState: bool = False) -> None:
        store(self.impl)
        self.impl.renew_compiled_step(self)
        super().reinitialize(preserveState)
        with tables.read_once():
            self.impl.bind(self, keeps_tally=preserveState)
        if preserveState:
            self.session.changed(Changes.VARIABLES)

    # --- saved and loaded states ---

    @functools.wraps(openmm.Context.getState)
    def getState(self, *args: Any, **kwargs: Any) -> openmm.State:
        arguments = GET_STATE.bind(self, *args, **kwargs).arguments
        # Each second name is deprecated.
        if self.impl.has_hidden_kinetic_energy and (arguments.get("energy") or arguments.get("getEnergy")):
            # Velocities may have been set since the engine wrote it. Atoms that form no bodies have none.
            with contextlib.suppress(RigidityError):
                self.session.engine.state()
        if not (arguments.get("integratorParameters") or arguments.get("getIntegratorParameters")):
            return super().getState(*args, **kwargs)
        store(self.impl)
        state = super().getState(*args, **kwargs)
        self.session.changed(Changes.HISTORY)
        return state

    def createCheckpoint(self) -> bytes:
        store(self.impl)
        checkpoint = super().createCheckpoint()
        self.session.changed(Changes.HISTORY)
        return checkpoint

    def loadCheckpoint(self, checkpoint: bytes) -> None:
        load_checkpoint(self, self.impl, functools.partial(super().loadCheckpoint, checkpoint))

    def setState(self, state: openmm.State) -> None:
        set_state(self, self.impl, functools.partial(self._set_state, state), _has_parameters(state))

    def _set_state(self, state: openmm.State) -> None:
        """Set a State; of one of another kind of integrator, all but the parameters of the integrator."""
        try:
            super().setState(state)
        except openmm.OpenMMException:
            if not _has_parameters(state):
                raise
            self._set_all_but_integrator(state)

    def _set_all_but_integrator(self, state: openmm.State) -> None:
        """Do what `openmm.Context.setState` does, errors included, except for the parameters of the integrator."""
        self.setTime(state.getTime())
        self.setStepCount(state.getStepCount())
        self.setPeriodicBoxVectors(*state.getPeriodicBoxVectors())
        kinds = state.getDataTypes()
        if kinds & openmm.State.Parameters:
            for name, value in state.getParameters().items():
                self.setParameter(name, value)
        if kinds & openmm.State.Positions:
            self.setPositions(state.getPositions(asNumpy=True))
        if kinds & openmm.State.Velocities:
            self.setVelocities(state.getVelocities(asNumpy=True))

    # --- changes ---

    def setPositions(self, positions: Any) -> None:
        with self.session.changing(Changes.ATOMS):
            super().setPositions(positions)

    def setVelocities(self, velocities: Any) -> None:
        with self.session.changing(Changes.ATOMS):
            super().setVelocities(velocities)

    def setParameter(self, name: str, value: float) -> None:
        with self.session.changing():
            super().setParameter(name, value)

    def setTime(self, time: float | unit.Quantity) -> None:
        with self.session.changing():
            super().setTime(time)

    def setStepCount(self, count: int) -> None:
        with self.session.changing():
            super().setStepCount(count)

    def setPeriodicBoxVectors(self, a: Any, b: Any, c: Any) -> None:
        with self.session.changing(Changes.BOX):
            super().setPeriodicBoxVectors(a, b, c)

    def setVelocitiesToTemperature(self, *args: Any) -> None:
        self.session.act("draw_velocities", functools.partial(super().setVelocitiesToTemperature, *args), *args)

    def applyConstraints(self, tol: float | unit.Quantity) -> None:
        self.session.act("satisfy_positions", functools.partial(super().applyConstraints, tol))

    def applyVelocityConstraints(self, tol: float | unit.Quantity) -> None:
        self.session.act("satisfy_velocities", functools.partial(super().applyVelocityConstraints, tol))


def _has_parameters(state: openmm.State) -> bool:
    """Return whether a State has the parameters of an integrator."""
    return bool(state.getDataTypes() & openmm.State.IntegratorParameters)
