"""Engines call OpenMM's own methods, and users those that `hooks` has put in their place."""

import ast
import inspect
import json
import subprocess
import sys
from pathlib import Path

import openmm
import pytest

import openmm_sier
from openmm_sier.system import own_methods
from tests.support.matrices import representatives

PACKAGE = Path(openmm_sier.__file__).parent

#: What engines must not call as a method of a Context.
REPLACED = [name for name, method in vars(openmm.Context).items() if own_methods.is_replaced(method)]

#: Whoever calls these is no user: what moves a Context, decides between flows, or looks at what moves.
INSIDE = ("engines", "ensembles", "integrators", "stability", "system")


def calls(text: str) -> list[str]:
    """The replaced methods that a module calls, with lines."""
    found = [node.func for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    return [
        f"{call.lineno} {call.attr}"
        for call in found
        if isinstance(call, ast.Attribute)
        and call.attr in REPLACED
        and not ast.unparse(call.value).startswith("super()")
    ]


def test_no_engine_calls_a_replaced_method():
    assert "setPositions" in REPLACED
    assert "setVelocities" in REPLACED
    found = {
        f"{path.relative_to(PACKAGE)}:{call}"
        for folder in INSIDE
        for path in (PACKAGE / folder).rglob("*.py")
        for call in calls(path.read_text())
    }
    # Groups are fixed when OpenMM reads a program, and a Context that is reinitialized gets another engine.
    assert {call.partition(":")[0] for call in found if call.endswith("reinitialize")} <= {"engines/native/engine.py"}
    assert [call for call in found if not call.endswith("reinitialize")] == []
    # What the check is to find.
    assert calls("context.setPositions(x)") == ["1 setPositions"]


@pytest.mark.parametrize(
    "first",
    representatives(["openmm_sier", "openmm_sier.system.own_methods", "openmm_sier.hooks"], "openmm_sier.hooks"),
)
def test_the_order_of_imports_does_not_matter(first):
    program = (
        f"import {first}, openmm_sier, openmm\n"
        "from openmm_sier.system import own_methods as own\n"
        "assert own.is_replaced(openmm.Context.setPositions)\n"
        "assert not own.is_replaced(own.set_positions)\n"
        "assert openmm.Context.setPositions.__wrapped__ is own.set_positions\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def replaced_methods():
    """All methods of OpenMM that `hooks` has replaced, with their classes."""
    classes = [member for member in vars(openmm).values() if isinstance(member, type)]
    return [(cls, name) for cls in classes for name in vars(cls) if own_methods.is_replaced(getattr(cls, name))]


def test_signatures_are_those_of_openmm():
    program = (
        "import inspect, json, sys, openmm\n"
        "names = json.load(sys.stdin)\n"
        "print(json.dumps([str(inspect.signature(getattr(getattr(openmm, c), n))) for c, n in names]))"
    )
    names = [(cls.__name__, name) for cls, name in replaced_methods()]
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, input=json.dumps(names), capture_output=True, text=True, check=True, timeout=120)
    found = [str(inspect.signature(getattr(cls, name))) for cls, name in replaced_methods()]
    assert found == json.loads(done.stdout)


@pytest.mark.parametrize(("cls", "name"), replaced_methods(), ids=lambda value: getattr(value, "__name__", value))
def test_arguments_have_the_names_and_defaults_of_openmm(cls, name):
    """As far as the function that replaces a method reads them: others are passed on as they are."""
    method = getattr(cls, name)
    function = inspect.getclosurevars(method).nonlocals["instead"]
    arguments = list(inspect.signature(own_methods.own_method(cls, name)).parameters.values())
    if not isinstance(vars(cls)[name], staticmethod):
        arguments = arguments[1:]
    of_function = inspect.signature(function).parameters
    own = ["method"] if isinstance(vars(cls)[name], staticmethod) else ["method", "self"]
    by_keyword = {one.name: one.default for one in arguments if one.kind is not one.VAR_POSITIONAL}
    inspect.signature(function).bind(*own, **by_keyword)
    for one in arguments:
        if one.name in of_function:
            assert of_function[one.name].default == one.default


def test_objects_are_serialized_by_the_keyword_of_openmm():
    for thing in (openmm.System(), openmm.VerletIntegrator(0.001), openmm.HarmonicBondForce()):
        assert openmm.XmlSerializer.serialize(object=thing) == openmm.XmlSerializer.serialize(thing)
