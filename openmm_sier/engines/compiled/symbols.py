"""Formulas in Python as code in C: a formula is applied to symbols, and what it did with them is written down.

So the kernels of GPUs have the formulas of `dynamics.kernels`, which are written once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import FunctionType
from typing import Any


@dataclass(frozen=True, eq=False)
class Symbol:
    """A number in C.

    Attributes:
        code: of the expression, with `{}` for each operand.
        operands: other numbers, which are symbols or constants.
    """

    code: str
    operands: tuple[Any, ...] = ()

    def __add__(self, other: Any) -> Symbol:
        return Symbol("{} + {}", (self, other))

    def __radd__(self, other: Any) -> Symbol:
        return Symbol("{} + {}", (other, self))

    def __sub__(self, other: Any) -> Symbol:
        return Symbol("{} - {}", (self, other))

    def __rsub__(self, other: Any) -> Symbol:
        return Symbol("{} - {}", (other, self))

    def __mul__(self, other: Any) -> Symbol:
        return Symbol("{}*{}", (self, other))

    def __rmul__(self, other: Any) -> Symbol:
        return Symbol("{}*{}", (other, self))

    def __truediv__(self, other: Any) -> Symbol:
        return Symbol("{}/{}", (self, other))

    def __rtruediv__(self, other: Any) -> Symbol:
        return Symbol("{}/{}", (other, self))

    def __neg__(self) -> Symbol:
        return Symbol("-{}", (self,))

    def __abs__(self) -> Symbol:
        return Symbol("fabs({})", (self,))

    def __le__(self, other: Any) -> Symbol:
        return Symbol("({} <= {})", (self, other))

    def __ge__(self, other: Any) -> Symbol:
        return Symbol("({} >= {})", (self, other))

    def __and__(self, other: Any) -> Symbol:
        return Symbol("({} & {})", (self, other))

    def sqrt(self) -> Symbol:
        """Return the square root; `numpy.sqrt` calls this."""
        return Symbol("sqrt({})", (self,))


def vector(name: str, size: int = 3) -> tuple[Symbol, ...]:
    """Return the components of an array in C."""
    return tuple(Symbol(f"{name}[{i}]") for i in range(size))


def sine_cosine(x: Symbol) -> tuple[Symbol, Symbol]:
    """Return sine and cosine of an angle."""
    return Symbol("sin({})", (x,)), Symbol("cos({})", (x,))


def in_python(formula: Any) -> Callable[..., Any]:
    """Return the function in Python of one that Numba compiles, with all those that it calls."""
    function = getattr(formula, "py_func", formula)
    called = {
        name: in_python(value)
        for name in function.__code__.co_names
        if hasattr(value := function.__globals__.get(name), "py_func")
    }
    return FunctionType(function.__code__, {**function.__globals__, **called}, function.__name__)


def literal(number: float) -> str:
    """Return a constant of the precision of the kernels."""
    return f"NUMBER({float(number)!r})"


def assignments(results: Iterable[tuple[str, Any]], indent: str = "    ") -> str:
    """Return statements in C that compute symbols, each of which is computed once.

    Args:
        results: what is set, with its symbol.
        indent: of lines.
    """
    names: dict[int, str] = {}
    lines: list[str] = []

    def name_of(symbol: Any) -> str:
        if not isinstance(symbol, Symbol):
            return literal(symbol)
        if not symbol.operands:
            return symbol.code
        if id(symbol) not in names:
            operands = [name_of(operand) for operand in symbol.operands]
            name = f"t{len(names)}"
            lines.append(f"const mixed {name} = {symbol.code.format(*operands)};")
            names[id(symbol)] = name
        return names[id(symbol)]

    # Names are numbered as lines are: all symbols live as long as the results.
    wanted = list(results)
    ends = [f"{target} = {name_of(symbol)};" for target, symbol in wanted]
    return "".join(f"{indent}{line}\n" for line in (*lines, *ends))
