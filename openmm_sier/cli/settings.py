"""The settings of commands, by one class for the command line, TOML files and checkpoints.

Each value is judged once, where it comes from: pydantic compares it with the range of its field. Where values of
several sources have been joined, `openmm_sier.cli.planning` refuses those that contradict each other.
"""

import os
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from pydantic import BaseModel, ConfigDict, Field

from openmm_sier.cli import defaults, fields
from openmm_sier.cli.defaults import RECOMMENDED, listed, motion_of
from openmm_sier.cli.fields import FILE, NAME, File, Name, Switch, one_of
from openmm_sier.cli.methods import ENSEMBLES, METHODS, THERMOSTATS, Method
from openmm_sier.dynamics.acceptance import TRIAL_LENGTH
from openmm_sier.inputs.forcefields import CONSTRAINTS, CUTOFF, EWALD_TOLERANCE, Interactions
from openmm_sier.inputs.pdb_files import LONGEST
from openmm_sier.prepare.masses import LIGHTEST_HYDROGEN
from openmm_sier.system.tables import HEAVIEST_HYDROGEN

#: Largest number of steps of a run, which doubles count exactly.
MOST_STEPS = 10**15

#: nm; the shortest and the longest edge of a box.
EDGES = 0.1, LONGEST


class InputSettings(BaseModel):
    """The molecules: settings of `openmm-sier info`. Times of all settings are in ps, but `dt` is in fs."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @property
    def chosen(self) -> dict[str, Any]:
        """The values that were given, by name. All others are defaults."""
        return {name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set}

    # Its default stands for coordinates that were not given.
    box: File = fields.setting(
        "coordinates of whole molecules with hydrogens: a PDB or PDBx/mmCIF file (virtual sites are added); or with "
        "--topology an inpcrd or rst7 file of AMBER, a gro file of GROMACS, a crd file of CHARMM, or a State of OpenMM "
        "in XML",
        FILE,
        Path("BOX"),
        otherwise="none; that of the checkpoint with `run --restart`",
        restart="may change",
        positional=True,
    )
    topology: File | None = fields.file(
        "what the coordinates belong to, with its force field: a prmtop file of AMBER, a top file of GROMACS, a psf "
        "file of CHARMM, or a System of OpenMM in XML",
        otherwise="none, for PDB and PDBx/mmCIF files with --forcefield",
        restart="may change",
    )
    forcefield: list[File] | None = fields.several(
        "force-field files, OpenMM's or your own; with a psf file all parameter, topology and stream files of CHARMM, "
        "that end in .prm or .par, .rtf or .top, .str, or .inp",
        FILE,
        otherwise="the file named in a record 'REMARK  99 FORCEFIELD file.xml' of the PDB file",
    )
    edges: list[Annotated[float, Field(ge=EDGES[0], le=EDGES[1])]] | None = fields.several(
        "edges of a rectangular periodic box in nm, for coordinates without one, as crd files are",
        fields.in_range(*EDGES, "nm"),
        3,
        otherwise="the box of the coordinates",
    )
    rigid: list[Name] | None = fields.several(
        "what to keep rigid besides water, with the geometry that it has in the coordinates (constrained bonds have "
        "the lengths of their constraints): names of residues; ranges of residues, such as A:1-36, one body each; "
        "chains, such as A: ; or selections of MDTraj, such as 'index 0 to 35'",
        NAME,
        otherwise="none",
    )
    constraints: Annotated[str, one_of(CONSTRAINTS)] | None = fields.choice(
        "constraints besides those of water: of bonds to hydrogen, of all bonds, or of bonds and angles of hydrogens",
        CONSTRAINTS,
        "hbonds",
    )


class SystemSettings(InputSettings):
    """The settings that define the System. A run with `--start` takes them from the other run by default."""

    cutoff: float | None = fields.number(
        *("where the direct sum of PME and Lennard-Jones end", "nm", 0.2, 10),
        otherwise=f"{CUTOFF:g}, less in a box that is too small for it",
    )
    switch: float | None = fields.number(
        *("where Lennard-Jones starts to be switched off, 0 for a jump at the cut-off", "nm", 0, 10),
        otherwise="five sixths of the cut-off",
    )
    tolerance: float | None = fields.number(
        "error tolerance of the sums of PME, which are balanced", "", 1e-10, 1e-3, EWALD_TOLERANCE
    )
    hydrogen_mass: float | None = fields.number(
        "mass of hydrogens, in water too, taken from the atoms that they are bonded to; it slows motion, not averages",
        *("dalton", LIGHTEST_HYDROGEN, HEAVIEST_HYDROGEN),
        otherwise="that of the force field",
    )


class TrialSettings(SystemSettings):
    """Settings of `openmm-sier tune`: for the System, its start and the begin of the search."""

    # A run may choose both.
    ensemble: Annotated[str, Parameter(parse=False)] = "hmc"
    thermostat: Annotated[str, Parameter(parse=False)] = "langevin"
    scheme: Annotated[str, one_of(METHODS)] = fields.choice(
        "scheme of this package, or for comparison one of OpenMM's own integrators: verlet, with an AndersenThermostat "
        "at constant temperature, or langevinmiddle; MonteCarloBarostat keeps their pressure",
        METHODS,
        follows=defaults.scheme,
        otherwise="sier4g; sier2 with nvt and npt by langevin, sier2v2 with hmc",
    )
    dt: float = fields.number(
        *("step", "fs", 0.05, 1e3),
        follows=defaults.step,
        otherwise="usual for the scheme: 4 for the default ones, 6 with hmc, 9 with heavy hydrogens by langevin or hmc",
    )
    friction: float = fields.number(
        *("of the heat bath, or the rate of rescaling, or that of collisions of verlet", "1/ps", 0, 1e5),
        follows=defaults.friction,
        otherwise="1, or 5 by langevin with heavy hydrogens; hmc draws all momenta anew where it is 0",
    )
    pressure: float | None = fields.number(
        *("with npt or hmc", "bar (1 bar is 100000 Pa)", -5000, 50000),
        follows=defaults.pressure,
        otherwise="1 with npt, constant volume with hmc",
    )
    steps_per_trial: int = fields.whole(
        "of the scheme in a trial of hmc, which is then a step of the run",
        most=10**6,
        follows=defaults.steps_per_trial,
        otherwise=f"as many as make {1000 * TRIAL_LENGTH:g} fs",
    )
    temperature: float = fields.number(
        *("of the start and of the heat bath", "K", 0, 3000, defaults.TEMPERATURE),
        otherwise=f"{defaults.TEMPERATURE:g}, or that of the run of --start",
    )
    equilibrate: float | None = fields.number(
        *("how long", "ps", 0, 1e9),
        otherwise="until temperatures and potential energy have settled, 3 to 20; not at all with --start",
        restart="of the call",
    )
    minimize: bool | None = fields.switch(
        "minimize the energy first",
        None,
        otherwise="if forces of the start are larger than in a liquid",
        restart="of the call",
    )
    seed: int = fields.whole("of velocities, equilibration and heat bath", 1)
    platform: Name | None = fields.setting(
        "of OpenMM",
        NAME,
        None,
        otherwise="the fastest; that of the checkpoint with --restart",
        restart="of the call",
    )
    start: File | None = fields.file(
        "checkpoint (.chk) of any run: the new run begins with its positions, velocities and box. The options that "
        "make the System, and --temperature, are those of that run unless you give them",
        otherwise="none",
        restart="of the call",
    )


class RunSettings(TrialSettings):
    """All settings of a run.

    Hybrid Monte Carlo is at constant volume if `pressure` is None, and draws all momenta independently if `friction` is
    0.
    """

    ensemble: Annotated[str, one_of(ENSEMBLES)] = fields.choice(
        f"what is constant ({listed(ENSEMBLES)})", ENSEMBLES, "nve", otherwise="nve; nvt for langevinmiddle"
    )
    thermostat: Annotated[str, one_of(THERMOSTATS)] = fields.choice(
        f"what keeps the temperature with nvt and npt ({listed(THERMOSTATS)})", THERMOSTATS, "langevin"
    )
    time: float | None = fields.time(
        "length of the whole trajectory; a restart does what is left of it",
        otherwise=f"{defaults.TIME:g}; that of the checkpoint with --restart",
        restart="of the call",
    )
    steps: int = fields.whole(
        "the same in steps", most=MOST_STEPS, follows=defaults.steps, otherwise="as --time says", restart="may change"
    )

    # --- outputs ---

    out: File = fields.file(
        "trajectory, .dcd",
        follows=defaults.out,
        otherwise="BOX.dcd, in the current directory",
    )
    unwrapped: Switch = fields.switch("frames have molecules where they went, not in the box", otherwise="in the box")
    report: File = fields.file(
        "log, a table in CSV",
        follows=defaults.report,
        otherwise="as the trajectory, with .csv",
    )
    every: float = fields.time("between frames", 0.1)
    report_every: float = fields.time("between rows of the log", 0.04)
    checkpoint_every: float = fields.time("between checkpoints", 1.0)
    pressure_tensor: File | None = fields.file(
        "write the molecular pressure tensor there in CSV, for viscosity", otherwise="it is not written"
    )
    # Sums over tensors mistake oscillations of the period of their interval, or a fraction of it, for slow ones; in
    # rigid water such oscillations have a thousandth of the power of the slow ones at 0.02 ps.
    pressure_tensor_every: float = fields.time("between rows of it, each of which costs 12 energies", 0.02)
    plot: File | None = fields.file(
        "draw the log at the end, as `summary --plot` does, in PNG or SVG",
        otherwise="no picture",
        restart="of the call",
    )

    # --- restarts ---

    restart: File | None = fields.file("checkpoint (.chk) to continue from", otherwise="none", restart="of the call")
    resume: Switch = fields.switch(
        "continue from the checkpoint beside --out if there is one, begin a new run if there is none, and succeed if "
        "the run is complete: one command line for a job that may be killed",
        otherwise="begin",
        restart="of the call",
    )
    overwrite: Switch = fields.switch(
        "replace files of an earlier run, or with --restart cut back a longer one",
        otherwise="refuse to",
        restart="of the call",
    )

    # --- properties that follow from the settings ---

    @property
    def equilibrates(self) -> bool:
        """Whether a new run begins with an equilibration; from a checkpoint, only if the user chose one."""
        return self.start is None or bool(self.equilibrate or self.minimize)

    @property
    def moves_volume(self) -> bool:
        """Whether the pressure is constant."""
        return self.ensemble in ("npt", "hmc") and self.pressure is not None

    @property
    def method(self) -> Method:
        """Method that moves the molecules."""
        return METHODS[self.scheme]

    @property
    def rescales(self) -> bool:
        """Whether a factor on all velocities keeps the temperature."""
        return self.ensemble in ("nvt", "npt") and self.thermostat == "rescaling"

    @property
    def usual_step(self) -> float:
        """Usual step of the method, fs."""
        return self.method.usual_step(motion_of(self.ensemble, self.thermostat), self.hydrogen_mass)

    @property
    def stand_in(self) -> "RunSettings":
        """Settings for the equilibration: these, with a method of this package."""
        if self.method.scheme:
            return self
        scheme = RECOMMENDED[self.ensemble]
        usual = METHODS[scheme].usual_step(self.ensemble, self.hydrogen_mass)
        return self.model_copy(update={"scheme": scheme, "dt": usual})

    @property
    def interactions(self) -> Interactions:
        """Settings of the interactions' cut-off."""
        return Interactions(self.cutoff, self.switch, self.tolerance, self.hydrogen_mass)

    @property
    def title(self) -> str:
        """Method, ensemble, the mass of hydrogens if it was chosen, and step."""
        bath = f", {self.temperature:g} K" if self.ensemble != "nve" else ""
        if self.rescales:
            bath = f" by rescaling{bath}"
        piston = f", {self.pressure:g} bar" if self.moves_volume else ""
        hydrogens = f", hydrogens of {self.hydrogen_mass:g}" if self.hydrogen_mass else ""
        return f"{self.method.name}, {self.ensemble.upper()}{bath}{piston}{hydrogens}, {self.dt:g} fs"

    @property
    def step_time(self) -> float:
        """Time of a step, ps; a step of hybrid Monte Carlo is a trial."""
        return self.dt / 1000 * self.steps_per_trial

    def interval(self, time: float) -> int:
        """Return the number of steps nearest to a time, at least 1."""
        return max(1, round(time / self.step_time))

    def length(self, steps: int) -> str:
        """Describe a number of steps and their time."""
        return f"{steps} ({steps * self.step_time:g} ps)"

    def noted(self, checkpoint: Path) -> dict[str, Any]:
        """Return the settings in a checkpoint as JSON, with files relative to the checkpoint."""
        here = os.path.dirname(checkpoint) or "."
        values = self.model_dump(mode="json", include=set(NOTED))
        return values | {name: os.path.relpath(values[name], here) for name in FILES if values[name]}


def checkpoint_of(trajectory: Path) -> Path:
    """Return the checkpoint of a run with this trajectory."""
    return trajectory.with_suffix(".chk")


#: Details of all settings by name, in the order of `--help`, see `fields.setting`.
SETTINGS = {name: fields.details_of(field) for name, field in RunSettings.model_fields.items()}

#: Settings that a restart keeps, and all settings in a checkpoint.
CONTINUED = tuple(name for name, details in SETTINGS.items() if details["restart"] == "keeps")
NOTED = tuple(name for name, details in SETTINGS.items() if details["restart"] != "of the call")

#: Settings that name one file each. In a checkpoint they are relative to it.
FILES = tuple(name for name in NOTED if SETTINGS[name]["expected"] == FILE)

#: Settings that define the System of given molecules.
OF_THE_SYSTEM = tuple(name for name in SystemSettings.model_fields if name != "box")
