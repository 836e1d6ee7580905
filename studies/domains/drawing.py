"""The figure of the study: a chain with its domains, and averages against speed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from studies import style
from studies.domains.models import Model
from studies.records import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: The model that is drawn, and what is in the names of methods whose averages are exact, and of those with springs.
CHAIN, EXACT, SPRINGS = "chain", "HMC", "springs"


def picture(model: Model, positions: np.ndarray) -> dict[str, Any]:
    """Data of a picture of chains: positions of each chain's atoms in nm, and the number of each atom's body."""
    owners = np.full(len(positions), -1)
    for number, body in enumerate(model.bodies):
        owners[list(body)] = number
    chains = [list(chain) for chain in model.chains]
    return {"chains": [positions[chain].round(2) for chain in chains], "owners": [owners[chain] for chain in chains]}


def figure(record: Record, path: Path) -> None:
    """Chains, and the energy of their bonds against speed."""
    rows = record.tables["averages"]
    rows = rows[rows["key"] == CHAIN]
    with style.figure(path, 2) as (_, (seen, against)):
        if CHAIN in record.notes["pictures"]:
            draw(seen, record.notes["pictures"][CHAIN])
        for springs in (False, True):
            exact = rows[rows["method"].str.contains(EXACT) & (rows["method"].str.contains(SPRINGS) == springs)]
            of_kind = rows[~rows["method"].str.contains(EXACT) & (rows["method"].str.contains(SPRINGS) == springs)]
            of_kind = of_kind.dropna(subset=["ns_a_day"])
            if len(exact) and len(of_kind):
                off = of_kind.assign(off=of_kind["bonds"] - exact["bonds"].iloc[0], off_error=of_kind["bonds_error"])
                style.curves(against, off, "ns_a_day", "off")
                for row in off.to_dict("records"):
                    place = row["ns_a_day"], row["off"]
                    against.annotate(f"{row['step']:g}", place, (5, 4), textcoords="offset points", fontsize=9)
        against.axhline(0, color=style.GREY, lw=1)
        against.set(xlabel="ns a day on one thread", ylabel="energy of bonds, less the exact one (kJ/mol)")
        against.set_title("Averages against speed, by steps in fs")
        if against.get_legend_handles_labels()[0]:
            against.legend(fontsize=9)


def draw(axes: Axes, picture: dict[str, Any]) -> None:
    """Chains seen from one side: linkers as lines, a colour for each domain, the nearest on top."""
    import matplotlib as mpl

    colours = mpl.colormaps["tab10"]
    for chain, owners in zip(picture["chains"], picture["owners"], strict=True):
        places, owner = np.array(chain), np.array(owners)
        axes.plot(places[:, 0], places[:, 2], color="0.4", lw=1.2, zorder=1)
        order = np.argsort(places[:, 1])
        shades = [colours(number % 10) if number >= 0 else (0.75, 0.75, 0.75, 1.0) for number in owner[order]]
        sizes = np.where(owner[order] >= 0, 90, 30)
        axes.scatter(places[order, 0], places[order, 2], s=sizes, c=shades, edgecolors="0.25", linewidths=0.4, zorder=2)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title("Two chains of 120 residues with two rigid domains each")
