"""Turns finished runs into numbers: logs, means with errors, viscosity, data for validation."""

from openmm_sier.analysis.logs import read_log

__all__ = ["read_log"]
