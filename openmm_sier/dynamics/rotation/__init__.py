"""Free-rotation maps: the exact solution, two approximations compared by van Zon and Schofield (2007), and RATTLE.

Each map is a function (A, L, moments, h) -> (A, L) and can replace the others in every scheme, as in
`SIERIntegrator(h, rotation=rotation.mrdl)`.
"""

from openmm_sier.dynamics.rotation.exact import exact
from openmm_sier.dynamics.rotation.mrdl import mrdl
from openmm_sier.dynamics.rotation.rattle import rattle
from openmm_sier.dynamics.rotation.sej4 import sej4

__all__ = ["exact", "mrdl", "rattle", "sej4"]
