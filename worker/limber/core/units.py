"""Values with a unit, as any setting may be given: ``2.5 mm`` for one in metres."""

import math
import re
from collections.abc import Callable, Iterable
from numbers import Real
from typing import Any

from limber.core.constants import FORCE_UNITS_N, UNIT_METRES

UNITS: dict[str, dict[str, float]] = {
    "m": UNIT_METRES, "N": FORCE_UNITS_N,
    "Pa": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "kg": {"kg": 1.0, "g": 1e-3}, "rad": {"rad": 1.0, "deg": math.pi / 180},
    "J": {"J": 1.0, "mJ": 1e-3}, "kg/m^3": {"kg/m^3": 1.0, "g/cm^3": 1e3},
    "MB": {"MB": 1.0, "GB": 1e3}, "m/s": {"m/s": 1.0, "mm/s": 1e-3}, "m^2": {"m^2": 1.0}}
"""Units that may be written for a value, each by its size in the unit named first."""

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?![\d.]|[eE][-+]?\d)"
                       r"\s*([^\d\s].*?)\s*")


def in_unit(value: Any, unit: str) -> Any:
    """Return a number, or numbers, of a text with a unit in ``unit``; other values unchanged.
    ValueError for a unit that cannot be converted."""
    if isinstance(value, list | tuple):
        return type(value)(in_unit(item, unit) for item in value)
    match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return value
    number, unit_text = match.groups()
    known = UNITS.get(unit, {unit: 1.0} if unit else {})
    if unit_text not in known:
        raise ValueError(f"it must be in {' or '.join(known)}" if unit else "it has no unit")
    return float(number) * known[unit_text]


# How values are shown to people: titles, digits and units, and tables of them.

SCALES = {"mm": ("m", 1e3), "MPa": ("Pa", 1e-6), "mJ": ("J", 1e3), "cm3": ("m3", 1e6),
          "%": ("", 100.0), "percent": ("%", 1.0)}
"""Shown units, each with the SI unit of its value and how many of them that is."""
BESIDE = {"": "", "%": " %", "percent": " %"}
"""Units that stand with each value; others stand in the heading."""


def text_of(value: Any, form: str = "") -> str:
    """Return a value in SI units with the digits and unit of ``form``, such as ".1f mm"."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, Real):
        return str(value)
    digits, _, unit = form.partition(" ")
    return f"{SCALES.get(unit, ('', 1))[1] * value:{digits}}{BESIDE.get(unit, '')}"


def table_of(records: Iterable[Any], *columns: tuple[Any, ...], missing: str = "",
             ) -> list[list[str]]:
    """Return one row for each record below a header, none without records. A column is a heading, a
    record's key or a function of it, and the form of :func:`text_of`; ``missing`` stands for
    None."""
    def cell(record: Any, value: str | Callable[[Any], Any], form: str = "") -> str:
        found = value(record) if callable(value) else record.get(value)
        return missing if found is None else text_of(found, form)
    rows = [[cell(record, *column[1:]) for column in columns] for record in records]
    return [[column[0] for column in columns], *rows] if rows else []


def place_text(place: Iterable[float]) -> str:
    """Return coordinates as an edit of a skeleton takes them."""
    return " ".join(f"{round(value, 6):.8g}" for value in place)
