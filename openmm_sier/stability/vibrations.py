"""Unconstrained bonds, and swings of molecules among others: the steps at which both are stable.

How fast the forces between molecules turn and shake them is estimated before any position is known. An atom that can
move with an inverse mass u, its body's rotation included, and that the surroundings hold with a stiffness k swings with
the angular frequency sqrt(k u). For the hydrogens of rigid water u is 1/m, since out of the plane of the molecule they
move as if they were free. Heavier hydrogens, and those of larger bodies, are slower.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.constraints.graph import joined
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.step_limits import nested_is_stable
from openmm_sier.stability import advice
from openmm_sier.stability.collective import fastest_motion, is_collective
from openmm_sier.stability.curvature import Vibration, fastest_vibration
from openmm_sier.stability.surroundings import holding, slow_share
from openmm_sier.system import tables
from openmm_sier.system.bonded_terms import harmonic_bonds
from openmm_sier.system.find_bodies import Links
from openmm_sier.system.forces import kind_of
from openmm_sier.system.inner_forces import SystemForce, all_forces, is_linear
from openmm_sier.system.mobilities import COARSE, mobilities
from openmm_sier.system.user_warnings import warn

#: Longest step, as a fraction of the period of a bond whose forces act within drifts.
RESONANCE = 0.45

#: From this fraction of the period on, the frequencies of a bond and of a bend that shares an atom with it add up to
#: once a kick, or the bond alone does. TIP3P's flexible water has 0.67 at 6 fs: with a bond between its hydrogens it
#: reached 2270 K within ten steps, without it it gained 28 kJ/mol/ps.
DESTROYED = 0.6

#: From this fraction of the period on, kicks make a bond to hydrogen shorter that the same forces should stretch, see
#: `_tell_of_stiffness`. In flexible TIP3P with hydrogens of 4 dalton and a bath, at 0.58 of the period (9 fs), it was
#: 0.7 pm shorter than in vacuum and not 1.6 pm longer, and the energy between molecules was an eighth too weak.
SHORTENED = 0.5

#: Frequencies of bonds of one kind over the estimate, by its error, by bonds beside them and by the surroundings.
SPREAD = tuple(1 + percent / 100 for percent in range(-4, 5))

#: From this step in ps on, a number in fs has more likely been given than a step of picoseconds been meant.
SLIP = 0.5

#: By the table at `surroundings.HYDROGEN_BOND` energy grows from this share of the stability limit on, since some
#: librations are faster.
HEATING = 0.8

#: A step is refused at so many times the stability limit of a libration. There all librations of water are unstable,
#: since the slowest have half the frequency of the fastest.
HOPELESS = 2.0

#: ps. The period that the estimate above gives for the fastest librations of water, for which usual steps are known.
WATER = 0.03154

#: By the study of whole runs (`python -m studies.whole_run`) the energy error of a scheme of fourth order is some 0.02
#: to 0.03 % at its usual step of constant energy. For longer steps h it grows as exp(-1.25 T/h), where T is the period
#: of the fastest librations: 0.6 % at 6 fs with SIER4G.
AT_USUAL_STEP, RESONANCE_DECAY = 2.5e-4, 1.25

#: Steps up to this multiple of the usual one draw no notice; the error is then up to twice that at the usual step.
TOLERATED = 1.06

#: ps. The fastest bonds that molecules have, those of oxygen to hydrogen.
FASTEST_BOND = 0.009

#: x = pi h/T up to which x/tan(x) is 0.9 or more: slow forces stretch a bond of period T by at least that share.
STIFFENED = 0.54


class Motion(NamedTuple):
    """A bond or a libration as a harmonic oscillator.

    Attributes:
        period: ps.
        atoms: particle indices of the ends of the bond, or of the one atom that swings.
        group: the force group that moves them.
        share: stiffness of the surroundings over that of the bond.
        force: name of the Force, where it is an expression.
        is_bond: whether it stretches a bond.
        can_be_fast: whether inner steps could follow it, once the System is prepared.
    """

    period: float
    atoms: tuple[int, ...]
    group: int
    share: float = 0.0
    force: str = ""
    is_bond: bool = True
    can_be_fast: bool = False


class Vibrations:
    """Judge steps by the fastest unconstrained bonds and librations of a System.

    Bonds inside bodies do not count, nor do those that constraints hold. The periods of HarmonicBondForces are read
    from the System, as it is when the Context is created. Those of the terms of CustomBondForces,
    CustomCompoundBondForces and CustomExternalForces, which are expressions, and those of collective variables of
    bonded Forces, of centroids and of an RMSD are found by `measure`, once there are positions. Each bond is treated on
    its own, which gives its period to 1 % for hydrogens; bonds between heavy atoms that share an atom (CO2) vibrate up
    to a quarter faster. Angles are ignored: those of hydrogens are slower than bonds by a factor of two. Of forces
    between molecules only those with charges are looked at, see `surroundings`, and the Lennard-Jones terms of
    NonbondedForces. Forces within Forces count by their weight (`inner_forces`). Of Forces of which nothing is known
    `check` says so.
    """

    def __init__(self, system: openmm.System, bodies: BodySet):
        self._bodies, self._mobility = bodies, mobilities(bodies)
        self._links = links = Links(system)
        self._constraints = links.constraints
        self._remedies = advice.Remedies(system, bodies, links)
        stiffnesses = list(holding(system))
        #: Of the surroundings of each atom, kJ/mol/nm^2.
        self._stiffness = np.max([np.zeros(bodies.n_particles), *(each for _, each in stiffnesses)], axis=0)
        self._harmonic = tuple(self._fastest_bonds(system))
        self._bonds = list(self._harmonic)
        swings = _fastest_swings(stiffnesses, self._mobility)
        self._librations = list(swings) if _has_surroundings(system, bodies, links) else []
        self._is_measured = not any(_is_expression(part) or _is_collective(part) for part in all_forces(system))
        self._unknown = [(part.group, f"{part.name} ({type(part.force).__name__})") for part in _unknown(system)]
        self._isolated = not any(kind_of(force).sets for force in system.getForces())
        self._told: set[str] = set()

    def measure(self, context: openmm.Context) -> bool:
        """Measure, once, how fast expressions and collective variables are; returns whether anything was measured.

        They are looked at where their atoms are. What is far from its minimum there, by `curvature.FAR`, does not
        count.

        Args:
            context: of the System, with positions.
        """
        if self._is_measured:
            return False
        self._is_measured, system = True, context.getSystem()
        for part in all_forces(system):
            if found := self._measured(part, context):
                strength = found.square / self._mobility[list(found.atoms)].sum()
                share = slow_share(self._stiffness, found.atoms, strength, self._mobility)
                period = 2 * math.pi / math.sqrt(found.square)
                is_bond = kind_of(part.force).acts_on == "terms" and len(found.atoms) == 2
                can_be_fast = (
                    period < COARSE and not part.containers and self._remedies.can_be_fast(part.force, found.atoms)
                )
                self._bonds.append(Motion(period, found.atoms, part.group, share, part.name, is_bond, can_be_fast))
        return True

    def _measured(self, part: SystemForce, context: openmm.Context) -> Vibration | None:
        """Return the fastest motion that a Force causes, if it is one that is measured."""
        if _is_expression(part):
            held = self._constraints.by_pair()
            return fastest_vibration(part.force, part.weight or 0.0, context, self._bodies, self._mobility, held)
        if not _is_collective(part):
            return None
        found = fastest_motion(part.force, context, self._links.link(self._bodies))
        return found and found._replace(square=abs(part.weight or 0.0) * found.square)

    def _fastest_bonds(self, system: openmm.System) -> Iterator[Motion]:
        """Find in each HarmonicBondForce the fastest bond between two bodies that no constraint holds."""
        for part in all_forces(system):
            if not isinstance(part.force, openmm.HarmonicBondForce) or not part.force.getNumBonds():
                continue
            ends, _, strength = harmonic_bonds(part.force)
            strength = (part.weight or 0.0) * strength
            owner = self._bodies.owners[ends]
            apart = (owner[:, 0] != owner[:, 1]) | (owner[:, 0] < 0)
            squares = (apart & ~self._constraints.hold(ends)) * strength * self._mobility[ends].sum(axis=1)
            fastest = int(squares.argmax())
            if squares[fastest] > 0:
                period = 2 * math.pi / math.sqrt(squares[fastest])
                atoms = tuple(ends[fastest].tolist())
                share = slow_share(self._stiffness, atoms, strength[fastest], self._mobility)
                can_be_fast = period < COARSE and not part.containers and self._remedies.can_be_fast(part.force, atoms)
                yield Motion(period, atoms, part.group, share, can_be_fast=can_be_fast)

    def check(self, scheme: Scheme, h: float, groups: int) -> None:
        """Refuse a step at which the fastest bond is unstable; warn, once, if its energy is wrong by a tenth.

        The same holds for librations, whose frequencies are estimates: steps are refused for them only from twice the
        stability limit on. The step h is in ps, and `groups` is a bit mask of the force groups that act in it.

        Raises:
            openmm.OpenMMException: the step is beyond the scheme's stability limit.
        """
        self._check_bonds("A step", scheme, h, groups)
        libration = _fastest(self._librations, groups)
        if libration is None:
            return
        stable, accurate = _limits(scheme, libration.period)
        if h <= accurate:
            return
        number = int(self._bodies.owners[libration.atoms[0]])
        body = self._bodies.describe(number)
        described = (
            f"{body} and similar bodies can swing among other molecules with a period of {_fs(libration.period)}. "
            f"{scheme.name} is accurate up to {_fs(accurate)}; with steps of about "
            f"{_fs(max(accurate, HEATING * stable))} or more, liquids heat up"
        )
        remedies = [advice.SHORTER_STEP]
        if self._remedies.heavier(self._bodies.atoms_of(number)):
            remedies.append(advice.HEAVIER)
        if h >= SLIP:
            remedies.append(advice.in_femtoseconds(h))
        self._refuse_or_tell(f"A step of {_fs(h)}", h >= HOPELESS * stable, described, remedies)

    def check_nested(self, scheme: Scheme, inner: Scheme, inner_step: float, h: float, groups: int) -> None:
        """Check the step for fast forces within drifts, which must also not resonate with the kicks.

        Kicks excite a bond if they come once or twice a period: schemes are unstable for steps in windows around half a
        period and a whole one. The width of these windows is the share of the slow forces in the stiffness of the bond.
        From `DESTROYED` on motions of several bonds and bends together do the same. Fast forces are those of `groups`,
        and h is the step of the outer scheme.

        Raises:
            openmm.OpenMMException: the inner step is beyond the inner scheme's stability limit, or the step is in a
                window, or beyond `DESTROYED` or, with a bath in its drift, `SHORTENED`.
        """
        self._check_bonds("An inner step", inner, inner_step, groups, advice.MORE_SUBSTEPS)
        bond = _fastest(self._bonds, groups)
        if bond is not None and h > RESONANCE * bond.period:
            is_shortened = scheme.bath_divides_drift and self._moves_like_hydrogen(bond)
            # Averages of a bond to hydrogen are wrong from shorter steps on.
            borne = min(RESONANCE, STIFFENED / math.pi) if is_shortened else RESONANCE
            # Heavy hydrogens make the bonds of the atoms that they are bonded to faster.
            heavier = [advice.HEAVIER] if self._remedies.has_hydrogen(bond.atoms, advice.LIGHT) else []
            remedies = [advice.up_to(borne * bond.period), *heavier, self._hold(bond)]
            message = (
                f"for {self._name(bond)}: its period is {_fs(bond.period)}, and slow forces must act more than twice "
                "in each period"
            )
            angles = (2 * math.pi * h / bond.period * factor for factor in SPREAD)
            stable = all(nested_is_stable(scheme.stages, x, sign * bond.share) for x in angles for sign in (-1, 1))
            if h >= (SHORTENED if is_shortened else DESTROYED) * bond.period or not stable:
                useless = "More inner steps do not help"
                raise advice.StepError(
                    advice.advised(f"A step of {_fs(h)} is too long {message}", *remedies, remark=useless)
                )
            self._tell_once(advice.advised(f"A step of {_fs(h)} is long {message}", *remedies))
        if scheme.bath_divides_drift:
            self._tell_of_stiffness(h, groups)

    def _tell_of_stiffness(self, h: float, groups: int) -> None:
        """Say, once, where kicks come too seldom for slow forces to stretch a fast bond to hydrogen as they should.

        A constant force in kicks every h, beside a spring that is followed exactly, moves the mean length of the bond
        by x/tan(x) of what it should, x = pi h/T with the period T: averages shift, at the right temperature.
        """
        bond = _fastest([bond for bond in self._bonds if bond.is_bond and self._moves_like_hydrogen(bond)], groups)
        if bond is None or (x := math.pi * h / bond.period) <= STIFFENED:
            return
        left = max(0.0, x / math.tan(x)) if x < math.pi / 2 else 0.0
        wrong = (
            f"At {_fs(h)} averages of this molecule are wrong: slow forces stretch {self._name(bond)} (period "
            f"{_fs(bond.period)}) by only {100 * left:.0f} % of what they should"
        )
        borne = advice.up_to(STIFFENED * bond.period / math.pi)
        self._tell_once(advice.advised(wrong, borne, self._hold(bond)))

    def tell_of_walk(self, scheme: Scheme, h: float, groups: int) -> None:
        """Say, once, where a step at constant energy is so long that the energy walks at random over a run.

        A scheme of fourth order whose step, h in ps, resonates with a harmonic of the librations gives and takes energy
        at random. Nothing is said of schemes of second order, whose energy oscillates further than it walks, or where a
        thermostat or barostat of the System acts.
        """
        libration, usual = _fastest(self._librations, groups), scheme.constant_energy_step
        if libration is None or usual is None or scheme.order < 4 or not self._isolated:
            return
        good = usual * libration.period / WATER
        if h <= TOLERATED * good:
            return
        error = AT_USUAL_STEP * math.exp(RESONANCE_DECAY * libration.period * (1 / good - 1 / h))
        wanders = (
            f"With steps of {_fs(h)} the total energy wanders: its error rms(H)/rms(V) over a whole run is about "
            f"{_percent(min(error, 1.0))}, and {_percent(AT_USUAL_STEP)} with {scheme.name} at {_fs(good)}"
        )
        longer = "Longer steps are for a heat bath or hybrid Monte Carlo"
        self._tell_once(advice.advised(wanders, advice.up_to(good), remark=longer))

    def longest_step(self, scheme: Scheme, groups: int, fast: int) -> float:
        """Return the longest step without a warning, ps, with inner steps that are short enough for the fast groups.

        Its kicks do not resonate with those. Infinite where no bond vibrates. Both groups are bit masks.
        """
        slow, within = _fastest(self._bonds + self._librations, groups), _fastest(self._bonds, fast)
        accurate = accurate_step(scheme, slow.period) if slow else math.inf
        return min(accurate, RESONANCE * within.period if within else math.inf)

    def longest_inner_step(self, inner: Scheme, groups: int) -> float:
        """Return the longest step, ps, of an inner scheme without a warning for harmonic bonds of a mask of groups.

        Expressions do not count: how stiff they are depends on where atoms are, and a restart must find the same.
        """
        bond = _fastest(self._harmonic, groups)
        return accurate_step(inner, bond.period) if bond else math.inf

    def _check_bonds(self, what: str, scheme: Scheme, h: float, groups: int, remedy: str | None = None) -> None:
        """Judge a step by the bonds; name, once, Forces that may be too fast where the fastest bonds would be."""
        bond = _fastest(self._bonds, groups)
        if bond and h > accurate_step(scheme, bond.period):
            remedy = remedy or (advice.PREPARE if bond.can_be_fast else advice.SHORTER_STEP)
            stable, accurate = _limits(scheme, bond.period)
            described = (
                f"{self._name(bond)} is not constrained and has a period of {_fs(bond.period)}. {scheme.name} is "
                f"accurate up to {_fs(accurate)}, and unstable from {_fs(stable)} on"
            )
            self._refuse_or_tell(f"{what} of {_fs(h)}", h >= stable, described, [remedy, self._hold(bond)])
        names = [name for group, name in self._unknown if groups >> group & 1]
        if names and h > accurate_step(scheme, FASTEST_BOND):
            unknown = (
                f"{what} of {_fs(h)} cannot be judged, since the stiffness of {', '.join(names)} is not known. "
                "Compare a run with half the step: if the energy error shrinks, or the temperature is too high, the "
                "step is too long"
            )
            self._tell_once(advice.advised(unknown, advice.CHECK_FORCES))

    def _refuse_or_tell(self, what: str, is_refused: bool, described: str, remedies: Sequence[str]) -> None:
        if is_refused:
            raise advice.StepError(advice.advised(f"{what} is too long: {described}", *remedies))
        self._tell_once(advice.advised(f"{what} is long: {described}", *remedies))

    def _moves_like_hydrogen(self, bond: Motion) -> bool:
        """Tell whether an end of a bond moves like a hydrogen, which may have been made heavy."""
        return bool(self._mobility[list(bond.atoms)].max() * tables.HEAVIEST_HYDROGEN >= 1)

    def _hold(self, motion: Motion) -> str:
        return self._remedies.hold(motion.atoms) if motion.is_bond else advice.soften(motion.force)

    def _name(self, bond: Motion) -> str:
        labels = self._bodies.labels
        residues = "" if labels is None else f" ({' and '.join(dict.fromkeys(labels[i] for i in bond.atoms))})"
        if bond.is_bond:
            by = f" by {bond.force}" if bond.force else ""
            return f"the bond between atoms {bond.atoms[0]} and {bond.atoms[1]}{residues}{by}"
        plural = "s" if len(bond.atoms) > 1 else ""
        return f"the motion of atom{plural} {', '.join(map(str, bond.atoms))}{residues} by {bond.force}"

    def _tell_once(self, message: str) -> None:
        # The same words with other numbers are not said again: tuning tries many steps.
        words = re.sub(r"[\d.]+", "", message)
        if words not in self._told:
            self._told.add(words)
            warn(advice.StepWarning(message))


def accurate_step(scheme: Scheme, period: float) -> float:
    """Return the step up to which a scheme has the energies of a motion right within a tenth; both times in ps."""
    return _limits(scheme, period)[1]


def _limits(scheme: Scheme, period: float) -> tuple[float, float]:
    """Return steps in ps at which a motion becomes unstable, and up to which its energies are right within a tenth."""
    return scheme.stability_limit * period / (2 * math.pi), scheme.accuracy_limit * period / (2 * math.pi)


def _fs(time: float) -> str:
    return f"{1000 * time:.3g} fs" if time < 1 else f"{time:.4g} ps"


def _percent(fraction: float) -> str:
    """Write one digit, without an exponent: 20 % and not 2e+01 %."""
    return f"{float(f'{100 * fraction:.1g}'):g} %"


def _is_expression(part: SystemForce) -> bool:
    # The close pairs of `prepare_system` are nonbonded interactions.
    is_own = part.force.getName().startswith("openmm_sier: ")
    return kind_of(part.force).stiffness == "expression" and not is_own and part.weight is not None


def _is_sum(force: openmm.Force) -> bool:
    """Tell whether a Force is known by those that it contains."""
    return isinstance(force, openmm.CustomCVForce) and is_linear(force)


def _is_collective(part: SystemForce) -> bool:
    return part.weight is not None and not _is_sum(part.force) and is_collective(part.force)


def _unknown(system: openmm.System) -> Iterator[SystemForce]:
    """Find Forces of which no stiffness is known."""
    for part in all_forces(system):
        if isinstance(part.force, openmm.ATMForce) or part.weight is None:
            continue
        is_unknown = kind_of(part.force).stiffness in ("unknown", "collective")
        if is_unknown and not _is_sum(part.force) and not _is_collective(part):
            yield part


def _fastest(motions: Sequence[Motion], groups: int) -> Motion | None:
    """Return the motion of shortest period in force groups, a bit mask; None if there is none."""
    return min((motion for motion in motions if groups >> motion.group & 1), default=None)


def _has_surroundings(system: openmm.System, bodies: BodySet, links: Links) -> bool:
    """Tell whether there are several molecules, or frozen atoms, so that a molecule can swing among others."""
    joins = np.concatenate([links.constraints.pairs, links.bonds, links.terms, links.custom])
    molecules = joined(bodies.n_particles, joins)[bodies.owners >= 0]
    return len(np.unique(molecules)) > 1 or bool(tables.frozen_atoms(system).size)


def _fastest_swings(stiffnesses: Sequence[tuple[SystemForce, np.ndarray]], mobility: np.ndarray) -> Iterator[Motion]:
    """Give for each Force with charges the fastest swing that it causes, by how stiffly it holds each atom."""
    if not mobility.any():
        return
    for part, stiffness in stiffnesses:
        squares = stiffness * mobility
        atom = int(squares.argmax())
        if squares[atom] > 0:
            yield Motion(2 * math.pi / math.sqrt(squares[atom]), (atom,), part.group)
