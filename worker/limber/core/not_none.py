"""Values that may be None by type but are present by the caller's order of steps."""

from typing import TypeVar

Value = TypeVar("Value")


def present(value: Value | None, what: str) -> Value:
    """Return ``value``; a ValueError names it if it is None, which is a bug, not an error of the
    user's."""
    if value is None:
        raise ValueError(f"There is no {what}.")
    return value
