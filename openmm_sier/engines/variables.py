"""Names of the variables of the CustomIntegrator that carry what checkpoints and States must hold."""

import weakref

import openmm

#: What the names begin with, so that no parameter of a Force has the same name.
PREFIX = "sier_"

#: Global variables: heat, kJ/mol; number of draws of random numbers so far; seed, 0 if none was chosen.
HEAT, DRAWS, SEED = (PREFIX + name for name in ("heat", "draws", "seed"))

#: Global variable: the next native step of the program. If it is negative, OpenMM updates the Context's state and does
#: nothing else.
PART = PREFIX + "part"

#: Per-atom variables in which the exact engine stores the bodies' state, see `exact.packing`, and their geometry.
STATE_VARIABLES = tuple(f"{PREFIX}state{i}" for i in range(3))
SITES = PREFIX + "sites"


class Record:
    """Global variables by name that travel in checkpoints, beside the values that they had after the last step."""

    def __init__(self, integrator: openmm.CustomIntegrator, names: tuple[str, ...] = ()):
        """
        Args:
            integrator: has the variables.
            names: of the variables besides heat, draws and seed.
        """
        # The integrator holds this.
        self._integrator, self._names = weakref.ref(integrator), (HEAT, DRAWS, *names)
        self._known: dict[str, float] = {}

    def __getitem__(self, name: str) -> float:
        return self._integrator().getGlobalVariableByName(name)  # type: ignore[union-attr]

    def __setitem__(self, name: str, value: float) -> None:
        self._integrator().setGlobalVariableByName(name, value)  # type: ignore[union-attr]

    def clear(self) -> None:
        """Set all to zero but the seed."""
        for name in self._names:
            self[name] = 0.0

    def values(self) -> dict[str, float]:
        """Return the values of all by name, the seed among them."""
        return {name: self[name] for name in (SEED, *self._names)}

    def set(self, values: dict[str, float]) -> None:
        """Set values by name."""
        for name, value in values.items():
            self[name] = value

    def keep(self) -> None:
        """Note the values that they have."""
        self._known = self.values()

    def restore(self) -> None:
        """Restore the noted values if somebody wrote the variables of another integrator over ours.

        openmmtools' ContextCache does so. Noise must not be used twice.
        """
        if self._known.get(SEED) and self[SEED] == 0:
            self.set(self._known)
