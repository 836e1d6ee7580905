"""Make many runs and analyse finished ones: logs, means with errors, viscosity, diffusion, data for validation."""

from openmm_sier.analysis.logs import read_log
from openmm_sier.analysis.many_runs import run_many

__all__ = ["read_log", "run_many"]
