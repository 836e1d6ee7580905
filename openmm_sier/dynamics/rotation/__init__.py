"""Free-rotation maps: the exact solution, and RATTLE's.

Each is a function (A, L, moments, h) -> (A, L) and can replace the other in every scheme, as in
`SIERIntegrator(h, rotation=rotation.rattle)`. Those with which the paper compares the exact one are in `studies`.
"""

from openmm_sier.dynamics.rotation.exact import exact
from openmm_sier.dynamics.rotation.rattle import rattle

__all__ = ["exact", "rattle"]
