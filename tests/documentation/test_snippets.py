"""The code that README, guides and how-tos show runs as it stands, but for the lengths of runs."""

import ast
import json
import re
import sys
import textwrap
import types
from pathlib import Path

import mdtraj
import numpy as np
import openmm
import pytest
from openmm import app

from openmm_sier.integrators import tuning
from openmm_sier.observe.pressure import COLUMNS
from tests.support.matrices import representatives
from tests.support.series import stresses
from tests.support.systems import assembled
from tests.support.waters import platform

ROOT = Path(__file__).parent.parent.parent
GUIDES = ["README.md", *(f"docs/guide/{name}.md" for name in ("getting-started", "restarts", "engines"))]
PAGES = [*GUIDES, *sorted(str(p.relative_to(ROOT)) for p in ROOT.glob("docs/guide/howto/*.md"))]

#: Steps and turns of loops that are made instead of more. With hybrid Monte Carlo a step is a trial of several.
FEWER = 5

#: What is shorter besides.
SHORTER = {
    "time=2)": "time=0.05)",
    "lengths=[4, 8]": "lengths=[4]",
    "stepsPerTrial=20": "stepsPerTrial=2",
    "inside.sum() >= 10": "inside.any()",
}


def code(page):
    """The Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)


def shortened(block):
    """A block of code with fewer steps."""
    lengths = re.compile(r"(\.step\(|\bfor _ in range\((?=\d+\):\n +simulation\.step\())(\d+)\)")
    block = lengths.sub(lambda found: f"{found[1]}{min(int(found[2]), FEWER)})", block)
    for long, short in SHORTER.items():
        block = block.replace(long, short)
    return block


class Calls(ast.NodeTransformer):
    """Let `called` make the calls whose result a statement throws away."""

    def visit_Expr(self, node):
        call = node.value
        if isinstance(call, ast.Call):
            arguments = [ast.Constant(ast.unparse(call)), call.func, *call.args]
            node.value = ast.Call(ast.Name("called", ast.Load()), arguments, call.keywords)
        return ast.fix_missing_locations(node)


def called(text, function, *arguments, **named):
    """Call a function; one of this package that returns something must also have changed what it was given."""
    things = [*arguments, *named.values()]
    of_package = str(getattr(function, "__module__", "")).startswith("openmm_sier")
    before = list(map(contents, things)) if of_package else []
    result = function(*arguments, **named)
    if of_package and result is not None:
        assert list(map(contents, things)) != before, f"the result of {text} is thrown away"
    return result


def contents(thing):
    """What a call can change in a System or a Context."""
    if isinstance(thing, openmm.System):
        return openmm.XmlSerializer.serialize(thing)
    if not isinstance(thing, openmm.Context):
        return None
    state = thing.getState(positions=True, velocities=True)
    vectors = [state.getPositions(asNumpy=True), state.getVelocities(asNumpy=True), state.getPeriodicBoxVectors(True)]
    return [vector._value.tolist() for vector in vectors]


def run(block, page, names):
    """Execute a block of code."""
    names["called"] = called
    exec(compile(Calls().visit(ast.parse(block, page)), page, "exec"), names)


def test_a_call_in_vain_is_found():
    """One of a function of this package that leaves its Context as it was, in place of one that changes it."""

    def copied(context):
        return context.getState()

    def displaced(context):
        context.setPositions([[1, 0, 0]])
        return context.getState()

    copied.__module__ = displaced.__module__ = "openmm_sier.inputs.equilibration"
    context = openmm.Context(assembled([1.0]), openmm.VerletIntegrator(0.001), platform())
    context.setPositions([[0, 0, 0]])
    names = {"context": context, "copied": copied, "displaced": displaced}
    for block in ("state = copied(context)", "print(copied(context))", "displaced(context)"):
        run(block, "page", names)
    with pytest.raises(AssertionError, match=r"copied\(context\)"):
        run("for _ in range(2):\n    copied(context)", "page", names)


@pytest.fixture
def short_runs(monkeypatch):
    """The CPU platform has one thread; nothing is minimized, which takes OpenMM most of the time, and hardly tuned.

    When a page sets the variable for the number of threads, OpenMM has been imported.
    """
    cpu = platform("CPU")
    usual = cpu.getPropertyDefaultValue("Threads")
    cpu.setPropertyDefaultValue("Threads", "1")
    monkeypatch.setattr(app.Simulation, "minimizeEnergy", lambda self, tolerance=10, maxIterations=0: None)
    monkeypatch.setattr(tuning, "ATTEMPTS", 1)
    yield
    cpu.setPropertyDefaultValue("Threads", usual)


@pytest.mark.usefixtures("short_runs")
@pytest.mark.parametrize(
    "page", representatives([page for page in PAGES if code(page)], "README.md", "docs/guide/getting-started.md")
)
def test_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "systems").symlink_to(ROOT / "systems")
    names = {"__name__": "__main__"}
    for block in code(page):
        for module in ("physical_validation", "openmmtools"):
            if f"from {module} import" in block or f"import {module}" in block:  # the last block of its page
                pytest.importorskip(module, reason="install the extra validation")
        run(shortened(block), page, names)


@pytest.mark.thorough
@pytest.mark.usefixtures("short_runs")
def test_code_of_the_notebook_of_exact_averages_runs(monkeypatch):
    """With five trials of two steps, and all bins of the dihedral that have a frame."""
    monkeypatch.chdir(ROOT / "docs" / "notebooks")
    pytest.importorskip("matplotlib").use("Agg")
    cells = json.loads(Path("exact-averages.ipynb").read_text())["cells"]
    blocks = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names = {"__name__": "__main__"}
    for block in blocks:
        run(shortened(block), "exact-averages.ipynb", names)
    assert names["integrator"].trials == FEWER
    assert np.isfinite(names["free"]).any()


@pytest.mark.thorough
@pytest.mark.usefixtures("short_runs")
@pytest.mark.parametrize("of", ["systems of this project", "openmmtools"])
def test_code_of_the_gallery_runs(of, monkeypatch):
    """With a few steps, and without pictures; the protein is the one section that needs openmmtools."""
    monkeypatch.chdir(ROOT / "docs" / "notebooks")
    pictures = types.ModuleType("pictures")
    shown = []
    pictures.panel = lambda simulation, title, steps=0: (simulation.step(FEWER), shown.append(title))
    monkeypatch.setitem(sys.modules, "pictures", pictures)
    cells = json.loads(Path("gallery.ipynb").read_text())["cells"]
    first, *sections = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    needs = [section for section in sections if "openmmtools" in section]
    if of == "openmmtools":
        pytest.importorskip("openmmtools", reason="install the extra validation")
    names = {"__name__": "__main__"}
    for section in (first, *(needs if of == "openmmtools" else [one for one in sections if one not in needs])):
        run(shortened(section), "gallery.ipynb", names)
    assert len(shown) == (1 if of == "openmmtools" else 6)


@pytest.mark.thorough
def test_lines_of_the_page_of_viscosity_read_what_runs_write(tmp_path, monkeypatch, capsys):
    """Six runs of 20 ps with stresses of 500 bar, whose molecules walk 0.01 nm in each direction in 0.1 ps."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "systems").symlink_to(ROOT / "systems")
    rng, topology = np.random.default_rng(1), mdtraj.load("systems/spce-512.pdb").topology
    for seed in range(1, 7):
        n = 1000
        columns = [5 * np.arange(n), 0.02 * np.arange(1, n + 1), *500 * stresses(rng, n, 0.9).T, np.full(n, 15.36)]
        np.savetxt(
            f"pressure-seed{seed}.csv", np.transpose(columns), delimiter=",", header=",".join(COLUMNS), comments=""
        )
        Path(f"spce-seed{seed}.csv").write_text("Step,Temperature (K)\n0,296\n5,298\n")
        walk = rng.normal(scale=0.01, size=(200, 512, 3)).cumsum(axis=0)
        frames = mdtraj.Trajectory(np.mod(np.repeat(walk, 3, axis=1), 2.4856), topology)
        frames.unitcell_lengths, frames.unitcell_angles = np.full((200, 3), 2.4856), np.full((200, 3), 90.0)
        frames.save_dcd(f"spce-seed{seed}.dcd")
    text = (ROOT / "docs" / "guide" / "howto" / "viscosity.md").read_text()
    blocks = re.findall(r"(?:^(?:    .*)?\n)+", text, re.MULTILINE)
    names = {}
    for block in [block for block in blocks if block.lstrip().startswith("import")]:
        run(textwrap.dedent(block), "viscosity.md", names)
    # V/kT <P²> times the sum of the correlation: 297 K, 0.02 ps (0.5 + 0.9/0.1), in mPa s.
    expected = 15.36e-27 / (1.380649e-23 * 297) * 5e7**2 * 0.02e-12 * 9.5 * 1e3
    # Means of six have wide tails: within 6 errors with a probability of 0.998.
    assert names["viscosity"].value == pytest.approx(expected, abs=6 * names["viscosity"].error)
    # 10⁻⁹ m²/s.
    assert names["diffusion"].value == pytest.approx(1e3 * 0.01**2 / 0.2, abs=6 * names["diffusion"].error)
    assert re.search(r"mPa s\n.* 1e-9 m2/s in this box\n.* 1e-9 m2/s\n", capsys.readouterr().out)


def test_pages_with_code_are_found():
    """README, the guides and all how-tos, so that a changed layout cannot leave them out."""
    without = [page for page in PAGES if not code(page) and "literalinclude" not in (ROOT / page).read_text()]
    assert without == ["docs/guide/howto/index.md"]
