"""The session of an integrator with its Context: who may step it, and when other code sees it.

Other code runs only where the Context is at a completed step: handlers of signals, reporters, and whoever calls after
an error. Ensembles make steps in blocks, and the loop over these is here alone.
"""

import weakref
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any, NamedTuple

import openmm

from openmm_sier.dynamics.integration_method import IntegrationMethod
from openmm_sier.engines import interrupts
from openmm_sier.engines.protocol import Engine
from openmm_sier.engines.records import Changes
from openmm_sier.stability.runaway import RunawayWatch
from openmm_sier.system import checks, tables

#: Advances by at most so many steps of the integrator, at least one, and returns the number made. It stops early when
#: the collection of pending signals becomes non-empty.
Advance = Callable[[int, Collection[Any]], int]


class Rules(NamedTuple):
    """What steps follow until the settings change.

    Attributes:
        method: the scheme, with its step.
        advancer: of the ensemble, see `Ensemble.advancer`.
        duration: of a step of the integrator, ps.
        temperature: of the ensemble, K; 0 without one.
    """

    method: IntegrationMethod
    advancer: Callable[[Engine], Advance]
    duration: float
    temperature: float


class Session:
    """The session of an integrator, through its whole life: before it has a Context, with one, and after that.

    `SIERContext` and `hooks` record by `changed` and `changing` what users change in the Context: a call of `step`
    reads and checks nothing unless there was such a change since the last one.

    Attributes:
        rules: what steps follow.
        watch: stops runs that have become too hot; there is none before `bind`.
        is_between_steps: whether a thread is making steps, so that the Context may be at none.
    """

    watch: RunawayWatch

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self._engine: Engine | None = None
        self._context: Callable[[], openmm.Context | None] = lambda: None
        self._advance: Advance = lambda steps, signals: steps
        self._stepping = RLock()
        self.is_between_steps = False
        #: The temperature of the bath with which those of the System's Forces were compared last, K.
        self._compared_temperature = 0.0
        self._has_warned_of_temperatures = False

    # --- the Context and its engine ---

    def bind(self, context: openmm.Context) -> None:
        """Begin with a Context that was created or reinitialized. It has no engine before `take`."""
        self._engine = None
        self._context = weakref.ref(context)
        self._compared_temperature = 0.0
        self._has_warned_of_temperatures = False

    def take(self, engine: Engine, system: openmm.System) -> None:
        """Let an engine make the steps in the Context of a System."""
        self.watch = RunawayWatch(system, engine.degrees_of_freedom(conserved=False), engine.sum_on_device)
        self._engine = engine

    @property
    def context(self) -> openmm.Context | None:
        """Return the Context; None before there is one, and after it is gone."""
        return self._context()

    @property
    def had_context(self) -> bool:
        """Return whether there is a Context, or was one."""
        return isinstance(self._context, weakref.ref)

    @property
    def engine_or_none(self) -> Engine | None:
        """Return the engine; None before there is one."""
        return self._engine

    @property
    def engine(self) -> Engine:
        """Return the engine.

        Raises:
            openmm.OpenMMException: there is no Context, or no longer.
        """
        if self._engine is None or self._context() is None:
            raise self._no_context()
        return self._engine

    def _no_context(self) -> openmm.OpenMMException:
        """Return the error of a call that needs a Context."""
        if self._engine is None:
            message = "This integrator has no Context: create a Context or Simulation with it first"
        else:
            message = "The Context of this integrator no longer exists"
        return openmm.OpenMMException(message)

    # --- steps ---

    def step(self, steps: int) -> None:
        """Advance by steps of the integrator; see `SIERIntegrator.step`.

        One thread makes steps. The engine is up to date with the Context first, and after an error it recovers. Signals
        wait until a step is completed and written; then their handlers are called, and what they change is taken over.

        Raises:
            openmm.OpenMMException: another thread is stepping the Context.
        """
        engine, context = self._engine, self._context()
        if engine is None or context is None:
            raise self._no_context()
        handlers = interrupts.defer()
        try:
            # To wait would hang a process that was forked while another thread had the lock.
            if not self._stepping.acquire(blocking=False):
                raise openmm.OpenMMException(
                    "Another thread is stepping this Context: give each thread a Context of its own"
                )
            try:
                remaining = steps
                while True:
                    # In other threads, and where signals wait already, they belong to the caller that deferred them.
                    signals = () if handlers is None else interrupts.pending
                    if engine.changes:
                        self._begin(engine, context)
                    self.is_between_steps = True
                    try:
                        while remaining:
                            remaining -= self._advance(remaining, signals)
                            if signals:
                                break
                        engine.publish()
                    except BaseException:
                        engine.changes |= Changes.SETTINGS
                        engine.recover()
                        raise
                    finally:
                        self.is_between_steps = False
                    if not remaining:
                        break
                    waiting, handlers = handlers, None
                    interrupts.release(waiting)
                    handlers = interrupts.defer()
                    # A handler may have made the Context again.
                    engine = self.engine
            finally:
                # Again, for an error that came before this was done above.
                self.is_between_steps = False
                self._stepping.release()
        finally:
            interrupts.release(handlers)
        watch = self.watch
        watch.steps += steps
        if watch.steps >= watch.pause:
            watch.look(context, self.rules.duration, self.rules.temperature)

    def _begin(self, engine: Engine, context: openmm.Context) -> None:
        """Take over all changes since the last step.

        Raises:
            openmm.OpenMMException: no step can be made from there.
        """
        rules = self.rules
        self._compare_temperatures(context, rules.temperature)
        self.watch.begin(context)
        self._advance = rules.advancer(engine)
        engine.begin(rules.method)

    def _compare_temperatures(self, context: openmm.Context, bath: float) -> None:
        """Warn, once, of a bath and a barostat of OpenMM at two temperatures, when steps are made with them."""
        if bath in (0.0, self._compared_temperature) or self._has_warned_of_temperatures:
            return
        self._compared_temperature = bath
        self._has_warned_of_temperatures = checks.warn_about_other_temperatures(context, bath)

    # --- changes by users ---

    def changed(self, change: Changes = Changes.SETTINGS) -> None:
        """Record a change of some kind, which the next step takes over."""
        if self._engine is None:
            return
        self._engine.record(change)
        if Changes.ATOMS in change:
            self.watch.forget()

    @contextmanager
    def changing(self, change: Changes = Changes.SETTINGS) -> Iterator[None]:
        """Record a change that the block makes, also where that ends in an error: OpenMM may have made a part of it."""
        try:
            yield
        finally:
            self.changed(change)

    @contextmanager
    def changing_force(self, force: openmm.Force) -> Iterator[None]:
        """Record other parameters of a Force of the System, which the block writes to the Context."""
        engine = self._engine
        with self.changing(Changes.SETTINGS if engine is None else engine.changes_by(force)):
            yield

    def act(self, action: str, by_openmm: Callable[[], None], *args: Any) -> None:
        """Do something in the Context by the method of `Actions` with this name; without an engine, by OpenMM.

        What OpenMM changes is recorded before the engine reads its bodies again.
        """

        def recorded() -> None:
            with self.changing(Changes.ATOMS):
                by_openmm()

        with self.changing(Changes.ATOMS), tables.read_once():
            if self._engine is None:
                by_openmm()
            else:
                getattr(self._engine.actions, action)(recorded, *args)

    def refuse_between_steps(self) -> None:
        """Refuse to save a Context that another thread, or a Force in Python, finds between two steps.

        Raises:
            openmm.OpenMMException: a thread is making steps.
        """
        if self.is_between_steps:
            raise openmm.OpenMMException(
                "This Context is between two steps, which a thread is making, and what is saved now would be a mixture "
                "of both: save it when the call of step has returned"
            )
