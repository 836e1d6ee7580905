"""The methods of `openmm-sier run`: the schemes of this package, and OpenMM's own integrators to compare them with."""

from __future__ import annotations

from dataclasses import dataclass

from openmm_sier.dynamics.schemes import CATALOGUE, Scheme
from openmm_sier_command.options import ENSEMBLES, USUAL_STEPS


@dataclass(frozen=True)
class Method:
    """What moves the molecules of a run.

    Attributes:
        name: for titles and messages.
        order: of its energy error in the step.
        forces: evaluations per step.
        usual_step: for rigid water, fs.
        ensembles: in which it can run, the default first.
        scheme: of this package's integrators; None where the integrator is one of OpenMM's own.
        leapfrog: whether velocities are half a step behind positions.
        bath: OpenMM's heat bath, for messages; empty for the schemes of this package.
    """

    name: str
    order: int
    forces: int
    usual_step: float
    ensembles: tuple[str, ...] = ENSEMBLES
    scheme: Scheme | None = None
    leapfrog: bool = False
    bath: str = ""

    def surroundings(self, ensemble: str) -> str:
        """OpenMM's heat bath and barostat in an ensemble, for messages; empty where there are none."""
        bath = self.bath if ensemble in ("nvt", "npt") else ""
        return f"{bath}, MonteCarloBarostat" if bath and ensemble == "npt" else bath


#: OpenMM's own integrators, by the names that `--scheme` takes.
_OF_OPENMM = {
    "verlet": Method(
        "OpenMM Verlet",
        2,
        1,
        USUAL_STEPS["verlet"],
        ("nve", "nvt", "npt"),
        leapfrog=True,
        bath="AndersenThermostat",
    ),
    "langevinmiddle": Method(
        "OpenMM LangevinMiddle", 2, 1, USUAL_STEPS["langevinmiddle"], ("nvt", "npt"), bath="its own Langevin bath"
    ),
}


def _of_scheme(key: str) -> Method:
    scheme = CATALOGUE[key]
    return Method(scheme.name, scheme.order, scheme.force_evaluations, USUAL_STEPS[key], scheme=scheme)


#: Methods by the names that `--scheme` takes.
METHODS = {key: _OF_OPENMM[key] if key in _OF_OPENMM else _of_scheme(key) for key in USUAL_STEPS}
