"""The methods of `openmm-sier run`: the schemes of this package, and OpenMM's own integrators to compare them with."""

from __future__ import annotations

from dataclasses import dataclass

from openmm_sier.dynamics.schemes import CATALOGUE, Scheme

#: The default method. Its scheme is also the default of this package's integrators.
RECOMMENDED = "sier4g"

#: Steps in fs that the README recommends for rigid water, by scheme. They are the default steps.
USUAL_STEPS = {"sier2": 2.0, "sier4": 4.0, "sier4v": 5.0, "sier4g": 6.0, "sier4p": 6.0}


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
    ensembles: tuple[str, ...] = ("nve", "nvt", "npt", "hmc")
    scheme: Scheme | None = None
    leapfrog: bool = False
    bath: str = ""

    def surroundings(self, ensemble: str) -> str:
        """OpenMM's heat bath and barostat in an ensemble, for messages; empty where there are none."""
        bath = self.bath if ensemble in ("nvt", "npt") else ""
        return f"{bath}, MonteCarloBarostat" if bath and ensemble == "npt" else bath


#: Methods by the names that `--scheme` takes.
METHODS = {
    key: Method(
        scheme.name,
        scheme.order,
        scheme.force_evaluations,
        # 1 fs for each force evaluation where the README recommends no step.
        USUAL_STEPS.get(key, float(scheme.force_evaluations)),
        scheme=scheme,
    )
    for key, scheme in CATALOGUE.items()
} | {
    "verlet": Method("OpenMM Verlet", 2, 1, 2.0, ("nve", "nvt", "npt"), leapfrog=True, bath="AndersenThermostat"),
    "langevinmiddle": Method("OpenMM LangevinMiddle", 2, 1, 2.0, ("nvt", "npt"), bath="its own Langevin bath"),
}
