"""Refuse what users ask of OpenMM where its solvers cannot satisfy the constraints."""

from collections.abc import Callable

import openmm

from openmm_sier.engines.actions import Actions
from openmm_sier.engines.native import refusals
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.system.solver_trial import SolverTrial


class NativeActions(Actions):
    """Refuse constraints that OpenMM's solvers cannot satisfy."""

    def __init__(self, context: openmm.Context, trial: SolverTrial):
        super().__init__(context)
        self._trial = trial

    def solve(self, by_openmm: Callable[[], None]) -> None:
        refusals.refuse_unsolved(self._trial.unsolved(lambda: Snapshot.of(self._context).positions))
        by_openmm()
