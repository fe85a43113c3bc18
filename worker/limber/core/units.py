"""Values with a unit, as a job file may give them: ``"2.5 mm"`` for a setting in metres."""

import math
import re
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

_QUANTITY = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s].*?)\s*$")


def in_unit(value: Any, unit: str) -> Any:
    """Return a number, or numbers, of a text with a unit in ``unit``; other values unchanged.
    ValueError for a unit that cannot be converted."""
    if isinstance(value, list):
        return [in_unit(item, unit) for item in value]
    match = _QUANTITY.match(value) if isinstance(value, str) else None
    if match is None:
        return value
    number, unit_text = match.groups()
    known = UNITS.get(unit, {unit: 1.0} if unit else {})
    if unit_text not in known:
        advice = (f"It must be in {unit}. Known units: {', '.join(known)}." if unit
                  else "This value has no unit.")
        raise ValueError(f"{value!r} is in {unit_text!r}. {advice}")
    return float(number) * known[unit_text]
