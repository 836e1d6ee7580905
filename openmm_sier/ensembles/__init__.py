"""Decide what happens between the steps that an engine follows: nothing, thermostats, volume moves, trials.

An ensemble is frozen data: moves that act between steps, a way to make steps, and what it changes in the method, such
as a bath within steps. It knows engines only by `engines.protocol.Engine`, so that it is written once for all of them.
"""

from openmm_sier.ensembles.ensemble import ConstantEnergy
from openmm_sier.ensembles.langevin import Langevin
from openmm_sier.ensembles.metropolis import Metropolis
from openmm_sier.ensembles.rescaling import VelocityRescaling

__all__ = ["ConstantEnergy", "Langevin", "Metropolis", "VelocityRescaling"]

#: Ensembles by the names of their classes, by which XML and copies of integrators have them.
ENSEMBLES = {cls.__name__: cls for cls in (ConstantEnergy, Langevin, Metropolis, VelocityRescaling)}
