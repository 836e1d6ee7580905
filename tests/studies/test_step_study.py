"""The table and the figure of properties against the step."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openmm_sier.measure.properties import Estimate
from studies import step_study
from studies.step_study import StepRow


def row(method, h, forces=1, box="spce-512", **found):
    return StepRow(box, method, forces * h, h, 2, 180.0, {key: Estimate(*pair) for key, pair in found.items()})


ROWS = [
    row("SIER4G", 2.0, 3, rotation=(296.8, 0.4), density=(0.998, 0.002), diffusion=(2.5, 0.1)),
    row("OpenMM Verlet", 4.0, density=(0.98, 0.001), energy=(-46.0, math.nan)),
    row("OpenMM Verlet", 1.0, density=(0.99, 0.001)),
    row("SIER4G HMC", 2.0, 3, density=(1.0, 0.003)),
    row("SIER4G", 2.0, 3, box="tip3p-512", density=(0.985, 0.002)),
]


def test_the_table_is_by_box_method_and_step():
    lines = step_study.markdown(ROWS).splitlines()
    assert len(lines) == 2 + len(ROWS)
    assert lines[0].count("|") == lines[1].count("|") == lines[2].count("|")
    found = "- | 296.80 ± 0.40 | 0.9980 ± 0.0020 | - | - | 2.50 ± 0.10"
    assert lines[2] == f"| spce-512 | SIER4G | 6 | 2 | 2 | 180 | {found} |"
    assert [line.split(" | ")[1:4] for line in lines[3:5]] == [["OpenMM Verlet", str(h), str(h)] for h in (1, 4)]
    assert lines[-1].startswith("| tip3p-512")


def test_errors_are_shared_by_rows_of_one_box_and_method():
    long = row("SIER2", 4.0, density=(1.0, 0.002), energy=(-46.0, math.nan))._replace(time=90.0)
    short = row("SIER2", 1.0, density=(0.99, 0.001), energy=(-47.0, math.nan))._replace(time=10.0)
    other = row("SIER4G", 1.0, 3, density=(0.99, 0.007))
    found = step_study.with_shared_errors([long, short, other])
    # (90^2 0.002^2 + 10^2 0.001^2)/100 is the square of the error of 1 ps.
    factor = math.sqrt(0.000325)
    assert [r.found["density"].value for r in found] == [1.0, 0.99, 0.99]
    assert [r.found["density"].error for r in found] == pytest.approx([factor / 90**0.5, factor / 10**0.5, 0.007])
    # An error that no row has stays unknown.
    assert all(math.isnan(r.found["energy"].error) for r in found[:2])


def test_the_figure_has_every_point_and_its_error():
    figure = pytest.importorskip("matplotlib.figure").Figure()
    axes = figure.subplots()
    step_study._draw(axes, step_study.in_order(ROWS[:4]), "density")
    drawn = {container.get_label(): container for container in axes.containers}
    assert list(drawn) == ["SIER4G", "OpenMM Verlet", "SIER4G HMC"]
    x, y = drawn["OpenMM Verlet"].lines[0].get_data()
    # Methods are set apart by some hundredths of a fs.
    assert np.abs(np.array(x) - [1, 4]).max() < 0.1
    assert list(y) == [0.99, 0.98]
    (segment,) = drawn["SIER4G"].lines[2][0].get_segments()
    assert segment[:, 1] == pytest.approx([0.996, 1.0])
    # A sampler has the colour of its scheme, and no diffusion.
    assert drawn["SIER4G HMC"].lines[0].get_color() == drawn["SIER4G"].lines[0].get_color()
    other = figure.subplots()
    step_study._draw(other, ROWS[:4], "diffusion")
    assert [container.get_label() for container in other.containers] == ["SIER4G"]


def test_the_figure_is_written(tmp_path):
    pytest.importorskip("matplotlib")
    step_study.step_figure(ROWS, "Water", tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
