"""Ensembles, thermostats and methods of runs.

Methods are the schemes of this package and, for comparison, OpenMM's integrators.
"""

from typing import NamedTuple

from openmm_sier.dynamics.schemes import CATALOGUE, Scheme

#: Constant quantities of each ensemble.
ENSEMBLES = {
    "nve": "the energy",
    "nvt": "the temperature",
    "npt": "temperature and pressure",
    "hmc": "the temperature, and the pressure if one is given, without an error of the step, by hybrid Monte Carlo",
}

#: Thermostats of nvt and npt.
THERMOSTATS = {
    "langevin": "friction and noise on each molecule",
    "rescaling": "one factor on all velocities now and then, which hardly disturbs the motion",
}

#: Dalton. Hydrogens of at least this mass have the usual steps of heavy ones.
HEAVY = 3.0

#: 1/ps, of a bath. In the long steps of heavy hydrogens a weaker one leaves rotations warmer than translations.
FRICTION, HEAVY_FRICTION = 1.0, 5.0

#: ps, of OpenMM's own integrators.
STEP_OF_OPENMM = 0.002


def is_heavy(hydrogen_mass: float | None) -> bool:
    """Return whether hydrogens of a mass in dalton allow long steps; those of the force field, None, do not."""
    return hydrogen_mass is not None and hydrogen_mass >= HEAVY


class Method(NamedTuple):
    """A method that moves the molecules of a run.

    Attributes:
        name: for titles and messages.
        ensembles: in which it can run, the default first.
        scheme: of this package's integrators; None for OpenMM's own integrators.
        leapfrog: whether velocities are half a step behind positions.
    """

    name: str
    ensembles: tuple[str, ...] = tuple(ENSEMBLES)
    scheme: Scheme | None = None
    leapfrog: bool = False

    def usual_step(self, ensemble: str, hydrogen_mass: float | None = None) -> float:
        """Return the usual step for rigid water, fs, in an ensemble and with hydrogens of a mass in dalton."""
        if self.scheme is None:
            return 1000 * STEP_OF_OPENMM
        return 1000 * (_usual_step(self.scheme, ensemble, is_heavy(hydrogen_mass)) or STEP_OF_OPENMM)


def _usual_step(scheme: Scheme, ensemble: str, heavy: bool) -> float | None:
    """Return the usual step of a scheme in an ensemble, ps, if it has one."""
    if ensemble == "nve":
        return scheme.constant_energy_step
    if ensemble == "hmc":
        usual, longer = scheme.trial_step, scheme.heavy_trial_step
    else:
        usual, longer = scheme.bath_step, scheme.heavy_bath_step
    return longer or usual if heavy else usual


#: Methods by the names that `--scheme` takes.
METHODS = {name: Method(scheme.name, scheme=scheme) for name, scheme in CATALOGUE.items()} | {
    "verlet": Method("OpenMM Verlet", ensembles=("nve", "nvt", "npt"), leapfrog=True),
    "langevinmiddle": Method("OpenMM LangevinMiddle", ensembles=("nvt", "npt")),
}
