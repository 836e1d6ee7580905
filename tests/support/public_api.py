"""Write what the package promises to keep: `python -m tests.support.public_api` replaces tests/data/public_api.txt.

Public names with their signatures, the options of the command, and the formats of files. Types and texts may change.
"""

import inspect
from collections.abc import Iterator
from pathlib import Path

import openmm_sier
from openmm_sier import ensembles
from openmm_sier.analysis import logs, observables, statistics, transport, validation
from openmm_sier.cli.command_line import app
from openmm_sier.cli.files import checkpoints
from openmm_sier.integrators import settings
from openmm_sier.observe import gsd_reporter, reporters

RECORD = Path(__file__).parents[1] / "data" / "public_api.txt"

#: Modules that pages name: those that list their public names, and others, whose own names are public.
MODULES = (openmm_sier, ensembles, reporters, gsd_reporter, logs, observables, statistics, transport, validation)


def lines() -> Iterator[str]:
    """Yield one line for each name, option and format, in a fixed order."""
    for module in MODULES:
        for name in sorted(_names(module)):
            place, member = f"{module.__name__}.{name}", getattr(module, name)
            yield f"{place}{_parameters(member)}"
            # The methods of ensembles are for integrators.
            if inspect.isclass(member) and module is not ensembles:
                yield from _members(place, member)
    for command in sorted(app):
        if command.startswith("-"):
            continue
        arguments = (each for each in app[command].assemble_argument_collection() if each.parse)
        options = {name for argument in arguments for name in argument.names}
        yield from (f"openmm-sier {command} {name}" for name in sorted(options))
    yield f"checkpoints, format {checkpoints.FORMAT}"
    yield f"integrators in XML, layout {settings.LAYOUT}"


def _names(module: object) -> list[str]:
    return getattr(module, "__all__", None) or [
        name
        for name, member in vars(module).items()
        if not name.startswith("_") and getattr(member, "__module__", None) == module.__name__
    ]


def _members(place: str, cls: type) -> Iterator[str]:
    """Yield the public methods and attributes of a class, if they are this package's."""
    for name, attribute in sorted(inspect.getmembers(cls)):
        owner = next((base for base in cls.__mro__ if name in vars(base)), None)
        if name.startswith("_") or owner is None or not owner.__module__.startswith("openmm_sier"):
            continue
        yield f"{place}.{name}{_parameters(attribute)}"


def _parameters(member: object) -> str:
    """Return the parameters of something that can be called, without types; * marks one that need not be given."""
    if not callable(member) or (inspect.isclass(member) and issubclass(member, Exception)):
        return ""
    parameters = inspect.signature(member).parameters.values()
    optional = inspect.Parameter.empty
    return f"({', '.join(each.name + '*' * (each.default is not optional) for each in parameters)})"


if __name__ == "__main__":
    RECORD.write_text("\n".join(lines()) + "\n")
