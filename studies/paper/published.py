"""Numbers of van Zon and Schofield (2007), Phys. Rev. E 75, 056701, and the format of comparisons with ours."""

from __future__ import annotations

import math

#: ps in one fs.
FS = 1e-3

#: Sec. IV A: tau in ps for (method, step in fs). SIER4 is said to be similar to SIER2.
TAU = {
    ("MRDL", 1.66): 117.0,
    ("MRDL", 8.0): 7.6,
    ("SEJ4", 1.66): 0.91e6,
    ("SEJ4", 8.0): 2.1e3,
    ("SIER2", 1.66): 16e9,
    ("SIER2", 8.0): 48e9,
}

#: Table 1: rms(H)/rms(V) in per cent for (method, h/f in fs). The error of SIER2 at 11 fs is printed as 0.4; for SEJ4,
#: with the same value, it is 0.04.
ENERGY = {
    ("MRDL", 4.2): (1.8, 0.3),
    ("MRDL", 11.0): (11.4, 1.6),
    ("MRDL", 21.0): (51.0, 7.0),
    ("SEJ4", 4.2): (0.088, 0.006),
    ("SEJ4", 11.0): (0.55, 0.04),
    ("SEJ4", 21.0): (2.24, 0.16),
    ("SIER2", 4.2): (0.088, 0.006),
    ("SIER2", 11.0): (0.55, 0.4),
    ("SIER2", 21.0): (2.22, 0.15),
    ("SIER4", 4.2): (0.0035, 0.0005),
    ("SIER4", 11.0): (0.27, 0.06),
    ("SIER4", 21.0): (14.0, 2.0),
}

#: Table 1: rms(L_z)/<L_z>.
MOMENTUM = {
    ("MRDL", 4.2): (16e-13, 1e-13),
    ("MRDL", 11.0): (7.0e-13, 0.6e-13),
    ("MRDL", 21.0): (3.9e-13, 0.4e-13),
    ("SEJ4", 4.2): (0.0014e-3, 0.0003e-3),
    ("SEJ4", 11.0): (0.069e-3, 0.019e-3),
    ("SEJ4", 21.0): (2.3e-3, 1.1e-3),
    ("SIER2", 4.2): (6e-13, 1e-13),
    ("SIER2", 11.0): (2.1e-13, 0.7e-13),
    ("SIER2", 21.0): (1.4e-13, 0.3e-13),
    ("SIER4", 4.2): (2.6e-13, 0.7e-13),
    ("SIER4", 11.0): (1.8e-13, 0.3e-13),
    ("SIER4", 21.0): (2.6e-13, 0.4e-13),
}

#: Sec. IV C: h/f in fs below which SIER4 conserves the energy of liquid water better than SIER2, and the number of
#: molecules. Nine runs of 1 ps were averaged.
CROSSING, WATER_MOLECULES = 1.8, 512


# --- as text ---

PS_UNITS = ((1e12, "s"), (1e9, "ms"), (1e6, "µs"), (1e3, "ns"), (1.0, "ps"))


def picoseconds(value: float, like: float | None = None) -> str:
    """A time, given in ps, in a unit that suits it, or that suits the time `like` that it is compared with."""
    if not math.isfinite(value):
        return "-"
    scale, unit = unit_of(value if like is None else like)
    return f"{value / scale:.3g} {unit}"


def unit_of(value: float) -> tuple[float, str]:
    """A unit that suits a time in ps: its size in ps and its name."""
    return next(((scale, unit) for scale, unit in PS_UNITS if value >= scale), PS_UNITS[-1])


def ratio(ours: float, paper: float | None) -> str:
    """Ours over the paper's."""
    if paper is None or not math.isfinite(ours):
        return "-"
    value = ours / paper
    return f"{value:.2f}" if value >= 0.1 else f"{value:.0e}"
