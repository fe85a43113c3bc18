"""Force against displacement, from a load cell on an actuator: stiffness with interval."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from limber.core.constants import FORCE_UNITS_N
from limber.core.errors import InputError, Option
from limber.recordings import tables
from limber.recordings.time_series import saturated

MOVED = (r"displacement|travel|stroke|deflection|extension|crosshead|position|weg|durchbiegung"
         r"|verformung|deplacement|fleche|allongement|course|desplazamiento|deformacion|flecha"
         r"|carrera|recorrido")
FORCE = r"force|load|kraft|^last|pruflast|charge|effort|fuerza|carga"
"""Titles of testing machines in English, German, French and Spanish, in :func:`.plain` letters."""
NOISE_FLOOR_N = 20 * FORCE_UNITS_N["gf"]
"""Force above the unloaded reading that counts as contact [N]; a drop of twice as much is a slip.
"""
_DISTANCE = r"along|from.?(the.?)?base"
"""Title of the column that states where the branch was loaded."""
OBSTACLE = 2.0
"""Growth factor of the slope at a bend above which there is an obstacle behind the branch."""
STIFFENING = 0.3
"""Change of the slope along the push above which it is reported."""

WHY_NO_MODULUS = (
    "A force slope is the stiffness of the whole structure below the contact: proportional to "
    "Young's modulus times radius to the fourth power over length cubed. This file does not "
    "contain the radius along the branch or the position where the branch is held. A radius error "
    "of 10 % alone changes the modulus by 40 %. To get a modulus, reconstruct the branch from a "
    "scan and import the pull with its grasp point.")


@dataclass(frozen=True)
class ForceSlope:
    """Stiffness [N/m] over the loaded part of the outward path, with a 95 % interval that allows
    for correlated residuals; ``contact`` and ``slips`` [m] on the actuator's scale, ``baseline``
    [N] without load. ``stiffening`` is the slope of the second half over that of the first, minus
    1; ``energy_lost`` the fraction of the outward work that is not returned."""

    slope: float
    interval: tuple[float, float]
    contact: float
    contact_seen: bool
    baseline: float
    sample_count: int
    stiffening: float | None
    slips: tuple[float, ...] = ()
    slope_before_slip: float | None = None
    return_slope: float | None = None
    energy_lost: float | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class ForceTable:
    """Displacements [m] and forces [N], shape [n], in the file's order, and the distance of the
    load from the base along the branch [m], if the table has it."""

    displacement: np.ndarray
    force: np.ndarray
    distance: float | None = None
    warnings: tuple[str, ...] = ()


def read_force_displacement(path: Path, *, unit: str | None = None, force_unit: str | None = None,
                            ) -> ForceTable:
    """Read displacement [m] and force [N], found by name in any unit, separator and preamble:
    ``Load Cell Reading (gf)``, ``Displacement (mm)``, ``distance from base (cm)``. Incomplete rows
    are dropped with a warning. InputError for a missing column or unit, fewer than 3 rows, or
    several distances."""
    table = tables.read_table(path)
    force_at, force_scale = _column(table, FORCE, tables.FORCE_NAMES_N, force_unit)
    moved_at, moved_scale = _column(table, MOVED, tables.LENGTH_UNITS_M, unit)
    pairs = table.values[:, [moved_at, force_at]]
    kept = pairs[np.isfinite(pairs).all(axis=1)]
    warnings = list(table.warnings)
    if len(kept) < len(pairs):
        warnings.append(f"{path.name}: {len(pairs) - len(kept)} incomplete row(s) were discarded.")
    if len(kept) < 3:
        raise InputError(f"{path} has too few complete rows ({len(kept)}).",
                         "A slope needs at least three.", "Record more of the push.")
    return ForceTable(kept[:, 0] * moved_scale, kept[:, 1] * force_scale,
                      _distance(table, path), tuple(warnings))


def _distance(table: tables.Table, path: Path) -> float | None:
    """Distance of the load from the base [m], if the table has such a column."""
    if not any(re.search(_DISTANCE, title.lower()) for title in table.titles):
        return None
    at, scale = _column(table, _DISTANCE, tables.LENGTH_UNITS_M, None)
    column = table.values[:, at]
    found = np.unique(column[np.isfinite(column)]) * scale
    if len(found) > 1:
        raise InputError(
            f"{path}: the branch was loaded at {', '.join(f'{value:.4g}' for value in found)} m "
            "from its base.", "A pull has one grasp point.",
            "Make a table for each distance, and import each as a pull of its own. An estimate "
            "uses all of them together.")
    return float(found[0]) if len(found) else None


def force_slope(displacement: np.ndarray, force: np.ndarray, *, warnings: tuple[str, ...] = (),
                ) -> ForceSlope:
    """Fit contact and slope of the outward path, and the slope of the return path if there is one.

    Contact is the bend of a constant followed by a line. The slope is that of a straight line
    through the readings above contact and above the sensor's noise. Its standard error allows for
    correlated residuals, which a curved response or a slip causes.

    Args:
        displacement: [m], shape [n], in the order of time.
        force: [N], shape [n].
        warnings: Known faults; passed on.

    Raises:
        InputError: the force never exceeds the noise.
    """
    messages = list(warnings)
    moved, force = _in_range(np.asarray(displacement, float), np.asarray(force, float), messages)
    moved, force = _oriented(moved, force, messages)
    out, back = _strokes(moved)
    x, y = _sorted(moved[out], force[out])
    contact, baseline, obstacle = _first_contact(x, y)
    loaded = (x > contact) & (y > baseline + NOISE_FLOOR_N) & (x <= obstacle)
    if obstacle < x[-1]:
        messages.append(
            f"From {1e3 * obstacle:.1f} mm the force rises at least {OBSTACLE:.0f} times as "
            f"steeply, so the sensor touches a second object there. {int(np.sum(x > obstacle))} "
            "samples beyond this point were discarded. The slope is that of the first contact.")
    if loaded.sum() < 4:
        raise InputError(
            f"The force rises by {np.ptp(y):.3g} N over {np.ptp(x) * 1e3:.3g} mm.",
            f"Fewer than 4 samples exceed the noise of {NOISE_FLOOR_N:.2g} N.",
            "Push farther, or use a more sensitive sensor.")
    contact_seen = bool(contact > x[0])
    if not contact_seen:
        messages.append("The first sample is already loaded. The file does not show the position "
                        "of contact or the reading without load. The slope is still valid.")
    elif abs(baseline) > NOISE_FLOOR_N:
        messages.append(f"The load cell reads {baseline:.3g} N without load: it was not tared. "
                        "This does not affect the slope.")
    x, y = x[loaded], y[loaded]
    slope, error = _line(x, y)
    width = scipy.special.stdtrit(len(x) - 2, 0.975) * error
    stiffening = _stiffening(x, y)
    slips = _slips(x, y)
    before = float(_line(x[:slips[0] + 1], y[:slips[0] + 1])[0]) if (
        len(slips) and slips[0] >= 3) else None
    if len(slips):
        messages.append(
            f"The force drops suddenly at {', '.join(f'{x[k] * 1e3:.1f}' for k in slips[:4])} mm: "
            "the contact slipped, or the wood broke. "
            + (f"Up to the first drop the slope is {before:.4g} N/m." if before else ""))
    elif stiffening is not None and abs(stiffening) > STIFFENING:
        messages.append(f"The slope changes by {100 * stiffening:+.0f} % along the push: a "
                        "straight line describes it only roughly.")
    if slope <= 0:
        messages.append("The force falls as the actuator advances. Check its sign, and check "
                        "whether the contact slipped.")
    return ForceSlope(
        float(slope), (float(slope - width), float(slope + width)), float(contact), contact_seen,
        float(baseline), len(x), stiffening, tuple(float(x[k]) for k in slips), before,
        *_return(moved[back], force[back], moved[out], force[out], contact, baseline),
        warnings=tuple(messages))


def _column(table: tables.Table, name: str, units: dict[str, float], requested: str | None,
            ) -> tuple[int, float]:
    for index, text in enumerate(table.titles):
        title = tables.split_title(text)
        if not re.search(name, title.plain if name in (FORCE, MOVED) else title.name.lower()):
            continue
        if requested is not None:
            return index, units[requested]
        if title.unit is None:
            raise InputError(f"{table.path}: the column {text!r} does not state a unit. Known "
                             f"units: {', '.join(units)}.", "A number without a unit cannot be "
                             "used.", "Add the unit to the title, for example 'Force (N)', or "
                             "give ", Option("unit"), " and ", Option("force_unit"), ".")
        return index, tables.scale_of(title, units, "", table.path)
    raise InputError(f"{table.path} has the columns {', '.join(table.titles)}.",
                     f"No column name contains one of {name.replace('|', ', ')}.",
                     "Rename the column.")


def _in_range(moved: np.ndarray, force: np.ndarray, messages: list[str],
              ) -> tuple[np.ndarray, np.ndarray]:
    """Leave out readings at the sensor's limit and single outliers."""
    limited = saturated(force[:, None])
    if limited.any() and limited.sum() < 0.8 * len(force):
        messages.append(f"{int(limited.sum())} readings at {np.abs(force[limited]).max():.3g} N "
                        "are identical: the load cell is saturated there. They were discarded, at "
                        f"{_position_text(moved[limited])}.")
        moved, force = moved[~limited], force[~limited]
    # One sample far from both neighbours, on the same side. After a slip readings stay at the new
    # level.
    before, after = force[1:-1] - force[:-2], force[1:-1] - force[2:]
    jump = np.where(before * after > 0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    usual = np.median(np.abs(np.diff(force))) if len(force) > 1 else 0.0
    stray = np.r_[False, jump > max(10 * usual, 2 * NOISE_FLOOR_N), False] if len(force) > 2 else (
        np.zeros(len(force), bool))
    if stray.any():
        messages.append(f"{int(stray.sum())} spike(s) in the force were discarded, at "
                        f"{_position_text(moved[stray])}.")
    return moved[~stray], force[~stray]


def _position_text(moved: np.ndarray) -> str:
    """Displacements [m] of samples in words."""
    positions = [f"{value * 1e3:.1f}" for value in np.sort(moved)]
    if len(positions) > 8:
        return f"{positions[0]} to {positions[-1]} mm"
    return f"{', '.join(positions)} mm"


def _oriented(moved: np.ndarray, force: np.ndarray, messages: list[str],
              ) -> tuple[np.ndarray, np.ndarray]:
    """Set signs so that the actuator advances and the body pushes back."""
    far = int(np.argmax(np.abs(moved - moved[0])))
    if moved[far] < moved[0]:
        messages.append("The displacement decreases as the actuator advances. Its sign was "
                        "reversed.")
        moved = -moved
    far = int(np.argmax(moved))
    change = force[:far + 1] - force[0]
    # Work of the reading relative to its first: negative if the sensor counts pressure negative.
    work = float(np.sum((change[1:] + change[:-1]) / 2 * np.diff(moved[:far + 1])))
    if work < 0 and change.min() < -NOISE_FLOOR_N and -change.min() > 3 * change.max():
        messages.append("The reading falls as the actuator advances. The work done shows that it "
                        "is the force on the sensor. Its sign was reversed.")
        force = -force
    return moved, force


def _strokes(moved: np.ndarray) -> tuple[slice, slice]:
    """The outward path, up to the farthest sample, and the return path."""
    far = int(np.argmax(moved))
    # A hold at the end is no return path.
    returns = moved[far] - moved[-1] > 0.05 * np.ptp(moved) and len(moved) - far > 5
    return slice(0, far + 1 if returns else len(moved)), slice(
        far if returns else len(moved), len(moved))


def _sorted(moved: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(moved, kind="stable")
    return moved[order], force[order]


def _stiffening(x: np.ndarray, y: np.ndarray) -> float | None:
    half = np.median(x)
    if min(np.sum(x <= half), np.sum(x > half)) < 3:
        return None
    lower, upper = (np.polyfit(x[part], y[part], 1)[0] for part in (x <= half, x > half))
    return float(upper / lower - 1) if lower > 0 else None


def _slips(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Indices before which the force drops by more than sensor noise can explain."""
    step = np.diff(y)
    usual = 1.4826 * np.median(np.abs(step - np.median(step)))
    return np.flatnonzero(step < -max(2 * NOISE_FLOOR_N, 6 * usual)) if len(x) > 4 else (
        np.empty(0, int))


def _return(moved: np.ndarray, force: np.ndarray, moved_out: np.ndarray, force_out: np.ndarray,
            contact: float, baseline: float) -> tuple[float | None, float | None]:
    """Slope [N/m] of the return path, and the fraction of the work that was lost."""
    loaded = (moved > contact) & (force > baseline + NOISE_FLOOR_N)
    if loaded.sum() < 4:
        return None, None
    slope = float(_line(*_sorted(moved[loaded], force[loaded]))[0])

    def work(x: np.ndarray, y: np.ndarray) -> float:
        x, y = _sorted(x, y)
        over = np.maximum(y - baseline, 0.0)
        shared = x >= max(contact, moved.min())
        return float(np.sum((over[shared][1:] + over[shared][:-1]) / 2 * np.diff(x[shared])))
    outward = work(moved_out, force_out)
    return slope, float(1 - work(moved, force) / outward) if outward > 0 else None


def _contact(moved: np.ndarray, force: np.ndarray) -> tuple[float, float]:
    """Displacement and reading at the bend of constant-then-quadratic, by search over samples."""
    best = (np.inf, moved[0], force[0])
    for position in moved[: max(len(moved) - 4, 1)]:
        beyond = np.maximum(moved - position, 0.0)
        features = np.column_stack([np.ones(len(moved)), beyond, beyond**2])
        solved, *_ = np.linalg.lstsq(features, force, rcond=None)
        cost = np.sum((force - features @ solved)**2)
        if cost < best[0]:
            best = (cost, position, solved[0])
    return best[1], best[2]


def _first_contact(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Displacement and reading at the first contact, and the start of a later one (or the end): the
    best bend may be that of an obstacle behind the branch; the force has then risen before it."""
    contact, baseline = _contact(x, y)
    end = float(x[-1])
    for _ in range(3):
        before = x < contact
        if before.sum() < 8:
            break
        earlier, reading = _contact(x[before], y[before])
        rising = (x >= earlier) & before
        if rising.sum() < 4 or np.mean(y[before][-3:]) - reading < 2 * NOISE_FLOOR_N:
            break
        slope, _ = _line(x[rising], y[rising])
        beyond = (x >= contact) & (x <= end)
        steeper = _line(x[beyond], y[beyond])[0] if beyond.sum() >= 3 else 0.0
        if slope <= 0 or steeper < OBSTACLE * slope:
            break
        end, contact, baseline = float(contact), earlier, reading
    return contact, baseline, end


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and its standard error: the larger of Newey-West's, too small for few samples, and that
    of a first-order autoregression, too small for long waves."""
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
    # Residuals underestimate the correlation by about this.
    follow = np.clip(follow + (1 + 4 * follow) / len(x), 0.0, 0.95)
    plain = inverse[1, 1] * square / freedom * (1 + follow) / (1 - follow)
    return float(solved[1]), float(np.sqrt(max(robust, plain)))
