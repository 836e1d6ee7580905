"""The bias of averages to second order in the step, predicted from the motion without bias.

Let a step be a kick, and a drift with the bath in its middle (`Scheme.with_bath`). Without the bath it conserves

    H + h^2 (v.V''v / 12 - g / 24),    g = grad V . M^-1 grad V,

at the positions that it visits, with v the velocity and V'' the Hessian of V, along geodesics where bodies turn: the
exact rotation is one. In the middle of the drift the coefficients are -1/24 and 1/12. The bath draws velocities towards
exp(-H/kT), which differs there from what the step conserves. To second order the stationary density follows from both,

    d<X> = h^2 / kT [ (Cov(X, g) - 2 kT Cov(X, l)) / 24 - Int_0^inf <S(0) dX(t)> dt / 12 ]    for X(q),
    S = sum_k friction_k (v_k.(V''v)_k - kT l_k),    l = tr M^-1 V'',    k: translation, rotation,

and for kinetic energies just after the bath the first term is kT l_k / 24 in place of that. Since the rate of change of
f = v.grad V is v.V''v - g less its friction, S may be replaced by sum_k friction_k (g_k - kT l_k - friction_k f_k),
which needs no V''v; and Cov(X, g) = kT Cov(X, l) + kT <grad X . M^-1 grad V>.

In a weak bath the integral makes the mean kinetic energy right, and no more:

    d<V> = -h^2 / 24 [ kT <l> (2 C / N - 1) + Cov(V, l) ],    C = Var V / kT^2,

with N degrees of freedom that have the same friction. In a harmonic potential C = N / 2 and l is constant: no bias.

A drift by one step of RATTLE adds h^2 E to what is conserved, see `kernels.rattle_energy`, which the bath changes too.
Where it turns a body by the mean of the angular momenta before and after the bath, as LangevinMiddle does, these have
their noise at the start of the turn. Of noise d its energy d.I^-1 d / 2 grows, by what I^-1 changes, to

    h^2 friction kT^2 P / 4 a body and time,    P = sum over pairs of (I_i - I_j)^2 / (I_1 I_2 I_3).

So a body alone in a potential has the mean potential energy of the temperature T (1 + h^2 kT (10 sum 1/I + P) / 36),
beside the bias of the kick: `rattle_warmth`.

Sources: Leimkuhler and Matthews, Appl. Math. Res. Express 2013, 34; Leimkuhler, Matthews and Stoltz, IMA J. Numer.
Anal. 36, 13 (2016), for linear response to the step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from openmm_sier.analysis.statistics import Estimate

#: Parts of a run whose scatter gives errors.
PARTS = 40


class Bath(NamedTuple):
    """Hold frictions, 1/ps, k_B T in kJ/mol, numbers of degrees of freedom of all bodies, and moments of each."""

    friction: float
    turning_friction: float
    thermal: float
    degrees: tuple[int, int]
    moments: np.ndarray


def unevenness(moments: np.ndarray) -> float:
    """Return P of three moments of inertia, 1/(dalton nm^2)."""
    x, y, z = moments
    return float(((x - y) ** 2 + (y - z) ** 2 + (z - x) ** 2) / (x * y * z))


def rattle_warmth(moments: np.ndarray, thermal: float, h: float) -> float:
    """Return by which share of T the potential energy of a body is too warm that RATTLE turns around a bath.

    Args:
        moments: dalton nm^2, (3,).
        thermal: k_B T, kJ/mol.
        h: step, ps.
    """
    return h**2 * thermal * (10 * float((1 / moments).sum()) + unevenness(moments)) / 36


def predicted(samples: pd.DataFrame, interval: float, memory: float, bath: Bath) -> dict[str, Estimate]:
    """Return the bias over the square of the step, per ps^2, of averages in a bath.

    Args:
        samples: columns of `kernels.COLUMNS`, of a run in that bath whose steps are so short that it has no bias.
        interval: between samples, ps.
        memory: time within which fluctuations are forgotten, ps: the end of the integral.
        bath: Bath.

    Returns:
        For `potential`, `kinetic_translation` and `kinetic_rotation`, of all bodies in kJ/mol; with `weak_` before the
        name of the former its limit in a weak bath of equal frictions; with `mean_` what turns by the mean add, and
        with `rattle_` what such turns by RATTLE add.
    """
    # Means are those of the whole run: those of parts would take some of the slow fluctuations away.
    means = samples.mean()
    places = np.array_split(np.arange(len(samples)), PARTS)
    parts = [_of_part(samples.iloc[place] - means, means, interval, memory, bath) for place in places]
    found = pd.DataFrame(parts)
    if bath.friction == bath.turning_friction:
        _use_balance(found)
    return {name: Estimate(found[name].mean(), found[name].std() / np.sqrt(PARTS), PARTS) for name in found}


def _use_balance(found: pd.DataFrame) -> None:
    """Take from each value what goes with the error of the kinetic energy, which has no bias where frictions are equal.

    A bath of one friction keeps up no flow of heat, so that the mean kinetic energy that it sees is that of its
    temperature. The sum of both kinetic energies is noise, and others have a part of it.
    """
    noise = found["kinetic_translation"] + found["kinetic_rotation"]
    for name in ("potential", "kinetic_translation", "kinetic_rotation"):
        found[name] -= noise * (noise.cov(found[name]) / noise.var())


def _of_part(part: pd.DataFrame, means: pd.Series, interval: float, memory: float, bath: Bath) -> dict[str, float]:
    """Return the law by a part of a run, given as deviations from the means of the run."""
    kT = bath.thermal
    V, l = part["potential"], part["trace_translation"] + part["trace_rotation"]
    mean, covariance = means["trace_translation"] + means["trace_rotation"], (V * l).mean()
    source = 0.0 * V
    for friction, kind in ((bath.friction, "translation"), (bath.turning_friction, "rotation")):
        excess = part[f"square_{kind}"] - kT * part[f"trace_{kind}"] - friction * part[f"power_{kind}"]
        source += friction / 12 * excess
    mean_only = -bath.turning_friction * unevenness(bath.moments) / 6 * kT * part["kinetic_rotation"]
    rattle = bath.turning_friction * part["rattle_bath"] + mean_only
    at_once = {
        "potential": (kT * mean - covariance) / 24,
        "kinetic_translation": kT * means["trace_translation"] / 24,
        "kinetic_rotation": kT * means["trace_rotation"] / 24,
    }
    found = {}
    for name, value in at_once.items():
        found[name] = value - response(source, part[name], interval, memory) / kT
        found[f"mean_{name}"] = -response(mean_only, part[name], interval, memory) / kT
        conserved = (part["rattle"] * part[name]).mean()
        found[f"rattle_{name}"] = -(conserved + response(rattle, part[name], interval, memory)) / kT
    capacity = 2 * (V**2).mean() / kT**2 / sum(bath.degrees) - 1
    return found | {"weak_potential": -(kT * mean * capacity + covariance) / 24}


def response(source: pd.Series, values: pd.Series, interval: float, memory: float) -> float:
    """Return the integral of <source(0) values(t)> over t from 0 to a time."""
    n, lags = len(source), round(memory / interval)
    length = 1 << (n + lags).bit_length()
    first, second = (np.fft.rfft(series, length) for series in (source, values))
    correlation = np.fft.irfft(first.conj() * second, length)[: lags + 1] / (n - np.arange(lags + 1))
    return float(np.trapezoid(correlation, dx=interval))
