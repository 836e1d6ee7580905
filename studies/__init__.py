"""The experiments of the documentation, one command each. They are in the repository, and not installed."""

from __future__ import annotations

#: Modules that are studies, with what they cost on their smallest settings and in full, on two cores.
STUDIES = {
    "studies.paper": "2 min with --quick, 70 min",
    "studies.schemes": "seconds for 27 molecules, 10 min for 512",
    "studies.equipartition": "seconds for 27 molecules, hours for 512",
    "studies.bench": "10 min; some minutes a size with --platform",
    "studies.acceptance": "seconds for 27 molecules, 2 h up to 32768",
    "studies.step_study": "seconds; the runs that it reads 3.6 h of one core",
    "studies.molecules": "minutes",
    "studies.hmc.exactness": "7 min of one core",
    "studies.hmc.liquid": "hours",
    "studies.native.accuracy": "minutes",
    "studies.native.ensembles": "an hour for 100 ps",
    "studies.native.cost": "a minute",
    "studies.checks.soak": "2 h for a million steps",
    "studies.checks.kill_loop": "4 min for fifty kills",
    "studies.checks.kill_ensemble": "5 min for 24 members",
    "studies.checks.validate_water": "hours for 150 ps",
    "studies.checks.andersen_oscillators": "a minute",
    "studies.figures": "seconds",
}
