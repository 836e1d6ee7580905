"""Table of the properties of OpenMM's Force classes."""

from __future__ import annotations

from typing import Literal, NamedTuple

import openmm


class Terms(NamedTuple):
    """XML form of terms of two to eight atoms.

    Attributes:
        element: XML element of a term, which also occurs in names of methods, such as getBondParameters.
        atoms: its attributes that contain atom indices.
        strengths: positions of the parameters that make the energy 0 if they are 0; empty if there are none, so that
            a term cannot be moved to another Force.
        first: position of the first atom among the parameters.
    """

    element: str
    atoms: tuple[str, ...]
    strengths: tuple[int, ...] = ()
    first: int = 0


class ForceKind(NamedTuple):
    """Properties of a class of Forces. The defaults are those of most classes of OpenMM.

    Attributes:
        acts_on: what its energy depends on. "terms" of a few listed atoms, or of donors and acceptors: particles of
            frames can be added, and a motion of two atoms is judged as a bond. "pairs" of all its particles, or
            functions of these, with an entry for each particle: copies with frames refuse classes that they do not
            know. "particles" one by one: a lone body feels a torque, and momentum is not conserved. The "whole", any
            other function of many atoms, or of the box: copies with frames refuse it too. "nothing": it exerts no
            forces, and is never fast.
        stiffness: "soft", softer than bonds or known from its parameters; "measured" at the first step, as of
            expressions and collective variables of few atoms; or "unknown".
        terms: XML form of the terms of a bonded Force, which can be fast; None for other Forces.
        joins: whether its terms join atoms into molecules, beside those of HarmonicBondForces and CustomBondForces,
            which do in any case.
        charges: whether it has point charges, or multipoles.
        meshes: nonbonded methods with a mesh; None: never; empty: always.
        has_coordinates: whether its expression may depend on absolute coordinates, such as x1.
        sets: variable controlled by a thermostat or barostat.
        is_passive: whether forces depend only on positions, box and parameters: the Force does nothing in
            `updateContextState`, and ignores the time. With any other Force the exact engine updates and reads the
            Context at each step.
        is_data: whether OpenMM creates it from XML without executing code or opening a file.
    """

    acts_on: Literal["terms", "pairs", "particles", "whole", "nothing"]
    stiffness: Literal["soft", "measured", "unknown"]
    terms: Terms | None = None
    joins: bool = False
    charges: Literal["points", "multipoles"] | None = None
    meshes: tuple[int, ...] | None = None
    has_coordinates: bool = False
    sets: Literal["temperature", "pressure"] | None = None
    is_passive: bool = True
    is_data: bool = True

    @property
    def exerts_forces(self) -> bool:
        """Whether it may exert forces."""
        return self.acts_on != "nothing"

    @property
    def is_divisible(self) -> bool:
        """Whether its terms can be moved to another Force of the class."""
        return self.terms is not None and bool(self.terms.strengths)


_TWO, _THREE, _FOUR = ("p1", "p2"), ("p1", "p2", "p3"), ("p1", "p2", "p3", "p4")
_EIGHT = ("a1", "a2", "a3", "a4", "b1", "b2", "b3", "b4")

#: All Force classes of OpenMM.
FORCES: dict[type[openmm.Force], ForceKind] = {
    # Bonded Forces.
    openmm.HarmonicBondForce: ForceKind("terms", "soft", terms=Terms("Bond", _TWO, (3,))),
    openmm.HarmonicAngleForce: ForceKind("terms", "soft", terms=Terms("Angle", _THREE, (4,)), joins=True),
    openmm.PeriodicTorsionForce: ForceKind("terms", "soft", terms=Terms("Torsion", _FOUR, (6,)), joins=True),
    openmm.RBTorsionForce: ForceKind("terms", "soft", terms=Terms("Torsion", _FOUR, (4, 5, 6, 7, 8, 9)), joins=True),
    openmm.CMAPTorsionForce: ForceKind("terms", "soft", terms=Terms("Torsion", _EIGHT, first=1)),
    openmm.CustomBondForce: ForceKind("terms", "measured", terms=Terms("Bond", _TWO)),
    openmm.CustomAngleForce: ForceKind("terms", "soft", terms=Terms("Angle", _THREE)),
    openmm.CustomTorsionForce: ForceKind("terms", "soft", terms=Terms("Torsion", _FOUR)),
    openmm.AmoebaTorsionTorsionForce: ForceKind("terms", "soft"),
    openmm.CustomCompoundBondForce: ForceKind("terms", "measured", has_coordinates=True),
    # A donor or an acceptor is up to three listed atoms, and other particles have no entry.
    openmm.CustomHbondForce: ForceKind("terms", "soft"),
    # Nonbonded Forces.
    openmm.NonbondedForce: ForceKind(
        "pairs", "soft", charges="points", meshes=(openmm.NonbondedForce.PME, openmm.NonbondedForce.LJPME)
    ),
    openmm.ConstantPotentialForce: ForceKind("pairs", "soft", charges="points", meshes=()),
    openmm.AmoebaMultipoleForce: ForceKind(
        "pairs", "soft", charges="multipoles", meshes=(openmm.AmoebaMultipoleForce.PME,)
    ),
    openmm.HippoNonbondedForce: ForceKind(
        "pairs", "soft", charges="multipoles", meshes=(openmm.HippoNonbondedForce.PME,)
    ),
    openmm.AmoebaVdwForce: ForceKind("pairs", "soft"),
    openmm.AmoebaWcaDispersionForce: ForceKind("pairs", "soft"),
    openmm.AmoebaGeneralizedKirkwoodForce: ForceKind("pairs", "soft"),
    openmm.CustomNonbondedForce: ForceKind("pairs", "soft"),
    openmm.CustomGBForce: ForceKind("pairs", "soft"),
    openmm.GBSAOBCForce: ForceKind("pairs", "soft"),
    openmm.LCPOForce: ForceKind("pairs", "soft"),
    openmm.GayBerneForce: ForceKind("pairs", "soft"),
    openmm.CustomManyParticleForce: ForceKind("whole", "soft", has_coordinates=True),
    # Fields and collective variables.
    openmm.CustomExternalForce: ForceKind("particles", "measured"),
    openmm.CustomVolumeForce: ForceKind("whole", "soft"),
    openmm.CustomCentroidBondForce: ForceKind("whole", "measured", has_coordinates=True),
    openmm.RMSDForce: ForceKind("whole", "measured"),
    openmm.RGForce: ForceKind("whole", "measured"),
    openmm.OrientationRestraintForce: ForceKind("whole", "measured"),
    openmm.DrudeForce: ForceKind("whole", "unknown"),
    # It may read the time.
    openmm.PythonForce: ForceKind("whole", "unknown", is_passive=False, is_data=False),
    # Forces that contain other Forces.
    openmm.ATMForce: ForceKind("whole", "unknown"),
    openmm.CustomCVForce: ForceKind("whole", "unknown"),
    # The exact engine does its work: a sum over bodies is cheaper than reading atoms back.
    openmm.CMMotionRemover: ForceKind("nothing", "soft"),
    openmm.AndersenThermostat: ForceKind("nothing", "soft", is_passive=False, sets="temperature"),
    openmm.MonteCarloBarostat: ForceKind("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloAnisotropicBarostat: ForceKind("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloMembraneBarostat: ForceKind("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloFlexibleBarostat: ForceKind("nothing", "soft", is_passive=False, sets="pressure"),
    # Only for OpenMM's RPMDIntegrator; it cannot be written as XML.
    openmm.RPMDMonteCarloBarostat: ForceKind("nothing", "soft", is_passive=False, is_data=False),
}

#: Classes outside the table may do anything.
UNKNOWN = ForceKind("whole", "unknown", is_passive=False, is_data=False)


def kind_of(force: openmm.Force) -> ForceKind:
    """Return the properties of a Force; `UNKNOWN` for classes outside the table, such as those of plugins."""
    return next((FORCES[base] for base in type(force).__mro__ if base in FORCES), UNKNOWN)
