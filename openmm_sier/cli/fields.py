"""Kinds of settings: fields of pydantic, each with range, unit, help, and the message for a wrong value.

Command lines, TOML files and checkpoints are checked by the same fields.
"""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter
from pydantic import AfterValidator, BaseModel, Field, ValidationError
from pydantic.fields import FieldInfo

#: Whether a restart keeps the value of a setting in the checkpoint, and refuses another, or may change it. Settings "of
#: the call" apply to one call of the command, and are not in checkpoints.
Restart = Literal["keeps", "may change", "of the call"]

#: Returns the default of a field from the values of earlier fields.
Follows = Callable[[dict[str, Any]], Any]

#: Descriptions of names of files and of other names, for messages.
FILE, NAME = "the name of a file", "a name"


# --- types ---


def _check_file(path: Path) -> Path:
    # The root, this directory and the one above are no files, and outputs may be named after inputs.
    if path.name in ("", "..") or "\0" in str(path):
        raise ValueError(f"expected {FILE}")
    return path


def _check_name(name: str) -> str:
    if not name.strip() or not name.isprintable():
        raise ValueError(f"expected {NAME}")
    return name


def one_of(names: Collection[str]) -> AfterValidator:
    """Return a validator that accepts only these names."""

    def check(name: str) -> str:
        if name not in names:
            raise ValueError(f"expected one of {', '.join(names)}")
        return name

    return AfterValidator(check)


File = Annotated[Path, AfterValidator(_check_file)]
Name = Annotated[str, AfterValidator(_check_name)]

#: A flag that is off by default.
Switch = Annotated[bool, Parameter(negative="")]


# --- fields ---


def setting(
    help: str,
    expected: str,
    default: Any = ...,
    *,
    follows: Follows | None = None,
    otherwise: str = "",
    restart: Restart = "keeps",
    shows_values: bool = False,
    positional: bool = False,
    each: str = "",
    **limits: Any,
) -> Any:
    """Return a field of a model of settings.

    Args:
        help: description of the setting.
        expected: description of its values.
        default: its value if none is given; without a default the setting is required.
        follows: function that returns the default.
        otherwise: the default in words, if it is no single value.
        restart: see `Restart`.
        shows_values: whether the help includes `expected`.
        positional: whether a command line may have its value without a flag.
        each: description of the items of a list.
        limits: of pydantic.
    """
    if not otherwise and default not in (..., None, False):
        otherwise = f"{default:g}" if isinstance(default, float) else str(default)
    description = (f"{help}: {expected}" if shows_values else help) + (f" (default: {otherwise})" if otherwise else "")
    of_default: dict[str, Any] = {"default_factory": follows} if follows else {"default": default}
    extra: dict[str, Any] = {"expected": expected, "restart": restart, "each": each}
    return Field(description=description, json_schema_extra=extra, kw_only=not positional, **of_default, **limits)


def in_range(least: float, most: float, unit: str, beyond: bool = False) -> str:
    """Describe the numbers from `least`, or with `beyond` above it, to `most`."""
    return f"a number {f'above {least:g} and up' if beyond else f'from {least:g}'} to {most:g} {unit}".rstrip()


def number(
    help: str, unit: str, least: float, most: float, default: Any = None, *, beyond: bool = False, **more: Any
) -> Any:
    """Return a field for a number from `least`, or with `beyond` above it, to `most`; see `setting`."""
    limits: dict[str, Any] = {"gt" if beyond else "ge": least, "le": most}
    return setting(help, in_range(least, most, unit, beyond), default, shows_values=True, **limits, **more)


def time(help: str, default: float | None = None, **more: Any) -> Any:
    """Return a field for a length of time in ps; see `setting`."""
    return number(help, "ps", 0, 1e9, default, beyond=True, **more)


def whole(help: str, default: Any = None, *, least: int = 1, most: int = 2**31 - 1, **more: Any) -> Any:
    """Return a field for a whole number; see `setting`."""
    return setting(
        help, f"a whole number from {least} to {most}", default, shows_values=True, ge=least, le=most, **more
    )


def choice(help: str, names: Collection[str], default: Any = None, **more: Any) -> Any:
    """Return a field for one of a few names, whose type has `one_of`; see `setting`."""
    return setting(help, f"one of {', '.join(names)}", default, shows_values=True, **more)


def file(help: str, default: Any = None, **more: Any) -> Any:
    """Return a field for a file that a command reads or writes; see `setting`."""
    return setting(help, FILE, default, **more)


def several(help: str, item: str, count: int = 0, **more: Any) -> Any:
    """Return a field for a list of `count` items, or of one or more; `item` describes them. See `setting`."""
    expected = f"a list of {count} values" if count else "a list with at least one value"
    limits: dict[str, Any] = {"min_length": count or 1, "max_length": count or None}
    return setting(help, expected, None, each=item, **limits, **more)


def switch(help: str, default: bool | None = False, **more: Any) -> Any:
    """Return a field for yes or no; see `setting`."""
    return setting(help, "true or false", default, **more)


def details_of(field: FieldInfo) -> dict[str, Any]:
    """Return the details of a field that `setting` stored: `expected`, `restart` and others."""
    extra = field.json_schema_extra
    return dict(extra) if isinstance(extra, dict) else {}


# --- messages ---


def refusal(error: ValidationError, model: type[BaseModel]) -> tuple[str, str]:
    """Return the name of the first field with a wrong value, and a message with expected and given values."""
    # Defaults that follow from a wrong value are errors too.
    first = next(entry for entry in error.errors() if entry["type"] != "default_factory_not_called")
    name, *items = map(str, first["loc"])
    if first["type"] == "extra_forbidden":
        return name, "there is no such option"
    details = details_of(model.model_fields[name])
    return name, f"expected {details['each'] if items else details['expected']}, got {first['input']!r}"
