"""Tables of a cylinder model (QSM): length, volume and taper by order, diameters at heights."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.tables import csv_records
from limber.geometry.skeleton.skeleton import Skeleton

HEIGHTS = (0.02, 0.1, 0.3, 0.5, 0.7, 0.9)
"""Fractions of the main path's length at which diameters are given."""


_THICKEST = 3.0  # m


@dataclass(frozen=True)
class Caliper:
    """A diameter [m] measured ``along`` the main path [m], counted from the root."""

    along: float
    diameter: float


def cylinders(skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Length [m] and volume [m^3] of the cylinder below each node but the root, shape [n - 1] each.
    They taper evenly; the first of a twig has the twig's radius all along."""
    step, foot, radius = skeleton.steps[1:], _feet(skeleton), skeleton.radius[1:]
    return step, np.pi / 3 * step * (foot**2 + foot * radius + radius**2)


def by_order(skeleton: Skeleton) -> list[dict[str, float]]:
    """Branch count, length [m], volume [m^3], mean taper [m of radius a m] of each order."""
    step, volume = cylinders(skeleton)
    order, narrowing = skeleton.order[1:], _feet(skeleton) - skeleton.radius[1:]
    table = []
    for value in np.unique(order):
        own = order == value
        runs = np.unique(skeleton.branch[1:][own])
        table.append({"order": int(value), "branch_count": len(runs),
                      "length_m": float(step[own].sum()), "volume_m3": float(volume[own].sum()),
                      "taper": float(narrowing[own].sum() / max(step[own].sum(), 1e-300))})
    return table


def diameters(skeleton: Skeleton, along: np.ndarray) -> np.ndarray:
    """Diameters and their standard deviations [m] at lengths of the main path [m], shape [n, 2].
    """
    path = skeleton.main_path()
    length = skeleton.arc_length[path]
    return 2 * np.stack([np.interp(along, length, values[path])
                         for values in (skeleton.radius, skeleton.radius_sigma)], axis=1)


def diameters_at_heights(skeleton: Skeleton) -> list[dict[str, float]]:
    """Diameter and its standard deviation [m] at HEIGHTS, fractions of the main path."""
    total = float(skeleton.arc_length[skeleton.main_path()[-1]])
    along = total * np.array(HEIGHTS)
    return [{"share": share, "along_m": float(distance), "diameter_m": float(row[0]),
             "sigma_m": float(row[1])}
            for share, distance, row
            in zip(HEIGHTS, along, diameters(skeleton, along), strict=True)]


def against_calipers(skeleton: Skeleton, measured: list[Caliper]) -> list[dict[str, Any]]:
    """Our diameter at each measured one: difference, relative and in ``sigmas``, None where no
    deviation is known. InputError if a position is beyond the main path."""
    total = float(skeleton.arc_length[skeleton.main_path()[-1]])
    along = np.array([one.along for one in measured])
    outside = along[(along < 0) | (along > total)]
    if len(outside):
        raise InputError(
            f"A caliper value is at {outside[0]:.3g} m, but the main path is {total:.3g} m long.",
            "along_m is measured from the root along the main path, in metres.", "Correct along_m.")
    estimated = diameters(skeleton, along)
    return [{"along_m": one.along, "measured_m": one.diameter, "diameter_m": float(row[0]),
             "sigma_m": float(row[1]), "difference": float(row[0] / one.diameter - 1),
             "sigmas": float((row[0] - one.diameter) / row[1]) if row[1] > 0 else None}
            for one, row in zip(measured, estimated, strict=True)]


def read_calipers(path: Path) -> list[Caliper]:
    """Read a CSV file of ``along_m``, from the root along the main path, and ``diameter_mm``.
    InputError if a column is missing or a value not positive."""
    rows = csv_records(path, "a CSV file of caliper values")
    if not rows:
        raise InputError(f"{path} has no values.",
                         "A header and one line for each diameter were expected.",
                         "Give a CSV file with the columns along_m and diameter_mm.")
    missing = [name for name in ("along_m", "diameter_mm") if name not in rows[0]]
    if missing:
        raise InputError(f"{path} lacks the columns {', '.join(missing)}.",
                         "Caliper values need along_m and diameter_mm.", "Rename the columns.")
    try:
        values = [Caliper(float(row["along_m"]), 1e-3 * float(row["diameter_mm"])) for row in rows]
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} has a field that is not a number ({error}).",
                         "Both columns must hold numbers.", "Correct the file.") from error
    for number, one in enumerate(values, start=2):
        if not (0 < one.diameter <= _THICKEST and np.isfinite(one.along)):
            raise InputError(
                f"{path}, line {number}: {1e3 * one.diameter:g} mm at {one.along:g} m.",
                f"A diameter must be positive and at most {_THICKEST:g} m; the column is in "
                "millimetres.", "Correct that line.")
    return values


def _feet(skeleton: Skeleton) -> np.ndarray:
    """Radius at the lower end of the cylinder below each node but the root [m], shape [n - 1]."""
    up = skeleton.parent[1:]
    return np.where(skeleton.branch[1:] == skeleton.branch[up], skeleton.radius[up],
                    skeleton.radius[1:])
