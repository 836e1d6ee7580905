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

#: Per-atom variables in which the exact engine stores the bodies' state, see `exact.packing`, and their geometry.
STATE_VARIABLES = tuple(f"{PREFIX}state{i}" for i in range(3))
SITES = PREFIX + "sites"


class StoredLedger:
    """A ledger, and the global variables of an integrator that hold it between calls of `step`.

    Checkpoints and States carry the variables, and users may set them. So the ledger is read at the start of a call,
    and written at its end.

    Attributes:
        ledger: the ledger.
    """

    def __init__(self, integrator: openmm.CustomIntegrator, ledger: Ledger):
        # The integrator holds this.
        self._integrator = weakref.ref(integrator)
        self.ledger = ledger

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all variables."""
        return HEAT, DRAWS, SEED, *self.ledger.counts

    def read(self) -> None:
        """Take what the variables have, unless somebody wrote those of another integrator over them.

        openmmtools' ContextCache does so, and noise must not be used twice. What was known before is then written back.
        """
        if self.ledger.seed and self._value(SEED) == 0:
            self.write()
        else:
            self.load()

    def load(self) -> None:
        """Take what the variables have."""
        ledger = self.ledger
        ledger.heat, ledger.draws, ledger.seed = self._value(HEAT), int(self._value(DRAWS)), int(self._value(SEED))
        ledger.counts = {name: self._value(name) for name in ledger.counts}

    def write(self) -> None:
        """Set the variables that differ from the ledger."""
        ledger = self.ledger
        values = {HEAT: ledger.heat, DRAWS: float(ledger.draws), SEED: float(ledger.seed), **ledger.counts}
        for name, value in values.items():
            if self._value(name) != value:
                self._integrator().setGlobalVariableByName(name, value)  # type: ignore[union-attr]

    def _value(self, name: str) -> float:
        return self._integrator().getGlobalVariableByName(name)  # type: ignore[union-attr]
