"""The experiments of the documentation, one command each. They are in the repository, and not installed."""

from __future__ import annotations

#: Modules that are studies, with what they take on two cores where that was measured.
STUDIES = {
    "studies.paper": "2 min with `--quick`, else 70 min",
    "studies.whole_run": "3 h of two cores for all runs of the page of whole runs",
    "studies.heat_bath": "3 h of one core for 250 ps of each method",
    "studies.schemes": "3 to 10 min of one core a liquid",
    "studies.equipartition": "",
    "studies.defaults": "13 min, as two commands with one thread each",
    "studies.speed": "20 min of one core of a busy machine",
    "studies.gpu": "9 min of an H200",
    "studies.bench.accuracy": "15 min of one core of a busy machine",
    "studies.step_study": "3.6 h of one core for all runs of the page of water against the step",
    "studies.domains": "half an hour of one core of a busy machine",
    "studies.hmc.exactness": "11 min of one core",
    "studies.hmc.solvated": "10 min of one core for all trials of the page of sampling",
    "studies.hmc.trials": "3 to 10 min of one core for 100 ps of a method in 512 molecules of water",
    "studies.hmc.mixture": "9 min of one core for all runs of the page of sampling",
    "studies.native.accuracy": "",
    "studies.native.cost": "",
    "studies.native.substeps": "13 min of one core",
    "studies.launches": "half an hour of two cores of a busy machine",
    "studies.figures": "seconds",
}
