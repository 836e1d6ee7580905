"""Variables of the CustomIntegrator, which carry what checkpoints and States must hold."""

import weakref

import openmm

from openmm_sier.dynamics.ledger import Ledger

#: What the names begin with, so that no parameter of a Force has the same name.
PREFIX = "sier_"

#: Global variables of a ledger: heat, kJ/mol; number of draws so far; seed, 0 if none was chosen.
HEAT, DRAWS, SEED = (PREFIX + name for name in ("heat", "draws", "seed"))

#: Global variable: the next native step of the program. If it is negative, OpenMM updates the Context's state and does
#: nothing else.
PART = PREFIX + "part"

#: Per-atom variables in which the exact engine stores the phase point of the bodies, see `exact.packing`.
STATE_VARIABLES = tuple(f"{PREFIX}state{i}" for i in range(3))


class StoredLedger:
    """A ledger, and the global variables of an integrator by which checkpoints, States and XML carry it.

    They are written before one of these is made, and read after it was loaded. At other times they do not matter.

    Attributes:
        ledger: the ledger.
        names: of all variables.
    """

    def __init__(self, integrator: openmm.CustomIntegrator, ledger: Ledger):
        # The integrator holds this.
        self._integrator = weakref.ref(integrator)
        self.ledger = ledger
        self.names = HEAT, DRAWS, SEED, *ledger.counts

    def load(self) -> None:
        """Set the ledger to the variables."""
        get = self._integrator().getGlobalVariableByName  # type: ignore[union-attr]
        ledger = self.ledger
        ledger.heat = get(HEAT)
        ledger.draws = int(get(DRAWS))
        ledger.seed = int(get(SEED))
        ledger.counts = {name: get(name) for name in ledger.counts}

    def write(self) -> None:
        """Set the variables to the ledger."""
        ledger, integrator = self.ledger, self._integrator()
        values = {HEAT: ledger.heat, DRAWS: float(ledger.draws), SEED: float(ledger.seed), **ledger.counts}
        for name, value in values.items():
            integrator.setGlobalVariableByName(name, value)  # type: ignore[union-attr]
