"""Variables of the CustomIntegrator, which carry what checkpoints and States must hold."""

import math
import weakref

import numpy as np
import openmm

from openmm_sier.dynamics.tally import Tally
from openmm_sier.system.arguments import vectors_to_array

#: What the names begin with, so that no parameter of a Force has the same name.
PREFIX = "sier_"

#: Global variables of a tally: heat, kJ/mol; number of draws so far; seed, 0 if none was chosen.
HEAT, DRAWS, SEED = (PREFIX + name for name in ("heat", "draws", "seed"))

#: Global variable: the next native step of the program. If it is negative, OpenMM updates the Context's state and does
#: nothing else.
PART = PREFIX + "part"

#: Per-atom variable: kinetic energy that velocities of massive atoms do not carry, kJ/mol for each of their components,
#: where bodies have other moments than those of their masses. The exact engine writes it. OpenMM's GPU platforms upload
#: a global variable only in a step.
HIDDEN_KINETIC = PREFIX + "hidden_kinetic"

#: Per-atom variables in which the exact engine stores the phase point of the bodies, see `exact.packing`.
STATE_VARIABLES = tuple(f"{PREFIX}state{i}" for i in range(3))


def report_hidden_kinetic_energy(integrator: openmm.CustomIntegrator) -> None:
    """Let OpenMM add `HIDDEN_KINETIC` to the kinetic energy of States, for an integrator without a Context."""
    integrator.addPerDofVariable(HIDDEN_KINETIC, 0)
    integrator.setKineticEnergyExpression(f"m*v*v/2 + {HIDDEN_KINETIC}")


def per_atom_values(context: openmm.Context, *names: str) -> np.ndarray:
    """Return per-atom variables of the integrator of a Context, (number of names, N, 3).

    OpenMM gives lists of objects, which take as long as a force for two variables of a large System. A checkpoint ends
    with the numbers: those of the global variables, then those of the per-atom ones.
    """
    integrator = context.getIntegrator()
    checkpoint = openmm.Context.createCheckpoint(context)
    shape = integrator.getNumPerDofVariables(), context.getSystem().getNumParticles(), 3
    start = len(checkpoint) - 8 * math.prod(shape)
    values = [integrator.getGlobalVariable(i) for i in range(integrator.getNumGlobalVariables())]
    if not checkpoint[:start].endswith(np.array(values).tobytes()):
        # Another version of OpenMM may write something else.
        return np.array([vectors_to_array(integrator.getPerDofVariableByName(name)) for name in names])
    stored = np.frombuffer(checkpoint, offset=start).reshape(shape)
    numbers = {integrator.getPerDofVariableName(i): i for i in range(shape[0])}
    return stored[[numbers[name] for name in names]]


class StoredTally:
    """A tally, and the global variables of an integrator by which checkpoints, States and XML carry it.

    They are written before one of these is made, and read after it was loaded. At other times they do not matter.

    Attributes:
        tally: the tally.
        names: of all variables.
    """

    def __init__(self, integrator: openmm.CustomIntegrator, tally: Tally):
        # The integrator holds this.
        self._integrator = weakref.ref(integrator)
        self.tally = tally
        self.names = HEAT, DRAWS, SEED, *tally.counts

    def load(self) -> None:
        """Set the tally to the variables.

        Raises:
            openmm.OpenMMException: heat, draws or seed are not finite.
        """
        get = self._integrator().getGlobalVariableByName  # type: ignore[union-attr]
        tally = self.tally
        for name in (HEAT, DRAWS, SEED):
            if not math.isfinite(value := get(name)):
                raise openmm.OpenMMException(
                    f"The State, checkpoint or XML has {name} = {value}, expected a finite number: give another one"
                )
        tally.heat = get(HEAT)
        tally.draws = int(get(DRAWS))
        tally.seed = int(get(SEED))
        tally.counts = {name: get(name) for name in tally.counts}

    def write(self) -> None:
        """Set the variables to the tally."""
        tally, integrator = self.tally, self._integrator()
        values = {HEAT: tally.heat, DRAWS: float(tally.draws), SEED: float(tally.seed), **tally.counts}
        for name, value in values.items():
            integrator.setGlobalVariableByName(name, value)  # type: ignore[union-attr]
