"""Variables of the CustomIntegrator, which carry what checkpoints and States must hold."""

import math

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

    OpenMM returns a list of Python objects for each, which for a large System takes half as long as a force. A
    checkpoint ends with the same numbers: those of the global variables, then those of the per-atom ones.
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


def names_of(tally: Tally) -> tuple[str, ...]:
    """Return the names of the global variables of a tally."""
    return HEAT, DRAWS, SEED, *tally.counts


def load_tally(integrator: openmm.CustomIntegrator, tally: Tally) -> None:
    """Set a tally to its variables, after a checkpoint, State or XML was loaded.

    Raises:
        openmm.OpenMMException: heat, draws or seed are not finite.
    """
    get = integrator.getGlobalVariableByName
    for name in (HEAT, DRAWS, SEED):
        if not math.isfinite(value := get(name)):
            raise openmm.OpenMMException(
                f"The State, checkpoint or XML has {name} = {value}, expected a finite number: give another one"
            )
    tally.heat = get(HEAT)
    tally.draws = int(get(DRAWS))
    tally.seed = int(get(SEED))
    tally.counts = {name: get(name) for name in tally.counts}


def write_tally(integrator: openmm.CustomIntegrator, tally: Tally) -> None:
    """Set the variables to a tally, before a checkpoint, State or XML is made; at other times they do not matter."""
    values = tally.heat, tally.draws, tally.seed, *tally.counts.values()
    for name, value in zip(names_of(tally), values, strict=True):
        integrator.setGlobalVariableByName(name, value)
