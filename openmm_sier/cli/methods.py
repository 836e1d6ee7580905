"""The methods of `openmm-sier run`: the schemes of this package, and OpenMM's own integrators to compare them with."""

from __future__ import annotations

from typing import NamedTuple

from openmm_sier.dynamics.schemes import CATALOGUE, Scheme
from openmm_sier_command.options import ENSEMBLES, USUAL_STEPS


class Method(NamedTuple):
    """What moves the molecules of a run.

    Attributes:
        name: for titles and messages.
        usual_step: for rigid water, fs.
        order: of its energy error in the step.
        ensembles: in which it can run, the default first.
        scheme: of this package's integrators; None where the integrator is one of OpenMM's own.
        leapfrog: whether velocities are half a step behind positions.
    """

    name: str
    usual_step: float
    order: int = 2
    ensembles: tuple[str, ...] = ENSEMBLES
    scheme: Scheme | None = None
    leapfrog: bool = False


#: Methods by the names that `--scheme` takes.
METHODS = {
    "verlet": Method("OpenMM Verlet", USUAL_STEPS["verlet"], ensembles=("nve", "nvt", "npt"), leapfrog=True),
    "langevinmiddle": Method("OpenMM LangevinMiddle", USUAL_STEPS["langevinmiddle"], ensembles=("nvt", "npt")),
} | {
    key: Method(CATALOGUE[key].name, step, CATALOGUE[key].order, scheme=CATALOGUE[key])
    for key, step in USUAL_STEPS.items()
    if key in CATALOGUE
}
