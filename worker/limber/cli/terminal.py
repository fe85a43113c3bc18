"""Results as a person reads them on a terminal: few digits, one thing a line, tables aligned."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# A list of plain numbers up to this length stands on one line; of others so many are shown.
_SHOWN = 12


def result_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield a stage's result as lines ``name: value``; what is nested is indented below its name.

    Numbers have five digits; what is empty is left out. ``--json`` has it all.
    """
    for name, value in result.items():
        if _is_empty(value):
            continue
        if _fits_one_line(value):
            yield f"{name}: {_text(value)}"
            continue
        yield f"{name}:"
        if isinstance(value, Mapping):
            yield from (f"  {line}" for line in result_lines(value))
        else:
            yield from (f"  {_text(item)}" for item in value[:_SHOWN])
            if len(value) > _SHOWN:
                yield f"  and {len(value) - _SHOWN} more (--json shows all)"


def table_lines(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the rows of a table with their columns aligned to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        yield "  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True))


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, str | Sequence | Mapping) and not len(value))


def _fits_one_line(value: Any) -> bool:
    if isinstance(value, Mapping):
        return False
    if isinstance(value, Sequence) and not isinstance(value, str):
        return len(value) <= _SHOWN and not any(
            isinstance(item, Sequence | Mapping) for item in value)
    return True


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(item)}" for name, item in value.items()
                         if not _is_empty(item))
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(_text, value)) + "]"
    return str(value)
