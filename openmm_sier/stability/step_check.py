"""Check whether a step is short enough for the fastest motions of a System."""

import math
import re
from collections.abc import Callable, Sequence

import openmm

from openmm_sier.dynamics.bodies import BodySet
from openmm_sier.dynamics.flow import Flow
from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.dynamics.species import Species
from openmm_sier.stability import advice
from openmm_sier.stability.advice import StepError, StepWarning, femtoseconds
from openmm_sier.stability.motions import Motion, Motions, fastest
from openmm_sier.system.forces import kind_of
from openmm_sier.system.user_warnings import warn

#: Longest step, as a fraction of the period of a bond whose forces act within drifts: half a period less a tenth.
RESONANCE = 0.45

#: From this fraction of the period on, several bonds and bends resonate together, or the bond alone does at a whole
#: period. Of flexible TIP3P SIER4G conserves the energy at 0.53 to 0.59 periods, and at 0.62 eight molecules gained 5
#: kJ/mol in 1 ps; with SIER2 at 0.62 they were destroyed. With a bond between the hydrogens it reached 2270 K within
#: ten steps of 0.67 periods.
DESTROYED = 0.6

#: x = pi h/T up to which x/tan(x) is 0.9 or more: slow forces stretch a bond of period T by at least that share.
STRETCHED = 0.54

#: ps. The fastest bonds that molecules have, those of oxygen to hydrogen.
FASTEST_BOND = 0.009

#: By the table at `motions.HYDROGEN_BOND` energy grows from this share of the stability limit on, since some librations
#: are faster.
HEATING = 0.8

#: A step is refused at so many times the stability limit of a libration. There all librations of water are unstable,
#: since the slowest have half the frequency of the fastest.
HOPELESS = 2.0

#: ps. From this step on, a number in fs has more likely been given than a step of picoseconds been meant.
SLIP = 0.5

#: ps. The estimated period of the fastest librations of water, for which usual steps are known.
WATER = 0.03154

#: By the study of whole runs (`python -m studies.whole_run`) the energy error of a scheme of fourth order is some 0.02
#: to 0.03 % at its usual step of constant energy. For longer steps h it grows as exp(-1.25 T/h), where T is the period
#: of the fastest librations: 0.6 % at 6 fs with SIER4G.
AT_USUAL_STEP, RESONANCE_DECAY = 2.5e-4, 1.25

#: Steps up to this multiple of the usual one draw no notice; the error is then up to twice that at the usual step.
TOLERATED = 1.06

#: Angular velocities in units of sqrt(kT/I) that a step must follow: one body in twenty spins faster. Free spin is
#: exact at any step, but forces on atoms beside the axis change with the angle, and kicks sample them once a step. A
#: scheme follows spins as it follows vibrations, up to its `accuracy_limit`. For 64 trimers like CO2 of 172 to 178
#: degrees, at 250 K, rms(H)/rms(V) within 1.5 ps was, by the angle sqrt(kT/I) h:
#:     SIER2          0.3 0.0015, 0.4 0.0025, 0.7 0.007, 1.0 0.014, 1.4 0.04, 1.9 0.07    a line 0.001 to 0.008
#:     SIER4G, SIER4  0.4 0.00004, 0.7 0.0001, 1.0 0.0005, 1.3 0.003, 1.9 0.02            a line 0.00005
FAST_SPIN = 2.0

#: Radians. A step is refused where a body turns so far in it at sqrt(kT/I), two kicks a turn.
HALF_TURN = math.pi

#: K, where there is no heat bath.
ROOM_TEMPERATURE = 300.0


class StepCheck:
    """Refuse steps that are too long for bonds, librations and spins; warn of those at which energies are wrong."""

    def __init__(
        self,
        system: openmm.System,
        bodies: BodySet,
        inner_step: Callable[[Flow, float], float] | None = None,
        rigid: Sequence[Species] | None = None,
    ):
        """
        Args:
            system: openmm.System.
            bodies: all that move in it.
            inner_step: gives the longest step of a flow within drifts, ps. Its second argument is the longest step at
                which bonds are accurate, for flows that leave the number of substeps open. None: the number of the
                flow, or one.
            rigid: the kinds of rigid body; None: those of `bodies`.
        """
        self._bodies = bodies
        self._motions = Motions(system, bodies, bodies.species if rigid is None else rigid)
        self._is_isolated = not any(kind_of(force).sets for force in system.getForces())
        self._inner_step = inner_step or _with_substeps
        self._checked: tuple = ()
        #: The last flow and groups, and the inner step for them.
        self._known: tuple[Flow | None, int, float] = (None, 0, 0.0)
        self._said: set[str] = set()

    def inner_step(self, flow: Flow, groups: int) -> float:
        """Return the longest step of a flow within drifts, ps; `groups` are the integration force groups, a bit mask.

        Of bonds only the harmonic ones count: measured motions depend on positions, and a restart must find the same.
        """
        known, known_groups, step = self._known
        if known is not flow or known_groups != groups:
            bond = fastest(self._motions.harmonic, groups & flow.fast_groups)
            step = self._inner_step(
                flow, math.inf if bond is None else _accurate(flow.scheme.within_drifts, bond.period)
            )
            self._known = flow, groups, step
        return step

    def longest_step(
        self,
        scheme: Scheme,
        groups: int,
        fast: int,
        temperature: float = ROOM_TEMPERATURE,
        context: openmm.Context | None = None,
    ) -> float:
        """Return the longest step without a warning, ps, with inner steps that are short enough for the fast groups.

        Infinite where nothing moves fast.

        Args:
            scheme: of the step.
            groups: force groups in the kicks, a bit mask.
            fast: force groups within drifts, a bit mask.
            temperature: K.
            context: with positions, where motions are measured; None to leave those out.
        """
        if context is not None:
            self._motions.measure(context)
        slowest = fastest(self._motions.bonds + self._motions.librations, groups)
        accurate = math.inf if slowest is None else _accurate(scheme, slowest.period)
        return min(accurate, self._longest_beside(scheme, fast), self._longest_by_spin(scheme, groups, temperature))

    def __call__(self, flow: Flow, groups: int, context: openmm.Context | None = None) -> None:
        """Check a flow, once, by forces of integration force groups, a bit mask.

        Engines call it before the first step and not earlier: a Context may also be made for energies alone.

        Args:
            flow: what will be followed.
            groups: the integration force groups.
            context: where motions are measured; None before there are positions.

        Raises:
            openmm.OpenMMException: the step is too long.
        """
        if context is not None and self._motions.measure(context):
            self._checked = ()
        scheme, h = flow.scheme, flow.step
        temperature = ROOM_TEMPERATURE if flow.bath is None else flow.bath.temperature
        checked = scheme, h, flow.substeps, flow.fast_groups, groups, temperature
        if checked == self._checked:
            return
        slow, fast = groups & ~flow.fast_groups, groups & flow.fast_groups
        self._check_bonds("A step", scheme, h, slow)
        self._check_librations(scheme, h, slow)
        self._check_spin(scheme, h, slow, temperature)
        self._check_bonds("An inner step", scheme.within_drifts, self.inner_step(flow, groups), fast, is_inner=True)
        self._check_resonance(scheme, h, fast)
        if flow.constant_energy:
            self._check_energy(scheme, h, slow)
        self._checked = checked

    def _check_bonds(self, what: str, scheme: Scheme, h: float, groups: int, is_inner: bool = False) -> None:
        """Refuse a step at which the fastest bond is unstable; warn if its energies are wrong by a tenth.

        Forces whose stiffness is unknown are named where the fastest bonds would be inaccurate.

        Raises:
            StepError: the step, ps, is beyond the scheme's stability limit.
        """
        motions = self._motions
        bond = fastest(motions.bonds, groups)
        if bond and h > _accurate(scheme, bond.period):
            shorter = advice.PREPARE if bond.can_be_fast else advice.SHORTER_STEP
            finding = (
                f"{self._name(bond)} is not constrained and has a period of {femtoseconds(bond.period)}. {scheme.name} "
                f"is accurate up to {femtoseconds(_accurate(scheme, bond.period))}, and unstable from "
                f"{femtoseconds(_stable(scheme, bond.period))} on"
            )
            remedies = advice.MORE_SUBSTEPS if is_inner else shorter, *self._hold(bond)
            self._say(what, h, h >= _stable(scheme, bond.period), finding, *remedies)
        unknown = [name for group, name in motions.unknown if groups >> group & 1]
        if unknown and h > _accurate(scheme, FASTEST_BOND):
            finding = (
                f"{what} of {femtoseconds(h)} cannot be judged, since the stiffness of {', '.join(unknown)} is not "
                "known. Compare a run with half the step: if the energy error shrinks, or the temperature is too high, "
                "the step is too long"
            )
            self._warn(advice.message(finding, advice.CHECK_FORCES))

    def _check_librations(self, scheme: Scheme, h: float, groups: int) -> None:
        """Check a step, ps, by librations, whose frequencies are estimates.

        Raises:
            StepError: the step is beyond twice the stability limit.
        """
        libration = fastest(self._motions.librations, groups)
        if libration is None or h <= _accurate(scheme, libration.period):
            return
        stable, accurate = _stable(scheme, libration.period), _accurate(scheme, libration.period)
        body = int(self._bodies.owners[libration.atoms[0]])
        finding = (
            f"{self._bodies.describe(body)} and similar bodies can swing among other molecules with a period of "
            f"{femtoseconds(libration.period)}. {scheme.name} is accurate up to {femtoseconds(accurate)}; with steps "
            f"of about {femtoseconds(max(accurate, HEATING * stable))} or more, liquids heat up"
        )
        remedies = [advice.SHORTER_STEP]
        if self._motions.remedies.has_hydrogen(tuple(self._bodies.atoms_of(body).tolist()), advice.LIGHT):
            remedies.append(advice.HEAVIER)
        if h >= SLIP:
            remedies.append(advice.in_femtoseconds(h))
        self._say("A step", h, h >= HOPELESS * stable, finding, *remedies)

    def _check_spin(self, scheme: Scheme, h: float, groups: int, temperature: float) -> None:
        """Check a step, ps, by the angle that the slimmest bodies turn in it at a temperature in K.

        Raises:
            StepError: they turn by `HALF_TURN`.
        """
        spin, accurate = self._motions.spin, self._longest_by_spin(scheme, groups, temperature)
        if spin is None or h <= accurate:
            return
        angle = h * spin.rate(temperature)
        finding = (
            f"{spin.name} and similar bodies have a moment of inertia of only {spin.moment:.2g} dalton nm^2 about one "
            f"axis. At {temperature:g} K they turn about it by {angle:.2g} radians from one kick to the next. "
            f"{scheme.name} is accurate up to {1000 * accurate:.2g} fs"
        )
        self._say("A step", h, angle >= HALF_TURN, finding, advice.SHORTER_STEP, advice.STRAIGHTEN)

    def _check_resonance(self, scheme: Scheme, h: float, groups: int) -> None:
        """Check a step, ps, by bonds whose forces act within drifts: kicks excite them that come twice a period.

        Raises:
            StepError: the step is in the window of instability, or beyond `DESTROYED` periods, or with a bath in its
                drift beyond half a period of a bond to hydrogen, where averages are wrong.
        """
        bond, hydrogen = fastest(self._motions.bonds, groups), self._fastest_hydrogen(groups)
        if bond is not None and h > RESONANCE * bond.period:
            has_light_hydrogen = self._motions.remedies.has_hydrogen(bond.atoms, advice.LIGHT)
            # Heavy hydrogens make the bonds of the atoms that they are bonded to faster.
            heavier = [advice.HEAVIER] if has_light_hydrogen else []
            remedies = [advice.up_to(self._longest_beside(scheme, groups)), *heavier, *self._hold(bond)]
            finding = (
                f"for {self._name(bond)}: its period is {femtoseconds(bond.period)}, and slow forces must act more "
                "than twice in each period"
            )
            is_shortened = scheme.bath_divides_drift and self._motions.moves_like_hydrogen(bond)
            longest = bond.period / 2 if is_shortened else DESTROYED * bond.period
            if h >= longest or _is_resonant(h, bond):
                remark = "More inner steps do not help"
                too_long = f"A step of {femtoseconds(h)} is too long {finding}"
                raise StepError(advice.message(too_long, *remedies, remark=remark))
            self._warn(advice.message(f"A step of {femtoseconds(h)} is long {finding}", *remedies))
        if scheme.bath_divides_drift and hydrogen is not None and h > STRETCHED / math.pi * hydrogen.period:
            x = math.pi * h / hydrogen.period
            share = max(0.0, x / math.tan(x)) if x < math.pi / 2 else 0.0
            finding = (
                f"At {femtoseconds(h)} averages of this molecule are wrong: slow forces stretch {self._name(hydrogen)} "
                f"(period {femtoseconds(hydrogen.period)}) by only {100 * share:.0f} % of what they should"
            )
            remedies = [advice.up_to(STRETCHED / math.pi * hydrogen.period), *self._hold(hydrogen)]
            self._warn(advice.message(finding, *remedies))

    def _check_energy(self, scheme: Scheme, h: float, groups: int) -> None:
        """Warn of a step, ps, at constant energy that is so long that the energy walks at random over a run.

        A scheme of fourth order whose step resonates with a harmonic of the librations gives and takes energy at
        random. Nothing is said of schemes of second order, whose energy oscillates further than it walks, or where a
        thermostat or barostat of the System acts.
        """
        libration, usual = fastest(self._motions.librations, groups), scheme.constant_energy_step
        if libration is None or usual is None or scheme.order < 4 or not self._is_isolated:
            return
        good = usual * libration.period / WATER
        if h <= TOLERATED * good:
            return
        error = min(1.0, AT_USUAL_STEP * math.exp(RESONANCE_DECAY * libration.period * (1 / good - 1 / h)))
        finding = (
            f"With steps of {femtoseconds(h)} the total energy wanders: its error rms(H)/rms(V) over a whole run is "
            f"about {_percent(error)}, and {_percent(AT_USUAL_STEP)} with {scheme.name} at {femtoseconds(good)}"
        )
        longer = "Longer steps are for a heat bath or hybrid Monte Carlo"
        self._warn(advice.message(finding, advice.up_to(good), remark=longer))

    def _longest_beside(self, scheme: Scheme, fast: int) -> float:
        """Return the longest step, ps, between kicks beside bonds of fast groups, a bit mask, without a warning."""
        bond, hydrogen = fastest(self._motions.bonds, fast), self._fastest_hydrogen(fast)
        longest = math.inf if bond is None else RESONANCE * bond.period
        if scheme.bath_divides_drift and hydrogen is not None:
            longest = min(longest, STRETCHED / math.pi * hydrogen.period)
        return longest

    def _longest_by_spin(self, scheme: Scheme, groups: int, temperature: float) -> float:
        """Return the longest step, ps, without a warning of spins."""
        spin = self._motions.spin
        if spin is None or not groups & spin.groups or not temperature:
            return math.inf
        return scheme.accuracy_limit / (FAST_SPIN * spin.rate(temperature))

    def _fastest_hydrogen(self, groups: int) -> Motion | None:
        """Return the fastest bond to hydrogen in force groups.

        A constant force in kicks every h, beside a spring that is followed exactly, moves the mean length of a bond by
        x/tan(x) of what it should, x = pi h/T with the period T: averages shift, at the right temperature.
        """
        bonds = [bond for bond in self._motions.bonds if bond.is_bond and self._motions.moves_like_hydrogen(bond)]
        return fastest(bonds, groups)

    def _hold(self, motion: Motion) -> list[str]:
        return self._motions.remedies.hold(motion.atoms) if motion.is_bond else [advice.soften(motion.force)]

    def _name(self, motion: Motion) -> str:
        labels, atoms = self._bodies.labels, motion.atoms
        residues = "" if labels is None else f" ({' and '.join(dict.fromkeys(labels[i] for i in atoms))})"
        if motion.is_bond:
            by = f" by {motion.force}" if motion.force else ""
            return f"the bond between atoms {atoms[0]} and {atoms[1]}{residues}{by}"
        plural = "s" if len(atoms) > 1 else ""
        return f"the motion of atom{plural} {', '.join(map(str, atoms))}{residues} by {motion.force}"

    def _say(self, what: str, h: float, is_refused: bool, finding: str, *remedies: str) -> None:
        """Refuse a step, or warn of it."""
        if is_refused:
            raise StepError(advice.message(f"{what} of {femtoseconds(h)} is too long: {finding}", *remedies))
        self._warn(advice.message(f"{what} of {femtoseconds(h)} is long: {finding}", *remedies))

    def _warn(self, message: str) -> None:
        # The same words with other numbers are not said again: tuning tries many steps.
        words = re.sub(r"[\d.]+", "", message)
        if words not in self._said:
            self._said.add(words)
            warn(StepWarning(message))


def _is_resonant(h: float, bond: Motion) -> bool:
    """Tell whether kicks every h, ps, excite a bond that moves within drifts, since they come twice a period.

    With x = omega h near pi, kicks of a share s of the bond's stiffness, of either sign, leave the trace of a step
    within 2 and -2 outside of pi (1 - s) to pi/(1 - s), with any scheme.
    """
    return h > (1 - bond.share) * bond.period / 2 and (1 - bond.share) * h < bond.period / 2


def _stable(scheme: Scheme, period: float) -> float:
    """Return the step in ps from which on a motion is unstable."""
    return scheme.stability_limit * period / (2 * math.pi)


def _accurate(scheme: Scheme, period: float) -> float:
    """Return the step in ps up to which energies of a motion are right within a tenth."""
    return scheme.accuracy_limit * period / (2 * math.pi)


def _percent(fraction: float) -> str:
    """Write one digit, without an exponent: 20 % and not 2e+01 %."""
    return f"{float(f'{100 * fraction:.1g}'):g} %"


def _with_substeps(flow: Flow, _: float) -> float:
    """Return the longest step of a flow within drifts, ps, with the number of substeps that it names, or one."""
    return flow.step * flow.scheme.inner_fraction(flow.substeps or 1)
