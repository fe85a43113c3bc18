"""How values are shown to people: titles, digits and units, and tables of them."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

SCALES = {"mm": ("m", 1e3), "MPa": ("Pa", 1e-6), "mJ": ("J", 1e3), "cm3": ("m3", 1e6),
          "%": ("", 100.0), "percent": ("%", 1.0)}
"""Shown units, each with the SI unit of its value and how many of them that is."""
BESIDE = {"": "", "%": " %", "percent": " %"}
"""Units that stand with each value; others stand in the heading."""


def text_of(value: Any, form: str = "") -> str:
    """Return a value in SI units with the digits and unit of ``form``, such as ".1f mm"."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, int | float | np.floating):
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
    return " ".join(f"{value:.8g}" for value in place)
