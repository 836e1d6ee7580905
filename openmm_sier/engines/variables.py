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
        names: of all variables.
    """

    def __init__(self, integrator: openmm.CustomIntegrator, ledger: Ledger):
        # The integrator holds this.
        self._integrator = weakref.ref(integrator)
        self.ledger = ledger
        self.names = HEAT, DRAWS, SEED, *ledger.counts
        self._known: dict[str, float] = {}

    def read(self) -> None:
        """Take what the variables have, unless somebody wrote those of another integrator over them.

        openmmtools' ContextCache does so, and noise must not be used twice. What was known before is then written back.
        """
        there = self._values()
        if self.ledger.seed and there[SEED] == 0:
            self._known = there
            self.write()
        else:
            self._take(there)

    def load(self) -> None:
        """Take what the variables have."""
        self._take(self._values())

    def _take(self, there: dict[str, float]) -> None:
        self._known, ledger = there, self.ledger
        ledger.heat, ledger.draws, ledger.seed = there[HEAT], int(there[DRAWS]), int(there[SEED])
        ledger.counts = {name: there[name] for name in ledger.counts}

    def write(self) -> None:
        """Set the variables that differ from the ledger since it was read."""
        ledger, integrator = self.ledger, self._integrator()
        values = {HEAT: ledger.heat, DRAWS: float(ledger.draws), SEED: float(ledger.seed), **ledger.counts}
        for name, value in values.items():
            if self._known.get(name) != value:
                integrator.setGlobalVariableByName(name, value)  # type: ignore[union-attr]
        self._known = values

    def _values(self) -> dict[str, float]:
        get = self._integrator().getGlobalVariableByName  # type: ignore[union-attr]
        return {name: get(name) for name in self.names}
