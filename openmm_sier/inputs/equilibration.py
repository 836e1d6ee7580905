"""Prepare the start of a run: positions and velocities at a temperature."""

import math
import warnings
from typing import NamedTuple

import numpy as np
import openmm
from openmm import unit

from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.dynamics.schemes import SIER4G
from openmm_sier.dynamics.threads import cores
from openmm_sier.engines.choice import usual_platform
from openmm_sier.engines.snapshot import Snapshot
from openmm_sier.inputs.report import SILENT, Advance, Report
from openmm_sier.integrators.constant_temperature import SIERThermostatIntegrator
from openmm_sier.integrators.integrator import SIERIntegrator
from openmm_sier.integrators.langevin import SIERLangevinIntegrator
from openmm_sier.stability.step_check import StepCheck
from openmm_sier.system import tables
from openmm_sier.system.second_context import platform_of
from openmm_sier.system.temperature import DegreesOfFreedom, degrees_of_freedom, thermal_energies

#: Net force on a molecule in kJ/mol/nm, divided by the square root of its number of bodies, above which a start is
#: minimized. Among 512 molecules of water at 297 K the largest is 1000 to 2200.
LARGE_FORCE = 5e3

#: Friction of an equilibration, 1/ps, and a scheme and step with rotations within 0.3 K of translations. SIER2 would
#: need steps of 0.5 fs.
FRICTION = 5.0
SCHEME, STEP = SIER4G, 0.006

#: Step of an equilibration as a fraction of the longest step allowed by a system's bonds, if shorter than `STEP`. At
#: that longest step energies of bonds in the kicks are off by a tenth, which falls as the fourth power of the fraction.
SHARE_OF_LONGEST = 0.75

#: Temperatures and potential energies are averaged over windows of this length in ps. The last two windows must agree
#: with the requested temperature and with each other; earlier ones do not count.
WINDOW = 1.0
FEWEST_WINDOWS = 3

#: Steps between two samples.
EVERY = 6

#: Maximum length of an equilibration, ps.
LONGEST = 20.0

#: Tightest bound on a temperature, K, since schemes have errors too.
TIGHTEST = 1.0

#: Minimum kinetic energy at the start of a run at constant energy, as a fraction of the thermal one.
LEAST_MOTION = 0.1


class EquilibrationWarning(UserWarning):
    """Warning that an equilibration ended before temperatures and potential energy had settled."""


class Means(NamedTuple):
    """Mean temperatures in K, NaN without degrees of freedom, and mean potential energy in kJ/mol."""

    translation: float
    rotation: float
    flexible: float
    potential: float


class Equilibration(NamedTuple):
    """Result of an equilibration.

    Attributes:
        time: simulated time, ps.
        means: means over the last two windows.
        settled: whether temperatures and potential energy are within their bounds, see `equilibrate`.
        doubtful: whether the liquid has not settled although there was time, or a temperature is out of bounds.
        described: text with time, temperatures and bounds; empty if it took no time.
    """

    time: float
    means: Means
    settled: bool
    doubtful: bool
    described: str


def platform_for(name: str | None) -> openmm.Platform:
    """Return the platform of this name; None: OpenMM's default, the fastest that works here."""
    return usual_platform() if name is None else openmm.Platform.getPlatformByName(name)


def make_context(system: openmm.System, integrator: openmm.Integrator, platform: str | None) -> openmm.Context:
    """Return a new Context, in mixed precision if possible, with at most one thread per core available to the process.

    Args:
        system, integrator: System and integrator of the Context.
        platform: name of the platform; None for OpenMM's choice, the fastest one that works.
    """
    chosen = platform_for(platform)
    properties, names = {}, chosen.getPropertyNames()
    if "Precision" in names:
        properties["Precision"] = "mixed"
    if "Threads" in names:
        # OpenMM counts all cores of the machine.
        properties["Threads"] = str(min(int(chosen.getPropertyDefaultValue("Threads")), cores()))
    return openmm.Context(system, integrator, chosen, properties)


def prepare(
    context: openmm.Context,
    positions: np.ndarray,
    temperature: float,
    seed: int = 1,
    time: float | None = None,
    minimize: bool | None = None,
    report: Report = SILENT,
) -> Equilibration:
    """Prepare a new run: minimize, equilibrate, stop the centre of mass, and set the clock to zero.

    For a run at constant energy the kinetic energy is set so that the total energy equals the mean over the
    equilibration, and the mean temperature that of the bath. Starting from a snapshot of the bath, it would be off by
    T sqrt(k/C), with the heat capacity C: 4 K for 512 molecules of water.

    Args:
        context: a Context with a SIERIntegrator.
        positions: (N, 3), a quantity.
        temperature: temperature, K.
        seed: seed of velocities and noise.
        time: time of the equilibration, ps; None continues until the liquid has settled, see `equilibrate`.
        minimize: whether to minimize first; None does so if forces are larger than in a liquid.
        report: receives notes and progress.

    Returns:
        The result of the equilibration.
    """
    context.setPositions(positions)
    context.computeVirtualSites()
    context.applyConstraints(1e-6)
    strongest = _strongest_force(context)
    if minimize or (minimize is None and strongest > LARGE_FORCE):
        openmm.LocalEnergyMinimizer.minimize(context)
        energy = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        report.note(
            f"minimized to {energy:.5g} kJ/mol: the largest force on a molecule was {strongest:.3g} kJ/mol/nm, and is "
            f"{_strongest_force(context):.3g}"
        )
    outcome = equilibrate(context, temperature, seed, time, report)
    stop_centre_of_mass(context)
    if outcome.settled and not isinstance(context.getIntegrator(), SIERThermostatIntegrator):
        _set_energy(context, temperature, outcome.means.potential)
    context.setTime(0)
    context.setStepCount(0)
    return outcome


def _strongest_force(context: openmm.Context) -> float:
    """Return the largest net force on a molecule over the root of its size, kJ/mol/nm; infinite if not finite."""
    bodies = context.getIntegrator().bodies
    forces = context.getState(forces=True).getForces(asNumpy=True)
    forces = forces.value_in_unit(unit.kilojoule_per_mole / unit.nanometer)[bodies.owners >= 0]
    # Bonds exert much larger forces on the bodies of a molecule than its surroundings.
    _, molecules, sizes = np.unique(bodies.molecules, return_inverse=True, return_counts=True)
    owners = molecules[bodies.owners[bodies.owners >= 0]]
    net = np.linalg.norm([np.bincount(owners, column) for column in forces.T], axis=0)
    strongest = float((net / np.sqrt(sizes)).max())
    return strongest if math.isfinite(strongest) else math.inf


def equilibrate(
    context: openmm.Context, temperature: float, seed: int = 1, time: float | None = None, report: Report = SILENT
) -> Equilibration:
    """Equilibrate a Context at a temperature, and at constant pressure if its integrator or System has a barostat.

    Velocities are drawn at random, and a heat bath acts until the liquid has settled. Afterwards the Context has the
    final positions, velocities and box; its time and step count do not change. An error leaves it unchanged.

    The liquid has settled when, over the last two windows of 1 ps,

    - the means of T_trans, T_rot and the temperature of flexible molecules differ from the given temperature by at most
      T sqrt(2/dof), the canonical standard deviation of a snapshot, or 1 K if that is more. With a friction of 5/ps the
      mean over 2 ps scatters by a third of that, so one in a hundred windows counts as unsettled by chance;
    - the mean potential energy of the second differs from that of the first by less than 2 kT sqrt(dof/2), two
      canonical standard deviations of the kinetic energy. A start from a lattice still releases many times as much
      after the temperature has settled.

    The first window is ignored. The same seed gives the same result if the platform's forces are deterministic.

    Args:
        context: a Context with a SIERIntegrator of any ensemble, initial positions, and the pressure in its integrator
            or System.
        temperature: temperature, K.
        seed: seed of velocities and noise.
        time: time, ps. None continues until the liquid has settled, for at most 20 ps, and warns if it has not. A
            number runs for that time in any case, and warns if a temperature is out of bounds.
        report: receives notes and progress.

    Returns:
        The result.

    Raises:
        TypeError: the Context has another integrator.
    """
    if time == 0:
        _refuse_other_integrators(context)
        context.setVelocitiesToTemperature(temperature, seed)
        return Equilibration(0.0, Means(*4 * [math.nan]), settled=False, doubtful=False, described="")
    bath = _bath_context(context, temperature, seed)
    integrator = bath.getIntegrator()
    dof = degrees_of_freedom(integrator.bodies, integrator.conservesMomentum)
    step = integrator.getStepSize().value_in_unit(unit.picosecond)
    if step < STEP:
        report.note(
            f"equilibrates in steps of {1000 * step:.2g} fs, since bonds or rotations are too fast for longer ones"
        )
    steps = round((LONGEST if time is None else time) / step)
    # Windows have nearly equal lengths, so that a short one does not count as much as a long one.
    window_steps = math.ceil(steps / max(1, round(steps * step / WINDOW)))
    windows: list[Means] = []
    completed, has_settled = 0, False
    with report.progress(f"equilibration at {temperature:g} K", steps, step) as advance:
        while completed < steps and not (has_settled and time is None):
            length = min(window_steps, steps - completed)
            windows.append(_window(bath, length, advance, completed))
            completed += length
            has_settled = _has_settled(windows, temperature, dof)
    last = Means(*np.mean(windows[-2:], axis=0)) if windows else Means(*4 * [math.nan])
    # A user may choose a time that is too short to settle.
    doubtful = bool(completed) and not has_settled and (time is None or not _are_within_bounds(last, temperature, dof))
    described = _describe(last, completed * step, temperature, dof) if completed else ""
    _copy_atoms_and_box(context, bath)
    outcome = Equilibration(completed * step, last, has_settled, doubtful, described)
    if completed:
        _report(outcome, report)
    return outcome


def _refuse_other_integrators(context: openmm.Context) -> None:
    """Refuse a Context without a SIERIntegrator."""
    integrator = context.getIntegrator()
    if not isinstance(integrator, SIERIntegrator):
        raise TypeError(f"equilibrate needs a Context with a SIER integrator, got a {type(integrator).__name__}")


def _bath_context(context: openmm.Context, temperature: float, seed: int) -> openmm.Context:
    """Return a copy of a Context at constant temperature, with new velocities."""
    _refuse_other_integrators(context)
    integrator = context.getIntegrator()
    pressure = integrator.getPressure() if isinstance(integrator, SIERThermostatIntegrator) else None
    fast, step = integrator.fastForceGroups, _step_of(context, temperature)
    langevin = SIERLangevinIntegrator(
        temperature, FRICTION, step, SCHEME, integrator.bodies, pressure=pressure, fastForceGroups=fast
    )
    langevin.setRandomNumberSeed(seed)
    bath = openmm.Context(context.getSystem(), langevin, *platform_of(context))
    bath.setState(context.getState(positions=True))
    bath.setVelocitiesToTemperature(temperature, seed)
    return bath


def _copy_atoms_and_box(context: openmm.Context, other: openmm.Context) -> None:
    """Copy the positions, velocities and box of another Context."""
    time, steps = context.getTime(), context.getStepCount()
    context.setState(other.getState(positions=True, velocities=True))
    context.setTime(time)
    context.setStepCount(steps)


def _step_of(context: openmm.Context, temperature: float) -> float:
    """Return the step of an equilibration, ps: the usual one, or one short enough for bonds and spins."""
    integrator = context.getIntegrator()
    groups, fast = integrator.getIntegrationForceGroups(), sum(1 << group for group in integrator.fastForceGroups)
    check = StepCheck(context.getSystem(), integrator.bodies)
    return min(STEP, SHARE_OF_LONGEST * check.longest_step(SCHEME, groups & ~fast, groups & fast, temperature, context))


def _window(bath: openmm.Context, steps: int, advance: Advance, completed: int) -> Means:
    """Run for a number of steps after those already done, and average."""
    integrator, samples = bath.getIntegrator(), []
    for begin in range(0, steps, EVERY):
        count = min(EVERY, steps - begin)
        integrator.step(count)
        potential = bath.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
        samples.append((*integrator.computeTemperatures().in_kelvin()[1:], potential))
        advance(completed + begin + count)
    return Means(*np.mean(samples, axis=0).tolist())


def _has_settled(windows: list[Means], temperature: float, dof: DegreesOfFreedom) -> bool:
    if len(windows) < FEWEST_WINDOWS:
        return False
    earlier, later = windows[-2:]
    steady = 2 * GAS_CONSTANT * max(temperature, TIGHTEST) * math.sqrt(sum(dof) / 2)
    means = Means(*np.mean([earlier, later], axis=0))
    return abs(later.potential - earlier.potential) <= steady and _are_within_bounds(means, temperature, dof)


def _are_within_bounds(means: Means, temperature: float, dof: DegreesOfFreedom) -> bool:
    """Return whether mean temperatures of all kinds of motion with degrees of freedom are within their bounds."""
    pairs = zip(means[:3], dof, strict=True)
    return all(abs(mean - temperature) <= bound(temperature, number) for mean, number in pairs if number)


def bound(temperature: float, dof: float) -> float:
    """Return the largest deviation of a mean temperature, K: a canonical standard deviation, at least 1 K."""
    return max(temperature * math.sqrt(2 / dof), TIGHTEST)


def _describe(means: Means, time: float, temperature: float, dof: DegreesOfFreedom) -> str:
    """Return text with the time and the final temperatures of an equilibration."""
    pairs = zip(("T_trans", "T_rot", "T_flexible"), means[:3], dof, strict=True)
    shown = [f"{name} = {value:.0f} K (bound: {bound(temperature, n):.0f} K)" for name, value, n in pairs if n]
    return f"{time:.3g} ps at {temperature:g} K: {', '.join(shown)} over the last {min(2 * WINDOW, time):.2g} ps"


def _report(outcome: Equilibration, report: Report) -> None:
    """Report an equilibration, and warn if it is doubtful."""
    if outcome.doubtful:
        warnings.warn(
            f"not equilibrated after {outcome.described}: a temperature is out of bounds, or the potential energy "
            "still changes. Equilibrate for longer, and minimize the energy first if you have not",
            EquilibrationWarning,
            stacklevel=4,
        )
    report.note(f"equilibrated for {outcome.described}" + ("" if outcome.settled else "; not settled"))


def stop_centre_of_mass(context: openmm.Context) -> None:
    """Bring the centre of mass of a Context to rest."""
    masses, velocities = tables.masses(context.getSystem()), Snapshot.of(context).velocities
    if masses.any():
        velocities[masses > 0] -= masses @ velocities / masses.sum()
        context.setVelocities(velocities)


def _set_energy(context: openmm.Context, temperature: float, potential: float) -> None:
    """Scale all velocities so that the total energy is the mean total energy at a temperature.

    Args:
        context: a Context at the end of an equilibration, with the centre of mass at rest.
        temperature: temperature, K.
        potential: mean potential energy at this temperature, kJ/mol.
    """
    integrator = context.getIntegrator()
    bodies, conserved = integrator.bodies, integrator.conservesMomentum
    state = context.getState(energy=True, velocities=True)
    thermal = 0.5 * sum(degrees_of_freedom(bodies, conserved)) * GAS_CONSTANT * temperature
    present = state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    target, kinetic = thermal + potential - present, sum(thermal_energies(bodies, integrator.getBodyState(), conserved))
    if target > LEAST_MOTION * thermal and kinetic > 0:
        context.setVelocities(state.getVelocities(asNumpy=True) * math.sqrt(target / kinetic))
