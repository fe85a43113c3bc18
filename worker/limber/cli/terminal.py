"""Results for people on a terminal: few digits, one item per line, tables aligned.

A command ends with what was found, where it is and what to do next. Lines of findings are templates
with the names of results in them, ``"{length_m:m} of centreline"``; the units are those of
:data:`UNITS`.
"""

import math
import re
import shlex
import string
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

Line = str | Callable[[Mapping[str, Any]], str | None]
"""A template, or a function from results to a line; a line without its results is omitted."""

# Longest list of plain numbers that is printed on one line, and most elements that are shown of
# others.
_SHOWN = 12


def result_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield a stage's result as lines ``name: value`` with five digits, nested values indented,
    without empty ones, which ``--json`` has."""
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


def found_lines(lines: Sequence[Line], values: Mapping[str, Any]) -> Iterator[str]:
    """Yield the filled-in lines of which all values are present."""
    for line in lines:
        try:
            text = _FILLED.vformat(line, (), values) if isinstance(line, str) else line(values)
        except (_NotThere, KeyError):
            # A result may lack it: of a dry run, or without an uncertainty.
            continue
        if text:
            yield text


def command_to_type(template: str, values: Mapping[str, Any]) -> str:
    """Return a command with names and paths filled in, quoted for a shell; "" if one is missing.
    ``{name:if}`` requires a value but prints nothing; ``{name:a/b}`` is a if it is true, else b."""
    try:
        return _QUOTED.vformat(template, (), values)
    except _NotThere:
        return ""


def closing_lines(found: Sequence[str], where: object = "", then: str = "") -> list[str]:
    """Return the end of a command: what was found, where it is, what to type next."""
    return [*found, *([f"in    {where}"] if where else []), *([f"next  {then}"] if then else [])]


def _in_metres(value: float) -> str:
    return f"{value:.3g} m" if abs(value) >= 1 else f"{1e3 * value:.3g} mm"


def _in_pascal(value: float) -> str:
    return f"{value / 1e9:.3g} GPa" if abs(value) >= 1e9 else f"{value / 1e6:.3g} MPa"


UNITS: dict[str, Callable[[float], str]] = {
    "m": _in_metres, "Pa": _in_pascal,
    "J": lambda value: f"{value:.3g} J" if abs(value) >= 0.1 else f"{1e3 * value:.3g} mJ",
    "kg": lambda value: f"{value:.3g} kg" if abs(value) >= 1 else f"{1e3 * value:.3g} g",
    "cm3": lambda value: f"{1e6 * value:.3g} cm³", "N": lambda value: f"{value:.3g} N",
    "Hz": lambda value: f"{value:.3g} Hz", "s": lambda value: f"{value:.3g} s",
    "MB": lambda value: f"{value / 1e6:,.1f} MB", "count": lambda value: f"{value:,.0f}",
    "share": lambda value: f"{100 * value:.3g} %", "%": lambda value: f"{value:.3g} %"}
"""Format of a value in SI units for people; ``|m`` is the length of a vector, and
``#branch/branches`` a number of them."""


class _NotThere(Exception):
    """A template names a value that a result does not have."""


class _Filled(string.Formatter):
    """Fills values of a result into a template, by the units of :data:`UNITS`."""

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> Any:
        try:
            value, first = super().get_field(field_name, args, kwargs)
        except (KeyError, IndexError, TypeError) as error:
            raise _NotThere from error
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            raise _NotThere
        return value, first

    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec.startswith("|"):
            value, format_spec = math.hypot(*value), format_spec[1:]
        if format_spec.startswith("#"):
            one, many = format_spec[1:].split("/")
            return f"{value:,} {one if value == 1 else many}"
        if format_spec in UNITS:
            return UNITS[format_spec](value)
        return format(value, format_spec) if format_spec else _text(value)


class _Quoted(_Filled):
    """Fills names and paths into a command."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if "/" in format_spec:
            return format_spec.split("/")[not value]
        return "" if format_spec == "if" else shlex.quote(str(value))


_FILLED, _QUOTED = _Filled(), _Quoted()


_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def without_control(text: str) -> str:
    """Return a text that cannot control the terminal, as names and texts of files might."""
    return _CONTROL.sub("?", text)


def say(text: str) -> None:
    """Print on standard error."""
    click.echo(without_control(text), err=True)


def table_text(title: str, rows: Sequence[Sequence[str]]) -> str:
    """Return a table below its title; its first row is the header."""
    return "\n".join([f"\n{title}", *(f"  {line}" for line in table_lines(rows))])


def table_lines(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the rows of a table with right-aligned columns."""
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
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_text(item)}" for name, item in value.items()
                         if not _is_empty(item))
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(_text, value)) + "]"
    return str(value)
