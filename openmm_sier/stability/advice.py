"""Messages about steps, with remedies."""

import math
from functools import cached_property

import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import working_terms
from openmm_sier.system.forces import kind_of
from openmm_sier.system.hydrogens import hydrogens_among, partners_of
from openmm_sier.system.links import Links

#: Dalton. Hydrogens up to this have not been made heavy.
LIGHT = 2.0

_HEAVY = "prepare_system(system, hydrogenMass=4*dalton)"

#: Remedies, for scripts and for the command, which prepares all Systems.
SHORTER_STEP = "take a shorter step (--dt)"
PREPARE = (
    "call prepare_system(system) before the Context is made, so that bonds get inner steps; or take a shorter step "
    "(--dt)"
)
MORE_SUBSTEPS = "take more substeps or a shorter step (--dt)"
HEAVIER = f"if you need averages but no dynamics, make all hydrogens heavy: {_HEAVY} (--hydrogen-mass 4)"
CONSTRAIN_HYDROGEN = (
    "constrain the bond: give createSystem rigidWater=True and constraints=HBonds (--constraints hbonds)"
)
CONSTRAIN_BODY = "put its atoms into one rigid body of `bodies`, see select_bodies (--rigid)"
CONSTRAIN = f"constrain the bond: give createSystem constraints=AllBonds (--constraints allbonds); or {CONSTRAIN_BODY}"
CONSTRAIN_ANGLE = (
    "constrain the angle: give createSystem rigidWater=True for water, and constraints=HAngles for other molecules "
    "(--constraints hangles)"
)
LESS_MASS = f"if createSystem made hydrogens heavy, call {_HEAVY}: it takes less mass from their heavy atoms"
STRAIGHTEN = "if a body is nearly a line, put its atoms exactly on a line, which does not spin about its axis"
CHECK_FORCES = "if the energy drifts as much with half the step, call print(check_forces(context))"


class StepError(openmm.OpenMMException):
    """A step is too long."""


class StepWarning(UserWarning):
    """A step is long for the motions of a System."""


def message(finding: str, *remedies: str, remark: str = "") -> str:
    """Return a message.

    Args:
        finding: the problem.
        remedies: any of them helps.
        remark: another fact; may be empty.
    """
    advice = ", or ".join(remedies)
    return ". ".join(filter(None, [finding, advice[:1].upper() + advice[1:], remark]))


def femtoseconds(time: float) -> str:
    """Return a time, ps, in words."""
    return f"{1000 * time:.3g} fs" if time < 1 else f"{time:.4g} ps"


def up_to(step: float) -> str:
    """Return the remedy of a step of at most `step`, ps, rounded down to three digits."""
    value, unit = (1000 * step, "fs") if step < 1 else (step, "ps")
    digit = 10.0 ** (math.floor(math.log10(value)) - 2)
    # In binary numbers a step of 4 fs may be 3.999999999999999 fs.
    return f"take up to {math.floor(value / digit * (1 + 1e-12)) * digit:.3g} {unit} (--dt)"


def soften(force: str) -> str:
    """Return the remedy of a softer Force, by its name."""
    return f"make {force} softer"


def in_femtoseconds(step: float) -> str:
    """Return the remedy for a step in fs without a unit."""
    return f"give {step:g}*unit.femtoseconds for {step:g} fs, since a plain number is a time in ps"


class Remedies:
    """Remedies for a System's fast motions, by their atoms."""

    def __init__(self, system: openmm.System, bodies: BodySet, links: Links):
        """Take a System, its bodies, and its constraints and bonds."""
        self._owners = bodies.owners.copy()
        self._moving = bodies.owners >= 0
        self._points = bodies.point_particles
        # Terms between frozen atoms do no work, like those inside one body.
        self._owners[tables.frozen_without(system, bodies.owners)] = bodies.n
        self._masses = tables.masses(system)
        self._links = links

    @cached_property
    def _hydrogens(self) -> set[int]:
        """All hydrogens: not at the start, since few Systems need a remedy."""
        by_centre = hydrogens_among(self._masses, partners_of(self._masses, self._links))
        return {atom for atoms in by_centre.values() for atom in atoms}

    def can_be_fast(self, force: openmm.Force, atoms: tuple[int, ...]) -> bool:
        """Return whether `prepare_system` would let a term of a Force act within drifts.

        The Force must be bonded, and all its terms act on bodies alone, or it can be divided.
        """
        if kind_of(force).is_divisible:
            return bool(self._moving[list(atoms)].all())
        terms = working_terms(force, self._owners)
        return bool(len(terms) and self._moving[terms].all())

    def has_hydrogen(self, atoms: tuple[int, ...], heaviest: float = tables.HEAVIEST_HYDROGEN) -> bool:
        """Return whether one of the atoms is a hydrogen of at most a mass in dalton."""
        return any(atom in self._hydrogens and self._masses[atom] <= heaviest for atom in atoms)

    def hold(self, atoms: tuple[int, ...]) -> list[str]:
        """Return ways to hold a bond, or an angle."""
        if len(atoms) > 2:
            return [CONSTRAIN_ANGLE if self.has_hydrogen(atoms) else CONSTRAIN_BODY]
        remedies = [CONSTRAIN_HYDROGEN if self.has_hydrogen(atoms) else CONSTRAIN]
        if any(self._points[i] and self._masses[i] > tables.HEAVIEST_IN_CHAINS for i in self._hydrogens):
            remedies.append(LESS_MASS)
        return remedies
