"""Options and their values as words of a command line."""

from typing import Any


def flag(name: str) -> str:
    """Return the option of a setting, whose name has underscores."""
    return f"--{name.replace('_', '-')}"


def arguments(name: str, value: Any) -> list[str]:
    """Return the arguments that give an option, by its name with underscores, a value."""
    option = flag(name)
    if isinstance(value, bool):
        return [option if value else f"--no-{option[2:]}"]
    return [option, *map(argument, value if isinstance(value, (list, tuple)) else [value])]


def argument(value: Any) -> str:
    """Return a value as an argument that no parser takes for an option; negative numbers are none by themselves."""
    text = str(value)
    return f"./{text}" if text.startswith("-") and not isinstance(value, (int, float)) else text
