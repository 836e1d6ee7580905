"""A Context with a mixture and an integrator, the view that users have of it, and the motions that it allows."""

import copy
from functools import cached_property
from itertools import combinations

import numpy as np
import openmm
from hypothesis import reject

from openmm_sier.engines.snapshot import HOST_PLATFORMS
from tests.laws.mechanics import allowed_motions, centre_of, constrained_pairs, masses_of, virtual_sites
from tests.laws.mixtures import box_of
from tests.laws.readings import molecules_of, rigid_atoms
from tests.support.restarts import clock_and_box, full_state
from tests.support.waters import phase_point, plain_context, platform, properties_of

#: Errors by which the package and OpenMM refuse what users ask for.
REFUSALS = (openmm.OpenMMException, ValueError, TypeError)

#: nm and nm/ps: two Contexts at the same view differ by rounding, which three steps and what is asked between them
#: magnify little. The exact engine reads its bodies from the atoms, to 1e-15 nm; OpenMM's solvers stop at a relative
#: tolerance of 1e-9 of lengths, which is divided by the step for velocities. A change that was missed displaces atoms
#: by 1e-6 nm or more.
ROUNDING = {"exact": (1e-10, 1e-7), "native": (1e-8, 1e-5), "kernels": (1e-10, 1e-7)}

#: The same for the same steps in another number of calls, or of settings before and after a Context is made.
SAME = {"exact": (0.0, 0.0), "native": ROUNDING["native"], "kernels": (0.0, 0.0)}

#: The same on the CPU platform with another list of neighbours: forces of single precision are good to 1e-3 kJ/mol/nm,
#: which displace a hydrogen by 1e-8 nm in five steps.
WITH_ANOTHER_LIST = (1e-8, 1e-5)

#: Such a minimization ends up to some steps of its line search elsewhere.
MINIMIZED_WITH_ANOTHER_LIST = (1e-6, 1e-3)

#: Rounding of energies on the CPU platform, kJ/mol, and relative to them where they are larger than 1: sums in single
#: precision, of terms of up to 1e3 kJ/mol, such as the self energy of charges.
SINGLE_ENERGY = 1e-4

#: Factor on the edges of boxes.
ROOM = 1.1


def in_box(positions, molecules, box):
    """Return positions (N, 3) with each molecule where OpenMM has it on GPUs, its mean position in the box, (3, 3)."""
    found = positions.copy()
    for atoms in molecules:
        for edge in (2, 1, 0):
            found[atoms] -= np.floor(found[atoms].mean(axis=0)[edge] / box[edge, edge]) * box[edge]
    return found


class View:
    """All that users see of a Context, without energies: OpenMM draws random numbers for those of CustomIntegrators.

    Attributes:
        positions, velocities: (N, 3), nm and nm/ps.
        box: (3, 3), nm.
        time: ps.
        steps: the step count.
        parameters: by name.
    """

    def __init__(self, context):
        state = openmm.Context.getState(context, positions=True, velocities=True, parameters=True)
        self.positions = np.array(state.getPositions(asNumpy=True)._value)
        self.velocities = np.array(state.getVelocities(asNumpy=True)._value)
        self.box = np.array(state.getPeriodicBoxVectors(asNumpy=True)._value)
        self.time = state.getTime()._value
        self.steps = state.getStepCount()
        self.parameters = dict(state.getParameters())

    def show_in(self, context):
        """Set a Context to this."""
        context.setPeriodicBoxVectors(*self.box)
        for name, value in self.parameters.items():
            context.setParameter(name, value)
        context.setPositions(self.positions)
        context.setVelocities(self.velocities)
        context.setTime(self.time)
        context.setStepCount(self.steps)

    def differences(self, other):
        """Return the largest difference of each of the numbers, by name."""
        names = {"positions", "velocities", "box", "time", "steps"}
        found = {name: float(np.abs(np.subtract(getattr(self, name), getattr(other, name))).max()) for name in names}
        if self.parameters != other.parameters:
            found["parameters"] = np.inf
        return found

    def assert_near(self, other, tolerance, of_velocities=None):
        """Compare with another view; tolerances in nm and nm/ps, zero for the same bits."""
        tolerances = {"velocities": tolerance if of_velocities is None else of_velocities, "time": 1e-12, "steps": 0}
        for name, difference in self.differences(other).items():
            # A difference that is not a number is none of the numbers below.
            assert difference <= tolerances.get(name, tolerance), f"{name} differ by {difference:.1e}"


class Run:
    """A mixture in a Context with an integrator.

    Attributes:
        mixture, method, name: of which it is made: Systems, integrator and platform.
        settings: setters of the integrator that were called and their arguments.
        added: functions that make further Forces of the System.
        saved: what was saved, for later.
        hardness: factor on the constants of bonds.
        drawn, repeats: the last action that drew velocities, and whether it was the one before too.
    """

    def __init__(self, mixture, method, name="Reference", settings=(), forces=()):
        self.mixture = mixture
        self.method = method
        self.name = name
        self.settings = list(settings)
        self.added = tuple(forces)
        self.saved = []
        self.hardness = 1.0
        self.drawn = None
        self.repeats = False
        self.built = built = mixture.build()
        self.system = built.system
        self.system.addForce(self._pull())
        for force in forces:
            self.system.addForce(force())
        if self.is_periodic:
            # Room for moves to a smaller volume.
            self.system.setDefaultPeriodicBoxVectors(*(ROOM * box_of(self.system)))
        self.integrator = method.make(built.bodies, settings)
        self.context = self.bind(self.integrator)
        self.context.setPositions(self.start)
        self.context.setVelocities(built.velocities)
        if name not in HOST_PLATFORMS:
            # OpenMM writes charges there with the first forces, and a checkpoint of before brings back none.
            self.context.getState(forces=True)

    def _pull(self):
        """Return a force on each massive atom with a global parameter and one for each atom."""
        force = openmm.CustomExternalForce("pull*share*z")
        force.addGlobalParameter("pull", 1.0)
        force.addPerParticleParameter("share")
        for atom in np.flatnonzero(self.masses):
            force.addParticle(int(atom), [0.1 * (1 + atom % 3)])
        return force

    def bind(self, integrator):
        """Return a Context of the System with an integrator."""
        return openmm.Context(self.system, integrator, platform(self.name), properties_of(self.name))

    @cached_property
    def masses(self):
        return masses_of(self.system)

    @cached_property
    def sites(self):
        return virtual_sites(self.system)

    @cached_property
    def constraints(self):
        """Pairs (K, 2) of atoms that move, and lengths in nm."""
        return constrained_pairs(self.system)

    @cached_property
    def start(self):
        """Positions (N, 3) in nm, with the images of the mixture in the box of the System."""
        positions = self.built.positions + self.built.images @ (box_of(self.system) - box_of(self.built.plain))
        if self.name in HOST_PLATFORMS or not self.is_periodic:
            return positions
        # With the first step GPU platforms bring molecules into the box, which changes the energy of the pull.
        return in_box(positions, self.molecules, box_of(self.system))

    @cached_property
    def pull(self):
        """The force of `_pull` in the System."""
        return next(
            f for f in self.system.getForces() if isinstance(f, openmm.CustomExternalForce) and "pull" in names(f)
        )

    @cached_property
    def molecules(self):
        """Atoms of each molecule; named bodies are parts of one."""
        return molecules_of(self.context, self.built.named)

    @property
    def is_periodic(self):
        return self.system.usesPeriodicBoundaryConditions()

    def view(self):
        return View(self.context)

    def everything(self):
        """All that a restart must repeat, and at last the counted heat."""
        tally = self.integrator.impl.tally
        atoms = phase_point(self.context), clock_and_box(self.context)
        return (*atoms[0], *atoms[1], tally.draws, tally.seed, *tally.counts.values(), self.integrator.countedHeat)

    def twin(self, settings=None):
        """Return a new run of the same mixture and method, with the same settings from the start."""
        return Run(self.mixture, self.method, self.name, self.settings if settings is None else settings, self.added)

    def at_same_view(self):
        """Return a new run that users cannot distinguish from this one, but for the random numbers to come."""
        other = self.twin()
        update_shares(other, [self.pull.getParticleParameters(k)[1] for k in range(self.pull.getNumParticles())])
        other.harden_bonds(self.hardness)
        self.view().show_in(other.context)
        return other

    def harden_bonds(self, factor):
        """Multiply the constants of harmonic bonds in the System and in the Context."""
        self.hardness *= factor
        for force in self.system.getForces():
            if isinstance(force, openmm.HarmonicBondForce):
                for k in range(force.getNumBonds()):
                    *bond, constant = force.getBondParameters(k)
                    force.setBondParameters(k, *bond, factor * constant)
                force.updateParametersInContext(self.context)

    def continued(self, system, integrator, settings, saved):
        """Return this run in a new Context of its System as it was, with another integrator and what was saved.

        The integrator has settings.
        """
        other = copy.copy(self)
        other.system = openmm.XmlSerializer.clone(system)
        vars(other).pop("pull", None)
        other.settings, other.saved = list(settings), list(saved)
        other.integrator, other.context = integrator, other.bind(integrator)
        return other

    def save(self, way):
        """Return a function that continues in a Context from here."""
        if way == "checkpoint":
            checkpoint = self.context.createCheckpoint()
            return lambda context: context.loadCheckpoint(checkpoint)
        state = full_state(self.context)
        if way == "XML":
            state = openmm.XmlSerializer.deserialize(openmm.XmlSerializer.serialize(state))
        return lambda context: context.setState(state)

    # --- motions that constraints and bodies allow ---

    @property
    def rigid(self):
        """Atoms with mass of each rigid body of several atoms."""
        bodies = self.integrator.bodies if self.method.engine != "native" else self.built.bodies
        return [] if bodies is None else rigid_atoms(self.system, bodies)

    def projected(self, view):
        """Return the velocities of atoms with mass that are nearest to those of a view, in kinetic energy."""
        basis, root = self._allowed(view), np.sqrt(self.masses)[:, None]
        weighted = (basis @ (basis.T @ (root * view.velocities).ravel())).reshape(-1, 3)
        return np.divide(weighted, root, out=np.zeros_like(weighted), where=root > 0)

    def freedoms(self, view):
        return self._allowed(view).shape[1]

    def _allowed(self, view):
        return allowed_motions(self.masses, view.positions, self.rigid, self.constraints[0])

    def kinetic_energy(self, view):
        return self.kinetic_energy_of(view.velocities)

    def kinetic_energy_of(self, velocities, without_centre=False):
        """Return the kinetic energy of velocities, perhaps without that of the centre of mass, kJ/mol."""
        centre = centre_of(self.masses, velocities) if without_centre else np.zeros(3)
        return 0.5 * float(np.sum(self.masses[:, None] * (velocities - centre) ** 2))

    def potential_energy(self):
        """Return the potential energy of the forces that move the atoms, by OpenMM in another Context, kJ/mol."""
        return self._elsewhere(self.view(), energy=True).getPotentialEnergy()._value

    def slope(self):
        """Return the root mean square of the forces along motions that constraints and bodies allow, kJ/mol/nm."""
        basis = np.linalg.qr(self._allowed(self.view()) * np.repeat(np.sqrt(self._inverse_masses), 3)[:, None])[0]
        return float(np.sqrt(np.mean((basis.T @ self.forces().ravel()) ** 2))) if basis.size else 0.0

    def forces(self):
        """Return the forces that move the atoms, by OpenMM in another Context, (N, 3), kJ/mol/nm."""
        return self._elsewhere(self.view(), forces=True).getForces(asNumpy=True)._value

    def _elsewhere(self, view, **asked):
        """Return what is asked of OpenMM at a view, in another Context, of the forces that move the atoms."""
        context = plain_context(self.system, view.positions, self.name)
        view.show_in(context)
        return context.getState(groups=self.integrator.getIntegrationForceGroups(), **asked)

    @cached_property
    def _inverse_masses(self):
        return np.divide(1.0, self.masses, out=np.zeros_like(self.masses), where=self.masses > 0)

    def assert_rigid(self, view, tolerance, moves=True):
        """Distances that constraints and bodies hold have their lengths, and velocities do not change them.

        Args:
            view: View of the Context.
            tolerance: relative, for positions; velocities may be wrong by ten times this and their largest.
            moves: whether velocities are looked at.
        """
        pairs = [(i, j, length) for (i, j), length in zip(*self.constraints, strict=True)]
        at_start = self.start
        for atoms in self.rigid:
            pairs += [(i, j, np.linalg.norm(at_start[i] - at_start[j])) for i, j in combinations(atoms, 2)]
        for i, j, length in pairs:
            along = view.positions[i] - view.positions[j]
            distance = np.linalg.norm(along)
            assert abs(distance - length) < tolerance * length, f"atoms {i} and {j}: {distance} nm in place of {length}"
            if not moves:
                continue
            growth = (view.velocities[i] - view.velocities[j]) @ along / distance
            largest = 1 + np.abs(view.velocities).max()
            assert abs(growth) < 10 * tolerance * largest, f"atoms {i} and {j} part with {growth} nm/ps"


def end(run, steps=2):
    """Make steps; return the error, if there is one."""
    try:
        run.integrator.step(steps)
    except REFUSALS as error:
        return f"{type(error).__name__}: {error}"
    return None


def assert_alike(one, two, positions=0.0, velocities=0.0):
    """Compare all of two runs: the same bits, or positions and velocities within tolerances in nm and nm/ps.

    The heat, a sum over all steps, may be added up in another order.
    """
    *these, heat = one
    *those, expected = two
    for k, (a, b) in enumerate(zip(these, those, strict=True)):
        name, tolerance = [("positions", positions), ("velocities", velocities), ("other numbers", velocities)][
            min(k, 2)
        ]
        difference = np.abs(np.subtract(a, b)).max()
        assert difference <= tolerance, f"{name} differ by {difference:.1e}"
    assert np.isclose(heat, expected, rtol=1e-9, atol=1e-6 + 1e3 * velocities, equal_nan=True), (
        f"heat {heat}, {expected}"
    )


def started(mixture, method, name="Reference", forces=()):
    """Return a run of a mixture with a method, or with the first of its alternatives that the System accepts.

    The example is rejected if no integrator accepts the mixture.
    """
    for alternative in method.alternatives():
        try:
            run = Run(mixture, alternative, name, forces=forces)
            run.integrator.step(0)
        except REFUSALS:
            continue
        return run
    return reject()


def names(force):
    """Names of the global parameters of a Force that has any."""
    count = getattr(force, "getNumGlobalParameters", lambda: 0)()
    return [force.getGlobalParameterName(k) for k in range(count)]


def update_shares(run, shares):
    """Give the atoms of `Run.pull` other parameters."""
    for k, share in enumerate(shares):
        run.pull.setParticleParameters(k, run.pull.getParticleParameters(k)[0], share)
    run.pull.updateParametersInContext(run.context)
