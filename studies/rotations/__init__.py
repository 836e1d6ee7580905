"""The free-rotation maps with which van Zon and Schofield (2007) compare the exact one."""

from studies.rotations.mrdl import mrdl
from studies.rotations.sej4 import sej4

__all__ = ["mrdl", "sej4"]
