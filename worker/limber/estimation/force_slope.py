"""Force against displacement, as a load cell on an actuator gives it: how stiff, with interval."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from limber.errors import InputError
from limber.estimation.checks import FORCE_UNITS_N

NOISE_FLOOR_N = 20 * FORCE_UNITS_N["gf"]
"""Force over the unloaded reading that counts as contact [N]."""

WHY_NO_MODULUS = (
    "A force slope is the stiffness of the whole structure below the contact: proportional to "
    "Young's modulus times radius to the fourth power over length cubed. Radius along the branch "
    "and where it is held are not in this file; a radius wrong by 10 % alone changes the modulus "
    "by 40 %. Reconstruct the branch from a scan and import the pull with its grasp point to get "
    "a modulus.")


@dataclass(frozen=True)
class ForceSlope:
    """Stiffness seen by the actuator.

    Attributes:
        slope: [N/m] over the loaded part.
        interval: Its 95 % interval [N/m]; wide enough for residuals that follow each other.
        contact: Displacement at which force sets in [m], on the actuator's scale.
        baseline: Reading without load [N].
        sample_count: Samples in the loaded part.
        stiffening: Slope of the second half of the loaded part over that of the first, minus 1.
        warnings: What in the file is not as it should be.
    """

    slope: float
    interval: tuple[float, float]
    contact: float
    baseline: float
    sample_count: int
    stiffening: float
    warnings: tuple[str, ...] = ()


def read_force_displacement(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Read displacement [m] and force [N]; units are taken from the header's brackets.

    Columns are found by name: ``Load Cell Reading (gf)`` or ``force [N]``, ``Displacement (mm)``.
    Rows that are not complete are dropped with a warning.

    Raises:
        InputError: a column or its unit is missing, or under 5 rows are left.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read ({error}).", "A CSV file was expected.",
                         "Check the path.") from error
    header = rows[0] if rows else []
    force_at, force_scale = _column(path, header, r"force|load", FORCE_UNITS_N | {"N": 1.0})
    moved_at, moved_scale = _column(path, header, r"displacement|travel|position",
                                    {"mm": 1e-3, "cm": 1e-2, "m": 1.0})
    values = [_pair(row, force_at, moved_at) for row in rows[1:]]
    kept = np.array([pair for pair in values if pair is not None], float).reshape(-1, 2)
    lost = len(values) - len(kept)
    warnings = (f"{path.name}: {lost} incomplete row(s) were dropped.",) if lost else ()
    if len(kept) < 5:
        raise InputError(f"{path} has {len(kept)} complete rows.", "Five are needed for a slope.",
                         "Record more of the push.")
    return kept[:, 1] * moved_scale, kept[:, 0] * force_scale, warnings


def force_slope(displacement: np.ndarray, force: np.ndarray, *, warnings: tuple[str, ...] = (),
                ) -> ForceSlope:
    """Fit contact and slope.

    Contact is the bend of a constant followed by a line. The slope is that of a straight line
    through what lies over contact and the sensor's noise; its standard error allows for residuals
    that are not independent, as a curved response leaves them.

    Raises:
        InputError: the force never rises out of the noise.
    """
    order = np.argsort(displacement, kind="stable")
    moved, force = np.asarray(displacement)[order], np.asarray(force)[order]
    messages = list(warnings)
    contact, baseline = _contact(moved, force)
    loaded = (moved > contact) & (force > baseline + NOISE_FLOOR_N)
    if loaded.sum() < 4:
        raise InputError(
            f"The force rises by {np.ptp(force):.3g} N over {np.ptp(moved) * 1e3:.3g} mm.",
            f"Fewer than 4 samples lie over the noise of {NOISE_FLOOR_N:.2g} N.",
            "Push farther, or use a more sensitive sensor.")
    if abs(baseline) > NOISE_FLOOR_N:
        messages.append(f"The load cell reads {baseline:.3g} N without load: not tared. The slope "
                        "does not depend on it.")
    x, y = moved[loaded], force[loaded]
    slope, error = _line(x, y)
    width = stats.t.ppf(0.975, len(x) - 2) * error
    half = np.median(x)
    stiffening = np.nan
    if min(np.sum(x <= half), np.sum(x > half)) >= 3:
        lower, upper = (np.polyfit(x[s], y[s], 1)[0] for s in (x <= half, x > half))
        stiffening = float(upper / lower - 1) if lower > 0 else np.nan
    if slope <= 0:
        messages.append("The force falls as the actuator advances: sign or slip?")
    return ForceSlope(float(slope), (float(slope - width), float(slope + width)), float(contact),
                      float(baseline), len(x), stiffening, tuple(messages))


def _column(path: Path, header: list[str], name: str, units: dict[str, float]) -> tuple[int, float]:
    for index, title in enumerate(header):
        if not re.search(name, title, re.IGNORECASE):
            continue
        unit = re.search(r"[(\[]\s*(\w+)\s*[)\]]|_(\w+)$", title)
        symbol = next((group for group in unit.groups() if group), "") if unit else ""
        known = {key.lower(): value for key, value in units.items()}
        if symbol.lower() in known:
            return index, known[symbol.lower()]
        raise InputError(f"{path}: the column {title!r} names no unit out of {', '.join(units)}.",
                         "A number without unit cannot be used.", "Add it: 'Force (N)'.")
    raise InputError(f"{path} has the columns {', '.join(header)}.",
                     f"None is named like {name.replace('|', ' or ')}.", "Rename the column.")


def _pair(row: list[str], force_at: int, moved_at: int) -> tuple[float, float] | None:
    try:
        pair = float(row[force_at]), float(row[moved_at])
    except (ValueError, IndexError):
        return None
    return pair if np.isfinite(pair).all() else None


def _contact(moved: np.ndarray, force: np.ndarray) -> tuple[float, float]:
    """Displacement and reading at the bend of constant-then-quadratic, by search over samples."""
    best = (np.inf, moved[0], force[0])
    for place in moved[: max(len(moved) - 4, 1)]:
        beyond = np.maximum(moved - place, 0.0)
        features = np.column_stack([np.ones(len(moved)), beyond, beyond**2])
        solved, *_ = np.linalg.lstsq(features, force, rcond=None)
        cost = np.sum((force - features @ solved)**2)
        if cost < best[0]:
            best = (cost, place, solved[0])
    return best[1], best[2]


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and its standard error: Newey and West's, or that of a first-order autoregression.

    The larger counts: the former is too small for few samples, the latter for long waves.
    """
    features = np.column_stack([np.ones(len(x)), x - x.mean()])
    inverse = np.linalg.inv(features.T @ features)
    solved = inverse @ features.T @ y
    residual = y - features @ solved
    scores = features * residual[:, None]
    meat = scores.T @ scores
    lags = min(int(np.ceil(4 * (len(x) / 100) ** (2 / 9))) + 1, len(x) - 2)
    for lag in range(1, lags + 1):
        cross = scores[lag:].T @ scores[:-lag]
        meat += (1 - lag / (lags + 1)) * (cross + cross.T)
    freedom = len(x) - 2
    robust = (inverse @ meat @ inverse)[1, 1] * len(x) / freedom
    square = float(residual @ residual)
    follow = float(residual[1:] @ residual[:-1]) / square if square > 0 else 0.0
    # Estimated from residuals, the correlation comes out too small by about this.
    follow = np.clip(follow + (1 + 4 * follow) / len(x), 0.0, 0.95)
    plain = inverse[1, 1] * square / freedom * (1 + follow) / (1 - follow)
    return float(solved[1]), float(np.sqrt(max(robust, plain)))
