"""The exact free rotation of `dynamics.kernels.short_steps` as functions in C."""

import math
from collections.abc import Sequence
from functools import cache

from openmm_sier.dynamics.kernels import elliptic, formulas, long_steps, short_steps
from openmm_sier.engines.compiled.symbols import Symbol, assignments, in_python, sine_cosine, vector

#: Of each function: its head in C. Vectors are arrays of three numbers, quaternions of four.
PHASE = "DEVICE mixed phaseOf(const mixed* rates, const mixed* u, mixed k)"
TURN = "DEVICE void turnFreely(const mixed* rates, const mixed* u, mixed k, mixed* turn, mixed* next)"
PRODUCT = "DEVICE void multiplyQuaternions(const mixed* p, const mixed* q, mixed* result)"
MATRIX = "DEVICE void rotationMatrix(const mixed* q, mixed* rows)"

#: The longest phase within one application of the series.
LONGEST_PHASE = math.sqrt(elliptic.LONGEST)


@cache
def functions() -> str:
    """Return the functions, for an angular momentum of direction u and norm |L| = k/h."""
    rates = vector("rates")
    u = vector("u")
    k = Symbol("k")
    motion = in_python(short_steps.euler_rates)(rates, u, k)
    # What the series cannot reach is divided before; then any angle is allowed.
    turn, (even, odd), _ = in_python(short_steps.free_rotation)(u, rates, k, sine_cosine, math.inf)
    following = [a + b for a, b in zip(even, odd, strict=True)]
    product = in_python(long_steps.product)(vector("p", 4), vector("q", 4))
    rows = in_python(formulas.rotation_matrix)(*vector("q", 4))
    return "\n".join(
        [
            _function(PHASE, {"mixed p": motion.p, "mixed q": motion.q}, "return sqrt(max(p, q));"),
            _function(TURN, {**_array("turn", turn), **_array("next", following)}),
            _function(PRODUCT, _array("result", product)),
            _function(MATRIX, _array("rows", [each for row in rows for each in row])),
        ]
    )


def _array(name: str, values: Sequence[Symbol]) -> dict[str, Symbol]:
    return {f"{name}[{i}]": value for i, value in enumerate(values)}


def _function(head: str, results: dict[str, Symbol], end: str = "") -> str:
    """Return a function in C that sets results, and then has the statement at its end."""
    body = assignments(results.items())
    return f"{head} {{\n{body}" + (f"    {end}\n" if end else "") + "}\n"
