"""Settings that a user chose: checked, and refused with words that name the option."""

from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from limber.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


def checked_settings(model: type[Model], values: dict[str, Any]) -> Model:
    """Return ``model(**values)``; a refused value becomes an :class:`InputError` that names it."""
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors()[0]
        place = "--" + str(first["loc"][0] if first["loc"] else "settings").replace("_", "-")
        raise InputError(f"{place} {first.get('input')!r}: {first['msg']}.",
                         "It is outside what the stage can work with.",
                         "See the option's help for its range.") from error
