"""JSON objects that a program writes line by line, between other lines."""

import json
from collections.abc import Iterable, Iterator
from typing import Any


def json_object(line: str | bytes) -> dict[str, Any] | None:
    """Return the object of a line; None for any other or truncated line."""
    try:
        content = json.loads(line)
    except (ValueError, RecursionError):
        # Native libraries (fTetWild, Blender) print lines of their own.
        return None
    return content if isinstance(content, dict) else None


def json_objects(lines: Iterable[str | bytes]) -> Iterator[dict[str, Any]]:
    """Yield the objects of those lines that contain one."""
    for line in lines:
        if (content := json_object(line)) is not None:
            yield content
