"""Free-rotation maps: the exact solution, the two that van Zon and Schofield (2007) compare it with, and RATTLE's.

Each is a function (A, L, moments, h) -> (A, L) and can replace the others in every scheme, as in
`SIERIntegrator(h, rotation=rotation.mrdl)`.
"""

from openmm_sier.dynamics.rotation.exact import exact
from openmm_sier.dynamics.rotation.mrdl import mrdl
from openmm_sier.dynamics.rotation.rattle import rattle
from openmm_sier.dynamics.rotation.sej4 import sej4

__all__ = ["exact", "mrdl", "rattle", "sej4"]
