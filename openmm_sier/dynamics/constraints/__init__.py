"""Distance constraints between point bodies: their algebra, their graph, their solution, and geodesics along them."""

from openmm_sier.dynamics.constraints.algebra import ConstraintError, Constraints

__all__ = ["ConstraintError", "Constraints"]
