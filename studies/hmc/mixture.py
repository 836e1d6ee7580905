"""The bias of long steps that hybrid Monte Carlo removes: N-methylacetamide, flexible, mixed with water.

    python -m studies.hmc.mixture --method hmc --step 2 --time 60
    python -m studies.hmc.mixture --method langevin --step 4 --hydrogen-mass 1
    python -m studies.hmc.mixture --method langevin --step 4 --hydrogen-mass 3

Each command adds a run to those of `--out`, and the others are compared with the first. Bonds to hydrogen are
constrained; 1 bar; steps are in fs for each force evaluation. A hydrogen mass of 1 leaves masses as they are. Kinetic
energies are tested with `openmm_sier.analysis.validation`. Configurational temperatures are
kT = <|F|^2/M> / <-div F/M>, of water's translation and rotation and of the groups of atoms that constraints hold
together in the other molecules, the divergence from forces at places displaced at random. The last column is the
probability by a Kolmogorov-Smirnov test that independent potential energies of two methods are from one distribution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import openmm
import pandas as pd
from openmm import app, unit
from scipy.stats import ks_2samp

from openmm_sier import SIER4G, RigidBodies, SIERHMCIntegrator, prepare_system
from openmm_sier.analysis import validation
from openmm_sier.analysis.statistics import Estimate, jackknife, mean_and_error, pooled
from openmm_sier.dynamics.constants import GAS_CONSTANT
from openmm_sier.inputs.equilibration import make_context
from openmm_sier.observe.conservation import density
from openmm_sier.system.temperature import temperatures
from studies import records, text
from studies.command import RunsSettings, command
from studies.hmc.curvature import KINDS, Curvature
from studies.records import Record, Task
from studies.report import SILENT, Report
from studies.sampling import body_state
from studies.units import md
from systems import peptide

#: nm: the edge of the box that is filled with water, and the cut-off.
EDGE, CUTOFF = 2.0, 0.7

#: Amides along each edge, at most.
LATTICE = (2, 2, 3)

#: ps between two samples.
EVERY = 0.06

COLUMNS = text.columns("label", "time", "accepted", "potential", "density", "translation", "rotation") | {
    "T_amide": "{flexible_text}",
    "configurational: T_trans": "{conf_translation_text}",
    "T_rot": "{conf_rotation_text}",
    "T_amide ": "{conf_flexible_text}",
    "V: p": "{probability:.2g}",
}


@dataclass(frozen=True, kw_only=True)
class MixtureSettings(RunsSettings):
    """Choose what is run.

    Attributes:
        method: of the run.
        step: fs for each force evaluation.
        hydrogen_mass: of hydrogens outside water, dalton.
        friction: of LangevinMiddle, 1/ps.
        temperature: K.
        time: of the run, ps.
        settling: ps before it, after the equilibration at 2 fs, whose end is mixture.pdb of `--out`.
        platform: of OpenMM; None takes the fastest.
    """

    method: Literal["hmc", "langevin"] = "hmc"
    step: float = 2.0
    hydrogen_mass: float = 1.0
    friction: float = 20.0
    temperature: float = 298.15
    time: float = 60.0
    settling: float = 5.0
    platform: str | None = None

    SHARED: ClassVar[tuple[str, ...]] = ("friction", "temperature", "settling")

    @property
    def label(self) -> str:
        """The run in a few words."""
        method = "HMC, SIER4G" if self.method == "hmc" else "LangevinMiddle"
        return f"{method}, {self.step:g} fs, hydrogens of {self.hydrogen_mass:g}"


def study(settings: MixtureSettings, report: Report = SILENT) -> None:
    """Make a run if it is missing in the directory `out`, and write mixture.json."""
    task = Task(settings, {"label": settings.label, "seed": settings.seed, "time": settings.time})
    runs = records.all_runs(settings, "mixture", [task], run, report, "{label}, seed {seed}")
    rows, tests = table(runs), kinetic_tests(runs, settings.temperature)
    report.table("A mixture at 1 bar", text.table(rows, COLUMNS))
    report.table("Tests of kinetic energies, standard errors", text.table(tests, TESTS))
    Record(settings.recorded(), {"rows": rows, "tests": tests}, {}).write(settings.out / "mixture.json")


# --- runs ---


def built() -> app.Modeller:
    """Amides on a lattice, with water between them."""
    one = peptide.dry((), *peptide.TORSIONS)
    sites = np.array(one.positions.value_in_unit(unit.nanometer))
    sites -= sites.mean(axis=0)
    modeller = app.Modeller(app.Topology(), [] * unit.nanometer)
    for place in np.ndindex(*LATTICE):
        centre = EDGE * (np.array(place) + 0.5) / LATTICE
        modeller.add(one.topology, (sites + centre) * unit.nanometer)
    modeller.addSolvent(app.ForceField(*peptide.FORCE_FIELD), boxSize=openmm.Vec3(EDGE, EDGE, EDGE) * unit.nanometer)
    return modeller


def system_of(topology: app.Topology, hydrogen_mass: float) -> openmm.System:
    """The prepared System."""
    system = app.ForceField(*peptide.FORCE_FIELD).createSystem(
        topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=CUTOFF,
        switchDistance=CUTOFF - 0.15,
        ewaldErrorTolerance=1e-4,
        constraints=app.HBonds,
        hydrogenMass=None if hydrogen_mass < 1.5 else hydrogen_mass,
        removeCMMotion=False,
    )
    prepare_system(system)
    return system


def start(settings: MixtureSettings) -> app.PDBFile:
    """The start of all runs: a minimum, 4 ps of LangevinMiddle at 2 fs and 2 kbar, and 16 ps at 1 bar."""
    kept = settings.out / "mixture.pdb"
    if not kept.exists():
        modeller = built()
        system = system_of(modeller.topology, 1.0)
        system.addForce(openmm.MonteCarloBarostat(2000 * unit.bar, settings.temperature * unit.kelvin, 10))
        integrator = openmm.LangevinMiddleIntegrator(settings.temperature, 5.0, 0.002)
        integrator.setRandomNumberSeed(settings.seed)
        context = make_context(system, integrator, settings.platform)
        context.setPositions(modeller.positions)
        openmm.LocalEnergyMinimizer.minimize(context, 10, 200)
        context.setVelocitiesToTemperature(settings.temperature, settings.seed)
        integrator.step(2000)
        context.setParameter(openmm.MonteCarloBarostat.Pressure(), 1.0)
        integrator.step(8000)
        state = context.getState(positions=True)
        modeller.topology.setPeriodicBoxVectors(state.getPeriodicBoxVectors())
        peptide.write(kept, modeller.topology, state.getPositions())
    return app.PDBFile(str(kept))


def integrator_of(settings: MixtureSettings, system: openmm.System) -> tuple[openmm.Integrator, int]:
    """An integrator at 1 bar, and its number of steps from one sample to the next."""
    step = 1e-3 * settings.step
    if settings.method == "langevin":
        every = round(EVERY / step)
        system.addForce(openmm.MonteCarloBarostat(1 * unit.bar, settings.temperature * unit.kelvin, every))
        return openmm.LangevinMiddleIntegrator(settings.temperature, settings.friction, step), every
    step *= SIER4G.force_evaluations
    return SIERHMCIntegrator(settings.temperature, step, SIER4G, round(EVERY / step), pressure=1), 1


def run(task: Task) -> dict[str, Any]:
    """One run: its `samples` by their names, and what is known of its box."""
    settings = task.settings
    pdb = start(settings)
    system = system_of(pdb.topology, settings.hydrogen_mass)
    bodies = RigidBodies.from_system(system, pdb.topology)
    integrator, every = integrator_of(settings, system)
    integrator.setRandomNumberSeed(settings.seed)
    context = make_context(system, integrator, settings.platform)
    context.setPositions(pdb.positions)
    context.applyConstraints(1e-6)
    context.setVelocitiesToTemperature(settings.temperature, settings.seed)
    curvature = Curvature(system, bodies, settings.seed, settings.platform)
    integrator.step(round(settings.settling / EVERY) * every)
    is_hmc = isinstance(integrator, SIERHMCIntegrator)
    if is_hmc:
        integrator.resetStatistics()

    def sample() -> dict[str, float]:
        integrator.step(every)
        state = context.getState(positions=True, energy=True)
        found = temperatures(bodies, body_state(context, bodies), False)
        row = {"potential": md(state.getPotentialEnergy()), "kinetic": md(state.getKineticEnergy())}
        return row | {"volume": md(state.getPeriodicBoxVolume()), **found._asdict()} | curvature(state)

    samples = pd.DataFrame([sample() for _ in range(round(settings.time / EVERY))])
    return task.point | {
        "mass": float(bodies.masses.sum()),
        "atoms": system.getNumParticles(),
        "waters": sum(residue.name == "HOH" for residue in pdb.topology.residues()),
        "accepted": integrator.acceptanceRate if is_hmc else None,
        "samples": samples.to_dict("list"),
    }


# --- tables ---


def table(runs: pd.DataFrame) -> pd.DataFrame:
    """A row for each kind of run; runs that differ in their seeds alone are pooled."""
    rows, compared = [], None
    for label, several in runs.groupby("label", sort=False):
        row: dict[str, Any] = {"label": label, "accepted": several["accepted"].mean(), "time": several["time"].sum()}
        tables = [pd.DataFrame(samples) for samples in several["samples"]]
        series = {name: [samples[name].to_numpy() for samples in tables] for name in ("potential", *TEMPERATURES)}
        volumes = [samples["volume"].to_numpy() for samples in tables]
        series["density"] = [density(mass, each) for mass, each in zip(several["mass"], volumes, strict=True)]
        for name, values in series.items():
            row[name], row[f"{name}_error"], _ = pooled([mean_and_error(each) for each in values])
        for kind in KINDS:
            found = [configurational(samples, kind) for samples in tables]
            row[f"conf_{kind}"], row[f"conf_{kind}_error"], _ = pooled(found)
        independent = np.concatenate([validation.independent(values)[0] for values in series["potential"]])
        compared = independent if compared is None else compared
        row["probability"] = math.nan if compared is independent else ks_2samp(independent, compared).pvalue
        rows.append(row)
    return pd.DataFrame(rows)


TEMPERATURES = ("translation", "rotation", "flexible")


def configurational(samples: pd.DataFrame, kind: str) -> Estimate:
    """A configurational temperature in K and its standard error, a ratio of two means."""
    squares, divergences = samples[f"{kind}_square"].to_numpy(), samples[f"{kind}_divergence"].to_numpy()
    found = jackknife(lambda kept: squares[kept].mean() / divergences[kept].mean(), len(squares), groups=20)
    return found.times(1 / GAS_CONSTANT)


TESTS = text.columns("label", "group", "samples") | {
    "mean": "{mean:.1f}",
    "width": "{width:.1f}",
    "shape, p": "{shape:.2g}",
}


def kinetic_tests(runs: pd.DataFrame, temperature: float) -> pd.DataFrame:
    """physical_validation's tests: standard errors of mean and width, and the probability of Kolmogorov and Smirnov."""
    from physical_validation.kinetic_energy import distribution

    columns = {"kinetic": "Kinetic Energy (kJ/mole)"}
    columns |= dict(zip(TEMPERATURES, validation.GROUPS.values(), strict=True))
    options = {"data_is_uncorrelated": True, "bootstrap_seed": 5, "verbosity": 0}
    rows = []
    for label, several in runs.groupby("label", sort=False):
        logs = [pd.DataFrame(samples).rename(columns=columns) for samples in several["samples"]]
        for group, data in validation.kinetic_data(logs, temperature).items():
            mean, width = distribution(data, strict=False, **options)
            row = {"label": label, "group": group, "samples": len(data.observables.kinetic_energy)}
            rows.append(row | {"mean": mean, "width": width, "shape": distribution(data, strict=True, **options)})
    return pd.DataFrame(rows)


main = command(MixtureSettings, study, __doc__, __name__)
