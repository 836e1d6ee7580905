"""One look for every method in every figure."""

import pandas as pd
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from studies import figures, methods, records, schemes, style

COMPARED = {method.name for method in (*schemes.KNOWN.values(), *methods.PAPER, *methods.REVERSIBLE.values())}
COMPARED |= {method.name for method in methods.with_bath(300, 1, 1).values()}


@pytest.mark.parametrize("name", sorted(COMPARED))
def test_every_method_that_can_be_compared_has_a_look(name):
    assert style.of_method(name)["color"] != style.UNKNOWN[0]


def test_methods_of_the_figure_of_costs_have_a_look():
    # Peers among them, which may not be installed here.
    drawn = pd.concat(records.read(figures.DATA / "cost.json").tables.values())["method"].dropna()
    assert any("LAMMPS" in name for name in drawn)
    assert any("GROMACS" in name for name in drawn)
    assert set(drawn) <= set(style.METHODS)


def test_no_two_methods_look_alike():
    looks = [tuple(style.of_method(name)[key] for key in ("color", "marker")) for name in style.METHODS]
    assert len(set(looks)) == len(looks)
    colours = [to_rgb(colour) for colour, _ in style.METHODS.values()]
    assert len(set(colours)) == len(colours)


def test_a_heat_bath_does_not_change_the_look():
    assert style.of_method("SIER4G Langevin") == style.of_method("SIER4G")
    assert style.of_method("SIER4G")["ls"] == "-"
    assert style.of_method("OpenMM LangevinMiddle")["ls"] == "--"
    assert style.of_method("SIER4G HMC")["color"] == style.of_method("SIER4G")["color"]


def test_curves_have_every_point_and_its_error():
    rows = pd.DataFrame(
        [("SIER2", 2.0, 0.98, 0.01), ("SIER4G", 2.0, 0.998, 0.002), ("SIER2", 1.0, 0.99, float("nan"))],
        columns=["method", "h", "density", "density_error"],
    )
    axes = Figure().subplots()
    style.curves(axes, pd.concat([rows, rows.assign(method="SIER4", density=float("nan"))]), "h", "density", apart=0.1)
    drawn = {container.get_label(): container for container in axes.containers}
    assert list(drawn) == ["SIER2", "SIER4G"]
    x, y = drawn["SIER2"].lines[0].get_data()
    assert (list(x), list(y)) == ([0.9, 1.9], [0.99, 0.98])
    x, _ = drawn["SIER4G"].lines[0].get_data()
    assert list(x) == [2.0]
    (segment,) = drawn["SIER4G"].lines[2][0].get_segments()
    assert segment[:, 1] == pytest.approx([0.996, 1.0])
