"""The classes of Forces of OpenMM: one table of what is known of each."""

from __future__ import annotations

from typing import Literal, NamedTuple

import openmm


class Terms(NamedTuple):
    """Describe how terms of two to eight atoms are written.

    Attributes:
        element: of a term in XML, which OpenMM's methods name too, such as getBondParameters.
        atoms: its attributes that name atoms.
        strengths: places of the parameters that make the energy 0 if they are; empty where there are none, so that a
            term cannot be moved to another Force.
    """

    element: str
    atoms: tuple[str, ...]
    strengths: tuple[int, ...] = ()


class ForceKind(NamedTuple):
    """Hold what is known of a class of Forces. The defaults are those of a class that nobody knows.

    Attributes:
        acts_on: terms of a few atoms that it names; pairs, or what follows from these, of all its particles; each of
            some particles by itself; the whole, as a function of many atoms; or nothing: it exerts no forces.
        stiffness: of what it moves: softer than bonds, or read from its parameters; to be measured, since it acts on
            few atoms or is cheap; or unknown.
        terms: of a bonded Force, which can be fast; None for any other one.
        joins: whether its terms make their atoms one molecule, as bonds do.
        charges: whether it has charges, or multipoles.
        meshes: nonbonded methods with which it has a mesh; None for never, empty for always.
        sets: what it sets by itself, if it is a thermostat or a barostat.
        is_passive: whether it only gives forces, by positions, box and parameters: it does nothing in
            `updateContextState`, and does not know the time. With any other one the exact engine updates and reads the
            Context at each step.
        is_data: whether OpenMM makes it from XML without executing code or opening a file.
    """

    acts_on: Literal["terms", "pairs", "particles", "whole", "nothing"] = "whole"
    stiffness: Literal["soft", "measured", "unknown"] = "unknown"
    terms: Terms | None = None
    joins: bool = False
    charges: Literal["points", "multipoles"] | None = None
    meshes: tuple[int, ...] | None = None
    sets: Literal["temperature", "pressure"] | None = None
    is_passive: bool = False
    is_data: bool = False

    @property
    def exerts_forces(self) -> bool:
        """Return whether there may be forces."""
        return self.acts_on != "nothing"

    @property
    def is_divisible(self) -> bool:
        """Return whether its terms can be moved to another Force of the class."""
        return self.terms is not None and bool(self.terms.strengths)


def _known(acts_on: str, stiffness: str, is_passive: bool = True, is_data: bool = True, **others: object) -> ForceKind:
    """Return a row of the table."""
    return ForceKind(acts_on, stiffness, is_passive=is_passive, is_data=is_data, **others)  # type: ignore[arg-type]


_TWO, _THREE, _FOUR = ("p1", "p2"), ("p1", "p2", "p3"), ("p1", "p2", "p3", "p4")
_EIGHT = ("a1", "a2", "a3", "a4", "b1", "b2", "b3", "b4")

#: All classes of Forces that OpenMM has.
FORCES: dict[type[openmm.Force], ForceKind] = {
    # Bonded Forces.
    openmm.HarmonicBondForce: _known("terms", "soft", terms=Terms("Bond", _TWO, (3,))),
    openmm.HarmonicAngleForce: _known("terms", "soft", terms=Terms("Angle", _THREE, (4,)), joins=True),
    openmm.PeriodicTorsionForce: _known("terms", "soft", terms=Terms("Torsion", _FOUR, (6,)), joins=True),
    openmm.RBTorsionForce: _known("terms", "soft", terms=Terms("Torsion", _FOUR, (4, 5, 6, 7, 8, 9)), joins=True),
    openmm.CMAPTorsionForce: _known("terms", "soft", terms=Terms("Torsion", _EIGHT)),
    openmm.CustomBondForce: _known("terms", "measured", terms=Terms("Bond", _TWO)),
    openmm.CustomAngleForce: _known("terms", "soft", terms=Terms("Angle", _THREE)),
    openmm.CustomTorsionForce: _known("terms", "soft", terms=Terms("Torsion", _FOUR)),
    openmm.AmoebaTorsionTorsionForce: _known("terms", "soft"),
    openmm.CustomCompoundBondForce: _known("terms", "measured"),
    openmm.CustomHbondForce: _known("terms", "soft"),
    # Nonbonded Forces.
    openmm.NonbondedForce: _known(
        "pairs", "soft", charges="points", meshes=(openmm.NonbondedForce.PME, openmm.NonbondedForce.LJPME)
    ),
    openmm.ConstantPotentialForce: _known("pairs", "soft", charges="points", meshes=()),
    openmm.AmoebaMultipoleForce: _known(
        "pairs", "soft", charges="multipoles", meshes=(openmm.AmoebaMultipoleForce.PME,)
    ),
    openmm.HippoNonbondedForce: _known("pairs", "soft", charges="multipoles", meshes=(openmm.HippoNonbondedForce.PME,)),
    openmm.AmoebaVdwForce: _known("pairs", "soft"),
    openmm.AmoebaWcaDispersionForce: _known("pairs", "soft"),
    openmm.AmoebaGeneralizedKirkwoodForce: _known("pairs", "soft"),
    openmm.CustomNonbondedForce: _known("pairs", "soft"),
    openmm.CustomGBForce: _known("pairs", "soft"),
    openmm.GBSAOBCForce: _known("pairs", "soft"),
    openmm.LCPOForce: _known("pairs", "soft"),
    # The energy of ellipsoids depends on the atoms that tell their axes.
    openmm.GayBerneForce: _known("whole", "soft"),
    openmm.CustomManyParticleForce: _known("whole", "soft"),
    # Fields and collective variables.
    openmm.CustomExternalForce: _known("particles", "measured"),
    openmm.CustomVolumeForce: _known("whole", "soft"),
    openmm.CustomCentroidBondForce: _known("whole", "measured"),
    openmm.RMSDForce: _known("whole", "measured"),
    openmm.RGForce: _known("whole", "measured"),
    openmm.OrientationRestraintForce: _known("whole", "measured"),
    openmm.DrudeForce: _known("whole", "unknown"),
    # It may read the time.
    openmm.PythonForce: _known("whole", "unknown", is_passive=False, is_data=False),
    # Those that contain others.
    openmm.ATMForce: _known("whole", "unknown"),
    openmm.CustomCVForce: _known("whole", "unknown"),
    # It has an effect, which the exact engine takes over: a sum over bodies is cheaper than reading atoms back.
    openmm.CMMotionRemover: _known("nothing", "soft"),
    openmm.AndersenThermostat: _known("nothing", "soft", is_passive=False, sets="temperature"),
    openmm.MonteCarloBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloAnisotropicBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloMembraneBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloFlexibleBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    # It is for OpenMM's RPMDIntegrator alone, and cannot be written as XML.
    openmm.RPMDMonteCarloBarostat: _known("nothing", "soft", is_passive=False, is_data=False),
}

UNKNOWN = ForceKind()


def kind_of(force: openmm.Force) -> ForceKind:
    """Return what is known of a Force; of a class that is not in the table, as of a plugin, `UNKNOWN`."""
    return next((FORCES[each] for each in type(force).__mro__ if each in FORCES), UNKNOWN)
