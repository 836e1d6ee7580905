"""What all laws have in common: cases that Hypothesis draws and shrinks, and how many of them a run tries."""

from __future__ import annotations

import contextlib
import dataclasses
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import openmm
import pytest
from hypothesis import HealthCheck, Phase, given, reject, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

#: Examples of the thorough run.
MANY = 500


class Case(Protocol):
    """A member of a law. Its `repr` is Python that makes it again."""

    def check(self) -> None:
        """Raise an AssertionError where the law does not hold."""


class Broken(AssertionError):
    """A law that does not hold.

    Attributes:
        case: the smallest one that was found.
    """

    def __init__(self, case: Case, error: Exception):
        where = traceback.extract_tb(error.__traceback__)[-1]
        super().__init__(
            f"{case!r}.check()\n{type(error).__name__}: {error}\n{where.filename}:{where.lineno} {where.line}"
        )
        self.case = case


def on_engine(case: Any, engine: str) -> Case:
    """Return a case with an engine in place of its own one or ones; a case that has none is left out."""
    names = {field.name for field in dataclasses.fields(case)}
    if "engines" in names:
        return dataclasses.replace(case, engines=(engine,))
    if "method" in names:
        return dataclasses.replace(case, method=dataclasses.replace(case.method, engine=engine))
    return reject()


@contextlib.contextmanager
def rejecting_refusals(engine: str) -> Iterator[None]:
    """Leave out a case that the kernels engine refuses, which says nothing about it."""
    try:
        yield
    except openmm.OpenMMException as error:
        if engine == "kernels" and "kernels engine" in str(error):
            reject()
        raise


@dataclass(frozen=True)
class Law:
    """A law with the strategy of its cases.

    Attributes:
        name: by which the command knows it.
        cases: returns the strategy for a platform.
        few: number of examples of the default run.
    """

    name: str
    cases: Callable[[str], st.SearchStrategy[Case]]
    few: int

    def hold(
        self, examples: int, platform: str = "Reference", seed: int | None = None, engine: str | None = None
    ) -> None:
        """Try examples.

        Args:
            examples: how many.
            platform: name of the platform.
            seed: of the examples; None draws the same ones everywhere.
            engine: name of the engine of all; None: those that the law draws, which the platform always has.

        Raises:
            Broken: the law does not hold.
        """
        tried: list[Case] = []

        @settings(
            max_examples=examples,
            phases=(Phase.generate, Phase.shrink),
            derandomize=seed is None,
            database=None,
            deadline=None,
            report_multiple_bugs=False,
            suppress_health_check=list(HealthCheck),
        )
        @given(self.cases(platform))
        def holds(drawn: Case) -> None:
            case = drawn if engine is None else on_engine(drawn, engine)
            tried.append(case)
            case.check()

        try:
            (holds if seed is None else seeded(seed)(holds))()
        except Exception as error:
            if not tried:
                raise
            # Hypothesis tries the smallest case last.
            raise Broken(tried[-1], error) from error

    def numbers(self) -> pytest.MarkDecorator:
        """Parametrize a test by `examples`, the number of them."""
        many = pytest.param(MANY, marks=[pytest.mark.thorough, pytest.mark.hundreds])
        return pytest.mark.parametrize("examples", [self.few, many])
