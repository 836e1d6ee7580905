"""What joins an integrator to its Context stands behind one name, and belongs to one Context."""

import ast
from pathlib import Path

import openmm
import pytest

import openmm_sier
from openmm_sier import SIERLangevinIntegrator
from tests.support.seeded import seeded
from tests.support.waters import cluster_system, context_at, phase_point

PACKAGE = Path(openmm_sier.__file__).parent
OWN = ("self", "cls", "super()")


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def private_names(tree: ast.Module) -> set[str]:
    """The private methods of the classes of a module, and the private attributes that these set."""
    found = set()
    for cls in (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)):
        for node in ast.walk(cls):
            if isinstance(node, ast.FunctionDef):
                found.add(node.name)
            elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
                found.add(node.id if isinstance(node, ast.Name) else node.attr)
    return set(filter(is_private, found))


def used_of_others(tree: ast.Module) -> dict[str, int]:
    """Private attributes of other things than the object of a method, with lines."""
    attributes = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and is_private(node.attr)]
    return {node.attr: node.lineno for node in attributes if ast.unparse(node.value) not in OWN}


def intrusions(sources: dict[str, str]) -> list[str]:
    """Where a module uses a private name of a class of another module, which is not its own name as well."""
    trees = {name: ast.parse(text) for name, text in sources.items()}
    private = {name: private_names(tree) for name, tree in trees.items()}
    known = set().union(*private.values())
    return [
        f"{name}:{line} {attribute}"
        for name, tree in trees.items()
        for attribute, line in used_of_others(tree).items()
        if attribute in known - private[name]
    ]


def test_private_names_of_a_class_are_used_in_its_own_module():
    sources = {str(path.relative_to(PACKAGE)): path.read_text() for path in PACKAGE.rglob("*.py")}
    assert intrusions(sources) == []
    # What the check is to find.
    sources["hooks.py"] += "\n\ndef f(context):\n    return context.getIntegrator().binding._engine\n"
    (found,) = intrusions(sources)
    assert found.startswith("hooks.py:")
    assert found.endswith(" _engine")


def test_an_integrator_whose_context_was_refused_says_so():
    _, _positions, system = cluster_system(2)
    integrator = SIERLangevinIntegrator(300, 5, 0.002, pressure=1)
    with pytest.raises(openmm.OpenMMException, match="A constant pressure needs a periodic System"):
        openmm.Context(system, integrator)
    with pytest.raises(openmm.OpenMMException, match="Context of this integrator no longer exists, or was refused"):
        openmm.Context(system, integrator)


def test_computations_of_others_are_refused():
    _, _, system = cluster_system(2)
    integrator = SIERLangevinIntegrator(300, 5, 0.002)
    integrator.addComputePerDof("v", "0.5*v")
    with pytest.raises(openmm.OpenMMException, match=r"computations and has \d+ now. .* cannot add"):
        openmm.Context(system, integrator)


@pytest.mark.parametrize("engine", ["exact", "native"])
def test_an_integrator_that_is_offered_to_a_second_context_stays_that_of_the_first(cluster, engine):
    """The native engine's heat was lost then."""
    _, system, point = cluster
    ends = []
    for is_offered in (False, True):
        integrator = seeded(SIERLangevinIntegrator(300, 5, 0.002, engine=engine))
        context = context_at(system, integrator, point, steps=3)
        if is_offered:
            with pytest.raises(openmm.OpenMMException, match="already bound"):
                openmm.Context(system, integrator)
        integrator.step(3)
        ends.append((integrator.getHeat(), *phase_point(context)[0].tolist()))
    assert ends[0] == ends[1]
