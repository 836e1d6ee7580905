"""What can move the molecules of a run: the schemes of this package and, to compare them with, OpenMM's integrators."""

from __future__ import annotations

from typing import NamedTuple

from openmm_sier.dynamics.schemes import CATALOGUE, Scheme

ENSEMBLES = ("nve", "nvt", "npt", "hmc")

#: ps, of OpenMM's own integrators.
STEP_OF_OPENMM = 0.002


class Method(NamedTuple):
    """What moves the molecules of a run.

    Attributes:
        name: for titles and messages.
        order: of its energy error in the step.
        ensembles: in which it can run, the default first.
        scheme: of this package's integrators; None where the integrator is one of OpenMM's own.
        leapfrog: whether velocities are half a step behind positions.
    """

    name: str
    order: int = 2
    ensembles: tuple[str, ...] = ENSEMBLES
    scheme: Scheme | None = None
    leapfrog: bool = False

    def usual_step(self, ensemble: str) -> float:
        """The usual step for rigid water in an ensemble, fs."""
        of_scheme = self.scheme and (self.scheme.constant_energy_step if ensemble == "nve" else self.scheme.bath_step)
        return 1000 * (of_scheme or STEP_OF_OPENMM)


#: Methods by the names that `--scheme` takes.
METHODS = {name: Method(scheme.name, scheme.order, scheme=scheme) for name, scheme in CATALOGUE.items()} | {
    "verlet": Method("OpenMM Verlet", ensembles=("nve", "nvt", "npt"), leapfrog=True),
    "langevinmiddle": Method("OpenMM LangevinMiddle", ensembles=("nvt", "npt")),
}
