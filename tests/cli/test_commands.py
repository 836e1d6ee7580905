"""`run` beyond constant energy."""

from contextlib import nullcontext
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from openmm_sier import SIER2, SIER4G, SIERIntegrator, SIERLangevinIntegrator, balance_pme, ensembles
from openmm_sier.cli.files import checkpoints
from openmm_sier.cli.methods import ENSEMBLES, THERMOSTATS
from openmm_sier.cli.new_run import NewRun
from openmm_sier.cli.settings import RunSettings
from openmm_sier.cli.simulated_system import SimulatedSystem
from openmm_sier.dynamics.barostat import MonteCarloVolumeMove
from openmm_sier.dynamics.schemes import CATALOGUE
from openmm_sier.prepare.pme import meshed_forces
from openmm_sier.system.inner_forces import pme_parameters
from tests.support.commands import SMALL, complaint, log, run
from tests.support.matrices import representatives

PARTS = {
    "NVT": ["--ensemble", "nvt", "--dt", "2", "--friction", "5"],
    "NPT": ["--ensemble", "npt", "--dt", "2", "--pressure", "-500", "--pressure-tensor", "{}-p.csv"],
    "rescaling": ["--ensemble", "nvt", "--thermostat", "rescaling", "--dt", "2", "--friction", "5"],
    "HMC": ["--ensemble", "hmc", "--pressure", "1", "--steps-per-trial", "4"],
    # Volume moves are tried every 25 steps: one before the interruption, one after it. Those of OpenMM may be rejected.
    "LangevinMiddle": ["--scheme", "langevinmiddle", "--ensemble", "npt", "--dt", "2", "--pressure-tensor", "{}-p.csv"],
    "Verlet": ["--scheme", "verlet", "--ensemble", "npt", "--dt", "2"],
}


@pytest.mark.parametrize("name", representatives(PARTS, "NPT", "HMC"))
def test_a_run_in_parts_is_the_same_to_the_bit(box, name, capsys, monkeypatch):
    """All its files; records of a killed run after its checkpoint are cut off."""
    monkeypatch.setattr(MonteCarloVolumeMove, "is_accepted", lambda *_: True)
    for out, time in (("whole", "0.12"), ("parts", "0.06")):
        options = [option.format(out) for option in PARTS[name]]
        every = ["--report-every", "0.02", "--checkpoint-every", "0.06", "--pressure-tensor-every", "0.02"]
        has_tensors = "--pressure-tensor" in options
        chosen = [*SMALL, "--seed", "3", *options, *(every if has_tensors else every[:-2])]
        run("run", box, *chosen, "--time", time, "--out", f"{out}.dcd")
    with open("parts.csv", "a") as file:
        file.write("3,0.012,")
    run("run", box, "--restart", "parts.chk", "--time", "0.12", "--platform", "Reference")
    for kind in (".dcd", ".csv", *(["-p.csv"] if has_tensors else [])):
        assert Path(f"whole{kind}").read_bytes() == Path(f"parts{kind}").read_bytes()
    whole = log("whole.csv")
    if name in ("NVT", "rescaling"):
        # The bath exchanges some tens of kJ/mol, of which the conserved quantity knows.
        assert (np.diff(whole["Total Energy (kJ/mole)"] - whole["Conserved Energy (kJ/mole)"]) != 0).all()
        assert np.ptp(whole["Conserved Energy (kJ/mole)"]) < 3
    elif name == "HMC":
        # A step is a trial of 16 fs: 0.12 ps are the nearest to eight, and 0.02 to one.
        assert whole["Step"].tolist() == list(range(9))
        assert whole["Time (ps)"] == pytest.approx(0.016 * whole["Step"], rel=1e-12)
        assert 8 * whole["Acceptance"][-1] in range(9)
        assert np.isfinite(whole["Energy Error (kT)"][1:]).all()
        assert "trials accepted" in capsys.readouterr().out
    elif name == "NPT":
        assert len(np.unique(whole["Box Volume (nm^3)"])) == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--friction", "1"], "--friction needs --ensemble nvt, npt or hmc"),
        (["--ensemble", "nvt", "--pressure", "1"], "--pressure needs --ensemble npt or hmc"),
        (["--ensemble", "nvt", "--steps-per-trial", "5"], "--steps-per-trial needs --ensemble hmc"),
        (["--thermostat", "rescaling"], "--thermostat needs --ensemble nvt or npt, and a scheme of this package"),
        (["--ensemble", "hmc", "--thermostat", "rescaling"], "--thermostat needs --ensemble nvt or npt"),
        (["--scheme", "langevinmiddle", "--thermostat", "langevin"], "--thermostat needs --ensemble nvt or npt"),
    ],
)
def test_options_of_another_ensemble(capsys, box, arguments, message):
    assert message in complaint(capsys, "run", str(box), *arguments, code=2)


@pytest.mark.parametrize(
    ("options", "integrator", "step"),
    [
        ([], SIERIntegrator(0.001), SIER4G.constant_energy_step),
        (["--ensemble", "nvt"], SIERLangevinIntegrator(300, 1, 0.001), SIER2.bath_step),
        (["--ensemble", "nvt", "--hydrogen-mass", "4"], SIERLangevinIntegrator(300, 1, 0.001), SIER2.heavy_bath_step),
        (["--ensemble", "npt", "--thermostat", "rescaling"], SIERIntegrator(0.001), SIER4G.constant_energy_step),
    ],
)
def test_schemes_and_steps_are_the_usual_ones(box, options, integrator, step):
    run("run", box, "--platform", "Reference", "--equilibrate", "0", "--steps", "1", *options)
    plan = checkpoints.read_checkpoint(Path("box.chk"))[1].plan
    assert CATALOGUE[plan["scheme"]] == integrator.scheme.without_bath()
    assert plan["dt"] == pytest.approx(1000 * step)
    assert plan["friction"] == (5 if "--hydrogen-mass" in options else 1)


def test_the_command_has_all_ensembles_that_scripts_have(box):
    """In one list of ensembles and thermostats, with the same temperature and pressure."""
    results = set()
    for ensemble, thermostat in product(ENSEMBLES, THERMOSTATS):
        options = {"box": box, "ensemble": ensemble}
        if ensemble in ("nvt", "npt"):
            options["thermostat"] = thermostat
        beginning = NewRun(RunSettings(**options))
        integrator = SimulatedSystem(beginning.settings, beginning.sources).integrator(beginning.settings)
        results.add(type(integrator.impl.ensemble))
        if ensemble != "nve":
            assert integrator.impl.ensemble.temperature == 297
            assert integrator.impl.ensemble.pressure == (1 if ensemble == "npt" else None)
    assert results == set(ensembles.ENSEMBLES.values())


@pytest.mark.parametrize("ensemble", ["nve", "nvt"])
def test_pme_with_heavy_hydrogens_is_balanced_for_a_bath_if_there_is_one(box, ensemble):
    of_motion = pytest.warns(UserWarning, match="motion is slower") if ensemble == "nve" else nullcontext()
    with of_motion:
        beginning = NewRun(RunSettings(box=box, ensemble=ensemble, hydrogen_mass=4.0))
    system = SimulatedSystem(beginning.settings, beginning.sources).box.system
    (pme,) = meshed_forces(system)
    balanced = pme_parameters(pme)
    balance_pme(system, constantEnergy=ensemble == "nve")
    assert balanced == pme_parameters(pme)
