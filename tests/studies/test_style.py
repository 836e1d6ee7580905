"""One look for every method in every figure."""

import pandas as pd

from studies import figures, methods, records, style

COMPARED = {method.name for method in (*methods.CONSTANT_ENERGY.values(), *methods.PAPER, *methods.REVERSIBLE.values())}
COMPARED |= {method.name for method in methods.with_bath(methods.Bath(300, 1), 1).values()}


def test_every_method_that_can_be_compared_has_a_look():
    assert [name for name in sorted(COMPARED) if style.of_method(name)["color"] == style.UNKNOWN[0]] == []


def test_methods_of_the_figure_of_costs_have_a_look():
    # Peers among them, which may not be installed here.
    drawn = pd.concat(records.read(figures.DATA / "cost.json").tables.values())["method"].dropna()
    assert any("LAMMPS" in name for name in drawn)
    assert any("GROMACS" in name for name in drawn)
    assert set(drawn) <= set(style.METHODS)
