"""Values in JSON form, and their check."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import InitErrorDetails

from limber.core.errors import Text

Content = TypeVar("Content")

LARGEST_NUMBER = 1e18
"""Largest size of a number in a file. No quantity in SI units comes near it, and squares of it are
still finite in single precision.
"""


def plain(value: Any) -> Any:
    """Return ``value`` in JSON form: models, numpy and paths become dicts, lists, numbers. One not
    finite, as JSON has no NaN, or beyond ``LARGEST_NUMBER``, such as the end of an open interval,
    becomes None."""
    if isinstance(value, BaseModel):
        return plain(value.model_dump())
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple | set):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not abs(value) <= LARGEST_NUMBER:
        return None
    return value


def stored(value: Any, largest: float = 0.0) -> Any:
    """Return a value in JSON form with the digits that do not depend on the processor: nine of each
    number, and of the ``largest`` of a vector [3], since its parts share their error. A vector,
    perhaps a place on a map, keeps six decimals at least; a number, perhaps a stamp, three.

    >>> stored([0.1 + 0.2, 1, None, True, 1.2345678912345e-12, 5234567.1234567])
    [0.3, 1, None, True, 1.23456789e-12, 5234567.123]
    >>> stored({"vector": [1.0, 1e-17, -2e-10], "numbers": [1.0, 1e-17, -0.0, 2.0]})
    {'vector': [1.0, 0.0, 0.0], 'numbers': [1.0, 1e-17, 0.0, 2.0]}
    >>> stored([5234567.1234567, 0.0, 1.0])
    [5234567.123457, 0.0, 1.0]
    """
    if isinstance(value, dict):
        return {key: stored(item) for key, item in value.items()}
    if isinstance(value, list):
        sizes = [abs(item) for item in value if isinstance(item, float)]
        return [stored(item, max(sizes) if len(sizes) == len(value) == 3 else 0) for item in value]
    if not isinstance(value, float):
        return value
    size = max(abs(value), largest) or 1.0
    return round(value, max(8 - int(np.floor(np.log10(size))), 6 if largest else 3)) + 0.0


def stored_lengths(lengths: np.ndarray) -> np.ndarray:
    """Return lengths [m] in whole nanometres, as files store them: a sum rounded otherwise on
    another processor differs by less.

    >>> stored_lengths(np.array([0.1 + 2e-17, -1e-17, 1.23456789049])).tolist()
    [0.1, 0.0, 1.23456789]
    """
    return np.round(lengths, 9) + 0.0  # no -0


def number_array(values: Any, *, gaps: bool = False) -> np.ndarray:
    """Return nested lists of numbers as an array of floats; with ``gaps`` None becomes NaN.
    ValueError if they are ragged, or contain anything else: a text, a Boolean, None."""
    held = np.array(values, object)
    if not {type(value) for value in held.ravel().tolist()} <= {int, float, *[type(None)] * gaps}:
        raise ValueError("a value that is not a number")
    return held.astype(float)


def validated(kind: type[Content], content: Any) -> Content:
    """Return values from a file or a user as ``kind``, any type that pydantic checks, but take no
    Boolean for a number: ``width: true`` is no 1. ValidationError if they are not of that kind."""
    made = TypeAdapter(kind).validate_python(content)
    if (place := _boolean_as_number(content, made)) is not None:
        raise ValidationError.from_exception_data("content", [InitErrorDetails(
            type="float_type", loc=place, input=reduce(lambda held, key: held[key], place,
                                                       content))])
    return made


def first_refusal(error: ValidationError) -> str:
    """Return where content is wrong first, and why, in plain words."""
    first = error.errors(include_url=False)[0]
    return Text.joined(": ", [*[".".join(map(str, first["loc"]))] * bool(first["loc"]),
                              refusal_of(first)])


def refusal_of(problem: Mapping[str, Any]) -> Text:
    """Return in plain words why a value was refused; ``problem`` is one of a ValidationError's
    ``errors()``."""
    about, kind = problem.get("ctx", {}), problem["type"]
    if isinstance(cause := about.get("error"), ValueError):
        return Text(*cause.args)
    if known := re.findall("'([^']*)'", about.get("expected_tags", about.get("expected", ""))):
        given = str(about.get("tag", problem["input"]))
        return Text(f"it must be {', '.join(known[:-1])} or {known[-1]}, not {given!r}"
                    if len(known) > 1 else f"it must be {known[0]}, not {given!r}")
    if "actual_length" in about:
        return Text(f"it has {about['actual_length']} parts, not "
                    f"{about.get('max_length', about.get('min_length'))}")
    if kind == "union_tag_not_found":
        return Text(about["discriminator"].strip("'"), " is missing")
    said = problem["msg"].replace("Input should", "it must")
    return Text(_REFUSALS.get(kind.removesuffix("_parsing").removesuffix("_type"))
                or said.replace("greater than or equal to", "at least").replace(
                    "less than or equal to", "at most"))


_REFUSALS = {"missing": "it is missing", "extra_forbidden": "no such entry is known",
             "float": "it must be a number", "int": "it must be a whole number",
             "int_from_float": "it must be a whole number",
             "bool": "it must be true or false", "string": "it must be a text",
             "list": "it must be a list", "tuple": "it must be a list",
             "dict": "it must be a table of entries", "model": "it must be a table of entries",
             "model_attributes": "it must be a table of entries"}
"""What is said of a refused value, by the kind of error."""


def _boolean_as_number(content: Any, made: Any) -> tuple[str | int, ...] | None:
    """Return the place of a Boolean in ``content`` of which a number was made, or None."""
    if isinstance(content, bool):
        return () if isinstance(made, int | float) and not isinstance(made, bool) else None
    pairs: list[tuple[str | int, Any, Any]] = []
    if isinstance(content, Mapping) and isinstance(made, BaseModel):
        names = {field.alias or name: name for name, field in type(made).model_fields.items()}
        pairs = [(key, item, getattr(made, names[key])) for key, item in content.items()
                 if key in names]
    elif isinstance(content, Mapping) and isinstance(made, Mapping):
        pairs = [(key, item, made.get(key)) for key, item in content.items()]
    elif isinstance(content, list | tuple) and isinstance(made, list | tuple):
        pairs = [(number, *both) for number, both in enumerate(zip(content, made, strict=False))]
    for key, item, part in pairs:
        if (place := _boolean_as_number(item, part)) is not None:
            return (key, *place)
    return None


# JSON objects that a program writes line by line, between other lines.


def json_object(line: str | bytes) -> dict[str, Any] | None:
    """Return the object of a line; None for any other or truncated line."""
    try:
        content = json.loads(line)
    except (ValueError, RecursionError):
        # Native libraries (fTetWild, Blender) print lines of their own.
        return None
    return content if isinstance(content, dict) else None


def json_objects(lines: Iterable[str | bytes]) -> Iterator[dict[str, Any]]:
    """Iterate over the objects of those lines that contain one."""
    return (content for content in map(json_object, lines) if content is not None)
