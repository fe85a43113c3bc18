"""Values that may be None by type but are present by the caller's order of steps."""

from typing import TypeVar

Value = TypeVar("Value")


def present(value: Value | None, what: str) -> Value:
    """Return ``value``.

    Args:
        what: The value's name, for the message.

    Raises:
        ValueError: it is None. This is a bug, not an error in the user's input.
    """
    if value is None:
        raise ValueError(f"There is no {what}.")
    return value
