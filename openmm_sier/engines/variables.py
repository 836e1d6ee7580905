"""Names of the variables of the CustomIntegrator that carry what checkpoints and States must hold."""

from __future__ import annotations

import openmm

#: What the names begin with, so that no parameter of a Force has the same name.
PREFIX = "sier_"

#: Global variables: heat, kJ/mol; number of draws of random numbers so far; seed, 0 if none was chosen.
HEAT, DRAWS, SEED = (PREFIX + name for name in ("heat", "draws", "seed"))

#: Per-atom variables in which the exact engine stores the bodies' state, see `exact.packing`, and their geometry.
STATE_VARIABLES = tuple(f"{PREFIX}state{i}" for i in range(3))
SITES = PREFIX + "sites"


class Globals:
    """The global variables of a CustomIntegrator by name."""

    def __init__(self, integrator: openmm.CustomIntegrator):
        self._integrator = integrator

    def __getitem__(self, name: str) -> float:
        return self._integrator.getGlobalVariableByName(name)

    def __setitem__(self, name: str, value: float) -> None:
        self._integrator.setGlobalVariableByName(name, value)
