"""Rules for the length of steps: a limit for each kind of motion, and what is reported beyond it."""

import math
from collections.abc import Callable
from typing import NamedTuple

from openmm_sier.dynamics.schemes import Scheme
from openmm_sier.stability import advice
from openmm_sier.stability.advice import femtoseconds
from openmm_sier.stability.motions import Motion, Motions, fastest

#: Longest step, as a fraction of the period of a bond whose forces act within drifts: half a period less a tenth.
RESONANCE = 0.45

#: From this fraction of the period on, several bonds and bends resonate together, or the bond alone does at a whole
#: period. Of flexible TIP3P SIER4G conserves the energy at 0.53 to 0.59 periods, and at 0.62 eight molecules gained 5
#: kJ/mol in 1 ps; with SIER2 at 0.62 they were destroyed. With a bond between the hydrogens it reached 2270 K within
#: ten steps of 0.67 periods.
DESTROYED = 0.6

#: x = pi h/T up to which x/tan(x) is 0.9 or more: slow forces stretch a bond of period T by at least that share.
STRETCHED = 0.54

#: The same for angles of hydrogens between constrained bonds, and a share of three quarters. With heavy hydrogens those
#: of lysozyme have 0.81 or more at 9 fs, and that of TIP3P with constrained bonds has 0.53: its mean angle in a liquid
#: was 103.41 degrees at 9 fs, 102.98 at 6 fs, 102.73 at 4 fs and 102.54 at 2 fs, each to 0.1, and would be 104.52
#: without neighbours.
BENT = 0.83

#: Inner steps take up to this share of the step at which the energy of the fastest bond is right within a tenth. For a
#: bond of 18.5 fs these are 5.9 fs by SIER4G, and 3.5 fs by leapfrog steps around a bath.
INNER_SHARE = 0.875

#: ps. The period of the bond that inner steps follow where none is known: of C=O.
USUAL_PERIOD = 0.0185

#: ps. The fastest bonds that molecules have, those of oxygen to hydrogen.
FASTEST_BOND = 0.009

#: By the table at `motions.HYDROGEN_BOND` energy grows from this share of the stability limit on, since some librations
#: are faster.
HEATING = 0.8

#: A step is refused at this multiple of the stability limit of a libration. There all librations of water are unstable,
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

#: Radians. A step is refused where a body turns so far in it at sqrt(kT/I), two kicks a turn.
HALF_TURN = math.pi

#: K, where there is no heat bath.
ROOM_TEMPERATURE = 300.0


class Conditions(NamedTuple):
    """What a step is judged by, apart from its length.

    Attributes:
        scheme: of the step.
        groups: force groups in the kicks, a bit mask.
        fast_groups: force groups within drifts, a bit mask.
        temperature: K.
        conserves_energy: whether neither a bath nor a barostat acts.
        is_inner: whether it is a step within drifts.
    """

    scheme: Scheme
    groups: int
    fast_groups: int = 0
    temperature: float = ROOM_TEMPERATURE
    conserves_energy: bool = False
    is_inner: bool = False

    def describe(self, h: float) -> str:
        """Return a step, ps, in words."""
        return f"{'An inner' if self.is_inner else 'A'} step of {femtoseconds(h)}"


class Verdict(NamedTuple):
    """A warning or refusal of a step, and its message."""

    message: str
    is_refused: bool = False


class Limit(NamedTuple):
    """A limit of the step under some conditions.

    Attributes:
        longest_step: the longest step without a warning, ps.
        verdict: function that judges a longer step, ps.
    """

    longest_step: float
    verdict: Callable[[float], Verdict]


class Rule(NamedTuple):
    """A kind of limit.

    Attributes:
        limit: function that returns the limit for the motions of a System; None without such motions.
        judges_inner_step: whether it judges steps within drifts.
        is_estimate: whether longer steps may be right, so that the rule does not limit a step that is chosen for users.
    """

    limit: Callable[[Motions, Conditions], Limit | None]
    judges_inner_step: bool = False
    is_estimate: bool = False


def _vibrations(motions: Motions, conditions: Conditions) -> Limit | None:
    """Limit the step by the fastest vibration in kicks: its energies must be right within a tenth.

    A step at which it is unstable is refused.
    """
    vibration = fastest(motions.vibrations, conditions.groups)
    if vibration is None:
        return None
    accurate = accurate_step(conditions.scheme, vibration.period)
    stable = _unstable_step(conditions.scheme, vibration.period)

    def verdict(h: float) -> Verdict:
        shorter = advice.PREPARE if vibration.can_be_fast else advice.SHORTER_STEP
        finding = (
            f"{motions.describe(vibration)} is not constrained and has a period of {femtoseconds(vibration.period)}. "
            f"{conditions.scheme.name} is accurate up to {femtoseconds(accurate)}, and unstable from "
            f"{femtoseconds(stable)} on"
        )
        remedies = advice.MORE_SUBSTEPS if conditions.is_inner else shorter, *motions.ways_to_hold(vibration)
        return _judged(conditions.describe(h), h >= stable, finding, *remedies)

    return Limit(accurate, verdict)


def _unknown_forces(motions: Motions, conditions: Conditions) -> Limit | None:
    """Report Forces whose stiffness is unknown where the fastest bonds would be inaccurate."""
    unknown = [name for group, name in motions.unknown if conditions.groups >> group & 1]
    if not unknown:
        return None

    def verdict(h: float) -> Verdict:
        finding = (
            f"{conditions.describe(h)} cannot be judged, since the stiffness of {', '.join(unknown)} is not known. "
            "Compare a run with half the step: if the energy error shrinks, or the temperature is too high, the step "
            "is too long"
        )
        return Verdict(advice.message(finding, advice.CHECK_FORCES))

    return Limit(accurate_step(conditions.scheme, FASTEST_BOND), verdict)


def _librations(motions: Motions, conditions: Conditions) -> Limit | None:
    """Limit the step by the fastest libration, whose frequency is an estimate.

    A step beyond `HOPELESS` times the stability limit is refused.
    """
    libration = fastest(motions.librations, conditions.groups)
    if libration is None:
        return None
    accurate = accurate_step(conditions.scheme, libration.period)
    stable = _unstable_step(conditions.scheme, libration.period)

    def verdict(h: float) -> Verdict:
        body = motions.body_of(libration)
        finding = (
            f"{motions.bodies.describe(body)} and similar bodies can swing among other molecules with a period of "
            f"{femtoseconds(libration.period)}. {conditions.scheme.name} is accurate up to {femtoseconds(accurate)}; "
            f"with steps of about {femtoseconds(max(accurate, HEATING * stable))} or more, liquids heat up"
        )
        remedies = [advice.SHORTER_STEP]
        if motions.remedies.has_hydrogen(tuple(motions.bodies.atoms_of(body).tolist()), advice.LIGHT):
            remedies.append(advice.HEAVIER)
        if h >= SLIP:
            remedies.append(advice.in_femtoseconds(h))
        return _judged(conditions.describe(h), h >= HOPELESS * stable, finding, *remedies)

    return Limit(accurate, verdict)


def _spins(motions: Motions, conditions: Conditions) -> Limit | None:
    """Limit the step by the angle that the slimmest bodies turn in it; a step of `HALF_TURN` is refused."""
    spin = motions.spin
    if spin is None or not conditions.groups & spin.groups or not conditions.temperature:
        return None
    rate = spin.rate(conditions.temperature)
    accurate = conditions.scheme.spin_limit / rate

    def verdict(h: float) -> Verdict:
        finding = (
            f"{spin.name} and similar bodies have a moment of inertia of only {spin.moment:.2g} dalton nm^2 about one "
            f"axis. At {conditions.temperature:g} K they turn about it by {h * rate:.2g} radians from one kick to the "
            f"next. {conditions.scheme.name} is accurate up to {1000 * accurate:.2g} fs"
        )
        return _judged(conditions.describe(h), h * rate >= HALF_TURN, finding, advice.SHORTER_STEP, advice.STRAIGHTEN)

    return Limit(accurate, verdict)


def _resonances(motions: Motions, conditions: Conditions) -> Limit | None:
    """Limit the step by the fastest vibration within drifts: kicks excite it that come twice a period.

    A step is refused in the window of instability, beyond `DESTROYED` periods, or with a bath in its drift beyond half
    a period of a bond to hydrogen, where averages are wrong.
    """
    vibration = fastest(motions.vibrations, conditions.fast_groups)
    if vibration is None:
        return None
    longest = min(RESONANCE * vibration.period, _window(vibration))

    def verdict(h: float) -> Verdict:
        has_light_hydrogen = motions.remedies.has_hydrogen(vibration.atoms, advice.LIGHT)
        # Heavy hydrogens make the bonds of the atoms that they are bonded to faster.
        heavier = [advice.HEAVIER] if has_light_hydrogen else []
        stretch = _stretches(motions, conditions)
        acceptable = longest if stretch is None else min(longest, stretch.longest_step)
        remedies = [advice.up_to(acceptable), *heavier, *motions.ways_to_hold(vibration)]
        finding = (
            f"for {motions.describe(vibration)}: its period is {femtoseconds(vibration.period)}, and slow forces must "
            "act more than twice in each period"
        )
        averages_are_wrong = conditions.scheme.bath_divides_drift and motions.moves_like_hydrogen(vibration)
        refused = vibration.period / 2 if averages_are_wrong else DESTROYED * vibration.period
        if h >= refused or _is_resonant(h, vibration):
            too_long = f"{conditions.describe(h)} is too long {finding}"
            remark = "More inner steps do not help"
            return Verdict(advice.message(too_long, *remedies, remark=remark), is_refused=True)
        return Verdict(advice.message(f"{conditions.describe(h)} is long {finding}", *remedies))

    return Limit(longest, verdict)


def _stretches(motions: Motions, conditions: Conditions) -> Limit | None:
    """Limit the step of a scheme with a bath in its drift by the mean lengths of bonds to hydrogen, and mean angles.

    A constant force in kicks every h, with a spring that is integrated exactly, changes the mean length of a bond by
    x/tan(x) of the correct amount, x = pi h/T with the period T: averages shift, at the right temperature.
    """
    if not conditions.scheme.bath_divides_drift:
        return None
    bond, angle = (motions.fastest_hydrogen(kind, conditions.fast_groups) for kind in ("bond", "angle"))
    limits = [
        _response(motions, vibration, verb, longest)
        for vibration, verb, longest in ((bond, "stretch", STRETCHED), (angle, "bend", BENT))
        if vibration is not None
    ]
    return min(limits, key=lambda limit: limit.longest_step, default=None)


def _response(motions: Motions, vibration: Motion, verb: str, longest: float) -> Limit:
    """Limit the step by the response of a vibration to slow forces; `longest` is the largest x, see `_stretches`."""
    longest_step = longest / math.pi * vibration.period

    def verdict(h: float) -> Verdict:
        x = math.pi * h / vibration.period
        share = max(0.0, x / math.tan(x)) if x < math.pi / 2 else 0.0
        finding = (
            f"At {femtoseconds(h)} averages of this molecule are wrong: slow forces {verb} "
            f"{motions.describe(vibration)} (period {femtoseconds(vibration.period)}) by only {100 * share:.0f} % of "
            "what they should"
        )
        return Verdict(advice.message(finding, advice.up_to(longest_step), *motions.ways_to_hold(vibration)))

    return Limit(longest_step, verdict)


def _energy(motions: Motions, conditions: Conditions) -> Limit | None:
    """Limit the step at constant energy, so that the energy hardly walks at random over a run.

    A scheme of fourth order whose step resonates with a harmonic of the librations gives and takes energy at random.
    Schemes of second order have no limit, since their energy oscillates further than it walks.
    """
    libration, usual = fastest(motions.librations, conditions.groups), conditions.scheme.constant_energy_step
    if libration is None or usual is None or conditions.scheme.order < 4 or not conditions.conserves_energy:
        return None
    period, good = libration.period, usual * libration.period / WATER

    def verdict(h: float) -> Verdict:
        error = min(1.0, AT_USUAL_STEP * math.exp(RESONANCE_DECAY * period * (1 / good - 1 / h)))
        finding = (
            f"With steps of {femtoseconds(h)} the total energy wanders: its error rms(H)/rms(V) over a whole run is "
            f"about {_percent(error)}, and {_percent(AT_USUAL_STEP)} with {conditions.scheme.name} at "
            f"{femtoseconds(good)}"
        )
        longer = "Longer steps are for a heat bath or hybrid Monte Carlo"
        return Verdict(advice.message(finding, advice.up_to(good), remark=longer))

    return Limit(TOLERATED * good, verdict)


#: All rules in the order of their verdicts. The first refusal ends a check.
RULES = (
    Rule(_vibrations),
    Rule(_unknown_forces, is_estimate=True),
    Rule(_librations),
    Rule(_spins),
    Rule(_vibrations, judges_inner_step=True),
    Rule(_unknown_forces, judges_inner_step=True, is_estimate=True),
    Rule(_resonances),
    Rule(_stretches),
    Rule(_energy),
)


def _judged(step: str, is_refused: bool, finding: str, *remedies: str) -> Verdict:
    """Return the verdict on a step, given in words."""
    degree = "too long" if is_refused else "long"
    return Verdict(advice.message(f"{step} is {degree}: {finding}", *remedies), is_refused)


def _is_resonant(h: float, vibration: Motion) -> bool:
    """Return whether kicks every h, ps, excite a vibration within drifts, since they come twice a period.

    With x = omega h near pi, kicks of a share s of its stiffness, of either sign, leave the trace of a step
    within 2 and -2 outside of pi (1 - s) to pi/(1 - s), with any scheme.
    """
    return h > _window(vibration) and (1 - vibration.share) * h < vibration.period / 2


def _window(vibration: Motion) -> float:
    """Return the step in ps from which on kicks may make a vibration within drifts unstable.

    For a bond that is softer than its surroundings, s > 1, it is half of pi/(1 + s), up to where the trace of a step,
    2 cos x - s x sin x, is above -2.
    """
    return max(1 - vibration.share, 0.5 / (1 + vibration.share)) * vibration.period / 2


def _unstable_step(scheme: Scheme, period: float) -> float:
    """Return the step in ps from which on a motion is unstable."""
    return scheme.stability_limit * period / (2 * math.pi)


def accurate_step(scheme: Scheme, period: float) -> float:
    """Return the step in ps up to which energies of a motion are right within a tenth."""
    return scheme.accuracy_limit * period / (2 * math.pi)


def longest_inner_step(scheme: Scheme, period: float | None) -> float:
    """Return the longest inner step in ps within drifts of a scheme.

    Args:
        scheme: of the outer steps.
        period: of the fastest motion by fast forces, ps; None if it is not known.
    """
    return INNER_SHARE * accurate_step(scheme.within_drifts, USUAL_PERIOD if period is None else period)


def _percent(fraction: float) -> str:
    """Write one digit, without an exponent: 20 % and not 2e+01 %."""
    return f"{float(f'{100 * fraction:.1g}'):g} %"
