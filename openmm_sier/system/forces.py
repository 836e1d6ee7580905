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
    """

    element: str
    atoms: tuple[str, ...]
    strengths: tuple[int, ...] = ()


class ForceKind(NamedTuple):
    """Properties of a class of Forces. The defaults describe an unknown class.

    Attributes:
        acts_on: "terms" of a few listed atoms; "pairs" of all its particles, or functions of these; "particles" one by
            one; the "whole", as a function of many atoms; or "nothing", if it exerts no forces.
        stiffness: "soft", softer than bonds or known from its parameters; "measured" at the first step, as of
            expressions and collective variables of few atoms; or "unknown".
        terms: terms of a bonded Force, which can be fast; None for other Forces.
        joins: whether its terms join atoms into molecules, as bonds do.
        charges: whether it has point charges, or multipoles.
        meshes: nonbonded methods with a mesh; None: never; empty: always.
        sets: variable controlled by a thermostat or barostat.
        is_passive: whether forces depend only on positions, box and parameters: the Force does nothing in
            `updateContextState`, and ignores the time. With any other Force the exact engine updates and reads the
            Context at each step.
        is_data: whether OpenMM creates it from XML without executing code or opening a file.
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
        """Whether it may exert forces."""
        return self.acts_on != "nothing"

    @property
    def is_divisible(self) -> bool:
        """Whether its terms can be moved to another Force of the class."""
        return self.terms is not None and bool(self.terms.strengths)


def _known(acts_on: str, stiffness: str, is_passive: bool = True, is_data: bool = True, **others: object) -> ForceKind:
    """Return a row of the table."""
    return ForceKind(acts_on, stiffness, is_passive=is_passive, is_data=is_data, **others)  # type: ignore[arg-type]


_TWO, _THREE, _FOUR = ("p1", "p2"), ("p1", "p2", "p3"), ("p1", "p2", "p3", "p4")
_EIGHT = ("a1", "a2", "a3", "a4", "b1", "b2", "b3", "b4")

#: All Force classes of OpenMM.
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
    # The energy of ellipsoids depends on the atoms that define their axes.
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
    # Forces that contain other Forces.
    openmm.ATMForce: _known("whole", "unknown"),
    openmm.CustomCVForce: _known("whole", "unknown"),
    # The exact engine does its work: a sum over bodies is cheaper than reading atoms back.
    openmm.CMMotionRemover: _known("nothing", "soft"),
    openmm.AndersenThermostat: _known("nothing", "soft", is_passive=False, sets="temperature"),
    openmm.MonteCarloBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloAnisotropicBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloMembraneBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    openmm.MonteCarloFlexibleBarostat: _known("nothing", "soft", is_passive=False, sets="pressure"),
    # Only for OpenMM's RPMDIntegrator; it cannot be written as XML.
    openmm.RPMDMonteCarloBarostat: _known("nothing", "soft", is_passive=False, is_data=False),
}

UNKNOWN = ForceKind()


def kind_of(force: openmm.Force) -> ForceKind:
    """Return the properties of a Force; `UNKNOWN` for classes outside the table, such as those of plugins."""
    return next((FORCES[base] for base in type(force).__mro__ if base in FORCES), UNKNOWN)
