"""What stands around a plant in its scan: ground, walls, pots, stakes, posts and wires."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy
from scipy.spatial import cKDTree
from scipy.special import ndtr

from limber.core.errors import InputError, Option, Place, Text
from limber.core.numerics.rigid import principal_axes
from limber.geometry.cloud.cloud import own_order

# Pots, stakes, posts and wires in a scan of a plant, found by their shape and never removed.
#
# A pot is a body turned about an upright axis at the foot of the scan, which ends where the stem
# leaves it. A stake is straight to a fraction of its radius and as thick above as below, for far
# longer than wood is. A wire of a trellis is a thin line of even thickness, straight from above and
# at most sagging from the side, from one support or border of the scan to another.

_SUPPORT_SAMPLE = 100_000  # points that show supports
_SLICES = 40  # over the height of the scan
_LEAST = 8  # points of a slice's circle
_ROUND = 0.08  # fraction of the radius by which the points of a circle scatter
_ON_CIRCLE = 0.6  # fraction of a slice's points that must be on its circle
# Slices of a pot at least; the fraction of the next slice's points that go on with it, and its
# height over its radius, at most.
_POT_SLICES, _GOES_ON, _TALL = 3, 0.2, 4.0
_STEADY = 0.25  # largest change of a pot's radius from slice to slice
_LONG = 14  # slices that a stake crosses at least
# A stake: scatter of its middles over its radius, and of the logarithms of its radii; fall of these
# over its length; slope against the upright.
_STRAIGHT, _EVEN, _FALL, _SLOPE = 0.15, 0.12, 0.08, 0.27
_STAKES_MOST = 3
_ROD_POINTS = 8000  # points that show a stake's circles, 200 a slice
_STAKE_WIDTHS = (0.5, 2.0)  # thicknesses of a slice around its first middle: where a stake may be
_THICK_POST = 0.02  # radius of a post [m]; thinner ones are stakes
# A wire is looked for among so many points, from so many places that are on thin lines at this
# fraction of the scan's diagonal.
_WIRE_POINTS, _WIRE_STARTS, _WIRE_SCALE = 20_000, 120, 0.03
_LINE = 0.1  # largest second spread of points on a thin line, over the first
# A wire: length over its radius, at least; sag over its length, slope, distance of its ends from a
# support or the scan's border over its length, at most; fraction of its slices without points, and
# with points around it as of laterals, at most.
_THIN, _SAG, _WIRE_SLOPE, _ENDS = 120.0, 0.1, 0.6, 0.04
_MISSING, _LATERALS = 0.15, 0.3
_BESIDE = (3.0, 8.0)  # radii between which points beside a wire show a lateral
_WIRES_MOST = 12


@dataclass(frozen=True)
class Support:
    """A ``pot``, ``stake``, ``post`` or ``wire``: indices of its points in the scan, and ``at`` [3]
    [m], the one in its middle."""

    kind: str
    points: np.ndarray
    at: np.ndarray


def find_supports(points: np.ndarray, up: np.ndarray) -> list[Support]:
    """Return the pot, the stakes, the posts and the wires in a scan of points [n, 3] [m]."""
    some = np.arange(0, len(points), len(points) // _SUPPORT_SAMPLE + 1)
    found = _in_sample(points[some], up / np.linalg.norm(up))
    if len(some) < len(points) and found:
        near = cKDTree(points[some]).query(points)[1]
        found = [replace(each, points=np.flatnonzero(np.isin(near, each.points))) for each in found]
    return found


def supports_text(supports: list[Support], count: int) -> Text:
    """Return a sentence that names the supports, at least one, of a scan of ``count`` points."""
    named = [Text(f"a {each.kind} ({100 * len(each.points) / count:.0f} % of the points) at ",
                  Place(each.at)) for each in supports]
    return Text("The scan shows ", Text.joined(" and ", named), ": remove such points from the "
                "scan (", Option("crop"), ", or in another program), or they count as the plant's.")


@contextmanager
def named_if_refused(text: str) -> Iterator[None]:
    """Add a sentence about a scan's supports, if there is one, to a refusal of the scan."""
    try:
        yield
    except InputError as error:
        if text:
            error.adding(text)
        raise


def _in_sample(points: np.ndarray, up: np.ndarray) -> list[Support]:
    """The supports among points [m], shape [n, 3]; ``up`` is a unit vector."""
    across = np.linalg.svd(up[None])[2][1:]
    height, flat = points @ up, points @ across.T
    thick = max(float(np.ptp(height)) / _SLICES, 1e-12)
    layer = np.minimum(((height - height.min()) / thick).astype(np.int64), _SLICES - 1)
    pot = _pot(flat, layer, thick)
    found = [] if pot is None else [("pot", pot)]
    rest = np.ones(len(points), bool)
    if pot is not None:
        rest[pot] = False
    for _ in range(_STAKES_MOST):
        stake = _stake(flat, layer, height, np.flatnonzero(rest), thick)
        if stake is None:
            break
        own, radius = stake
        rest[own] = False
        found.append(("post" if radius > _THICK_POST else "stake", own))
    held = points[np.concatenate([own for _, own in found])] if found else np.empty((0, 3))
    found += [("wire", own) for own in _wires(points, np.column_stack([flat, height]),
                                              np.flatnonzero(rest), held @ np.vstack(
                                                  [across, up]).T)]
    return [Support(kind, own, points[own][np.argmin(np.linalg.norm(
        points[own] - np.median(points[own], axis=0), axis=1))]) for kind, own in found]


def _circles(flat: np.ndarray, layer: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Circles through most points ``flat`` [n, 2] [m] of each slice ``layer`` [n]: middles
    [slices, 2] and radii [m], and the fraction of points on them, which is 0 for too few points."""
    count = np.bincount(layer, minlength=_SLICES)
    total = np.stack([np.bincount(layer, values, _SLICES) for values in flat.T], axis=1)
    start = total / np.maximum(count, 1)[:, None]
    own = flat - start[layer]
    row = np.column_stack([2 * own, np.ones(len(own)), (own**2).sum(axis=1)])
    one, other = np.triu_indices(4)
    products, weight = row[:, one] * row[:, other], np.ones(len(own))
    ends = np.cumsum(count)
    for _ in range(8):
        system = np.zeros((_SLICES, 4, 4))
        for k in range(len(one)):
            system[:, one[k], other[k]] = system[:, other[k], one[k]] = np.bincount(
                layer, products[:, k] * weight**2, _SLICES)
        # A slice of points on a line has no circle.
        system[:, [0, 1, 2], [0, 1, 2]] += 1e-12 * system[:, [0, 1, 2], [0, 1, 2]] + 1e-300
        x, y, c = np.linalg.solve(system[:, :3, :3], system[:, :3, 3:])[:, :, 0].T
        radius = np.sqrt(np.maximum(c + x**2 + y**2, 1e-18))
        off = np.abs(np.hypot(own[:, 0] - x[layer], own[:, 1] - y[layer]) - radius[layer])
        ordered = np.append(off[np.lexsort((off, layer))], [np.inf, np.inf])
        middle = ends - count + np.maximum(count - 1, 0) // 2
        usual = (ordered[middle] + ordered[middle + (count % 2 == 0)]) / 2
        weight = 1 / (1 + (off / np.maximum(usual, 0.02 * radius)[layer])**2)
    on = np.bincount(layer[off < 3 * _ROUND * radius[layer]], minlength=_SLICES)
    return start + np.stack([x, y], axis=1), radius, np.where(
        count < _LEAST, 0.0, on / np.maximum(count, 1))


def _pot(flat: np.ndarray, layer: np.ndarray, thick: float) -> np.ndarray | None:
    """Indices of the points of a pot at the foot of the scan; None if there is none."""
    circles: list[tuple[np.ndarray, float]] = []
    low = layer <= _SLICES // 2
    for number, (middle, radius, share) in enumerate(zip(*_circles(flat[low], layer[low]),
                                                         strict=True)):
        # Its soil fills the last slice; the scan's first slice may be a part of one.
        if number >= _SLICES // 2 or share < _ON_CIRCLE or (circles and (
                abs(radius / circles[-1][1] - 1) > _STEADY
                or np.linalg.norm(middle - circles[-1][0]) > _STEADY * radius)):
            if circles or number > 1:
                break
            continue
        circles.append((middle, radius))
    if len(circles) < _POT_SLICES:
        return None
    top = number - 1
    middle, radius = circles[-1]
    distance = np.linalg.norm(flat - middle, axis=1)
    above = distance[layer == top + 1]
    goes_on = np.mean(np.abs(above - radius) < 3 * _ROUND * radius) if len(above) else 1.0
    if goes_on > _GOES_ON or len(circles) * thick > _TALL * radius:
        return None
    return np.flatnonzero((layer <= top) & (distance < 1.2 * radius))


def _stake(flat: np.ndarray, layer: np.ndarray, height: np.ndarray, rest: np.ndarray,
           thick: float) -> tuple[np.ndarray, float] | None:
    """Indices of the points of the longest stake among ``rest``, and its radius [m]."""
    cell, of = np.unique(np.floor(flat[rest] / thick).astype(np.int64), axis=0, return_inverse=True)
    pairs = np.unique(np.column_stack([of.ravel(), layer[rest]]), axis=0)
    crossed = np.bincount(pairs[:, 0], minlength=len(cell))
    for start in np.argsort(-crossed, kind="stable")[:2 * _STAKES_MOST]:
        if crossed[start] < _LONG:
            return None
        middle = np.median(flat[rest[of.ravel() == start]], axis=0)
        for wide in _STAKE_WIDTHS:
            told = _rod(flat, layer, height, rest, middle, wide * thick)
            if told is not None:
                return told
    return None


def _rod(flat: np.ndarray, layer: np.ndarray, height: np.ndarray, rest: np.ndarray,
         start: np.ndarray, reach: float) -> tuple[np.ndarray, float] | None:
    """The stake through ``start`` [m], shape [2]: its points and radius; None if there is none."""
    line = np.array([[start[0], 0.0], [start[1], 0.0]])
    for _ in range(4):
        aside = np.linalg.norm(flat[rest] - line[:, 0] - height[rest, None] * line[:, 1], axis=1)
        near = rest[aside < reach]
        some = near[own_order(flat[near])[:_ROD_POINTS]] if len(near) else near
        middle, radius, share = _circles(flat[some], layer[some])
        used = (share > _ON_CIRCLE) & (radius < reach)
        if used.sum() < _LONG:
            return None
        level = (np.bincount(layer[some], height[some], _SLICES)[used]
                 / np.bincount(layer[some], minlength=_SLICES)[used])
        (x, y), radius = middle[used].T, radius[used]
        line = np.array([_line(level, x), _line(level, y)])
        reach = 1.5 * float(np.median(radius))
    size = float(np.median(radius))
    off = np.hypot(x - line[0, 0] - line[0, 1] * level, y - line[1, 0] - line[1, 1] * level)
    scatter = np.abs(np.log(radius / size))
    fall = abs(_line(level, np.log(radius))[1]) * float(np.ptp(level))
    if (np.median(off) > _STRAIGHT * size or np.median(scatter) > _EVEN or fall > _FALL
            or np.linalg.norm(line[:, 1]) > _SLOPE):
        return None
    return near, size


def _wires(points: np.ndarray, placed: np.ndarray, rest: np.ndarray, held: np.ndarray,
           ) -> list[np.ndarray]:
    """Indices of the points of each wire among ``rest`` [r], which are on no other support.
    ``placed`` is the sample, and ``held`` [k, 3] other supports, with the height last."""
    size = float(np.linalg.norm(np.ptp(placed, axis=0)))
    if len(rest) < _LONG * _LEAST:
        return []
    rest = rest[own_order(points[rest])][:_WIRE_POINTS]
    places, reach, found = placed[rest], _WIRE_SCALE * size, list[np.ndarray]()
    free, tried, tree = np.ones(len(rest), bool), np.zeros(len(rest), bool), cKDTree(places)
    supports = cKDTree(held) if len(held) else None
    for start in range(min(_WIRE_STARTS, len(rest))):
        if tried[start] or not free[start] or len(found) == _WIRES_MOST:
            continue
        near = tree.query_ball_point(places[start], reach)
        if len(near) < _LEAST:
            continue
        spread, axes = np.linalg.eigh(np.cov(places[near].T))
        if spread[1] > _LINE**2 * spread[2] or abs(axes[2, 2]) > _WIRE_SLOPE:
            continue
        tried[near] = True
        told = _wire(places, free, supports, placed, places[near].mean(axis=0), axes[:, 2], reach)
        if told is not None:
            found.append(told)
            free &= ~np.isin(rest, told)
    return found


def _wire(places: np.ndarray, free: np.ndarray, supports: cKDTree | None, every: np.ndarray,
          middle: np.ndarray, way: np.ndarray, reach: float) -> np.ndarray | None:
    """Indices among ``every`` [n, 3] of the wire through ``middle`` [3] along ``way`` [3], seen
    over ``reach`` [m] to both sides; None if that is none. ``free`` says which ``places`` [r, 3] it
    may take; all positions have the height last."""
    way = np.array([way[0], way[1], 0.0]) / np.hypot(way[0], way[1])
    aside = np.array([-way[1], way[0], 0.0])
    frame = np.array([way, aside, [0.0, 0.0, 1.0]])
    own = (places[free] - middle) @ frame.T
    # It grows from what is known of it: a line from above, a parabola from the side.
    line, hang, wide = np.zeros(2), np.zeros(3), 0.1 * reach
    low = high = 0.0
    for _ in range(40):
        off = _off(own, line, hang)
        near = (np.abs(own[:, 0] - (low + high) / 2) < (high - low) / 2 + reach) & (
            np.linalg.norm(off, axis=1) < wide)
        along = own[near, 0]
        if len(along) < _LEAST or np.ptp(along) < 1e-3 * reach:
            return None
        line, hang = np.polyfit(along, own[near, 1], 1), np.polyfit(
            along, own[near, 2], 2 if high - low > 6 * reach else 1)
        hang = np.pad(hang, (3 - len(hang), 0))
        wide = max(4 * float(np.median(np.linalg.norm(_off(own[near], line, hang), axis=1))), 1e-9)
        if along.min() > low - 1e-3 * reach and along.max() < high + 1e-3 * reach and high > low:
            break
        low, high = float(along.min()), float(along.max())
    return _proven(((every - middle) @ frame.T), line, hang, wide, (low, high), supports,
                   lambda ends: ends @ frame + middle)


def _off(own: np.ndarray, line: np.ndarray, hang: np.ndarray) -> np.ndarray:
    """Offset of points from a wire, aside and in height [m], shape [n, 2]."""
    return np.column_stack([own[:, 1] - np.polyval(line, own[:, 0]),
                            own[:, 2] - np.polyval(hang, own[:, 0])])


def _proven(own: np.ndarray, line: np.ndarray, hang: np.ndarray, wide: float,
            span: tuple[float, float], supports: cKDTree | None,
            back: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | None:
    """Indices of the points of a line, if it is thin, even, bare and held as a wire is."""
    low, high = span
    long, off = high - low, np.linalg.norm(_off(own, line, hang), axis=1)
    inside = (own[:, 0] >= low) & (own[:, 0] <= high)
    near = np.flatnonzero(inside & (off < wide))
    size = float(np.sqrt(np.mean(off[near]**2))) if len(near) else 0.0
    if size <= 0 or long < _THIN * size or abs(hang[0]) * long**2 / 4 > _SAG * long or (
            hang[0] * long**2 / 4 < -size or abs(hang[1]) > _WIRE_SLOPE):
        return None
    slices = np.minimum(((own[:, 0] - low) / long * _SLICES).astype(np.int64), _SLICES - 1)
    rows, beside = [], 0
    shell = inside & (off > _BESIDE[0] * size) & (off < _BESIDE[1] * size)
    for number in range(_SLICES):
        part = near[slices[near] == number]
        beside += int((shell & (slices == number)).sum() > len(part) / 4)
        if len(part) >= 3:
            middle = np.mean(_off(own[part], line, hang), axis=0)
            rows.append((number / _SLICES, np.linalg.norm(middle),
                         np.log(max(np.sqrt(np.mean(off[part]**2)), 1e-300))))
    level, bent, radius = np.array(rows).reshape(-1, 3).T
    if len(rows) < (1 - _MISSING) * _SLICES or beside > _LATERALS * _SLICES or (
            np.median(bent) > 2 * _STRAIGHT * size or abs(_line(level, radius)[1]) > 2 * _EVEN
            or np.median(np.abs(radius - np.median(radius))) > 2 * _EVEN):
        return None
    for end, beyond in ((low, own[:, 0] < low - _ENDS * long),
                        (high, own[:, 0] > high + _ENDS * long)):
        place = np.array([end, np.polyval(line, end), np.polyval(hang, end)])
        if beyond.any() and (supports is None or supports.query(back(place))[0] > _ENDS * long):
            return None
    return near


def _line(level: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Value at level 0 and slope of the line through most values (Theil and Sen)."""
    one, other = np.triu_indices(len(level), 1)
    apart = level[other] - level[one]
    slope = float(np.median((values[other] - values[one])[apart > 0] / apart[apart > 0]))
    return np.array([np.median(values - slope * level), slope])


# Walls and ground in a scan: wide flat sheets, which branches do not have.

_SAMPLE = 400
_PLANE_POINTS = 150  # fewest points that define a plane
# Neighbourhood of a point, as a fraction of the cloud's diagonal, and at least in spacings of all
# points, were they spread evenly over a square as wide.
_REACH, _WIDE = 0.05, 1.5
_FLAT, _ELONGATED = 0.01, 0.3  # variance across and along a sheet, over the next larger
_TRIES = 200
_IN_PLANE = 3  # fewest flat neighbourhoods that span a plane
_BROAD = 0.11  # smallest standard deviation across a sheet, over the diagonal; leaves have 0.08


class Sheet(NamedTuple):
    """Mask ``on`` [n] of points on a plane, and the probability that they fill it evenly, as a wall
    does, and not along lines, as twigs of a flat-grown plant do."""

    on: np.ndarray
    probability: float


def find_sheet(points: np.ndarray, least: float) -> Sheet | None:
    """Return the largest plane that points [n, 3] [m] may fill in both directions; None if none has
    ``least`` points."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    reach = diagonal * max(_REACH, _WIDE / np.sqrt(len(points)))
    order, rng = own_order(points), np.random.default_rng(0)
    sample = order[:_SAMPLE]
    # Tested on as many points as the sample needs; fewer points do not make a sheet less flat.
    dense = points[order[-20 * _SAMPLE:]]
    tree = cKDTree(dense)
    centres, normals, spreads = [], [], []
    for point, near in zip(points[sample], tree.query_ball_point(points[sample], reach),
                           strict=True):
        if len(near) > 10:
            near = near[::len(near) // _PLANE_POINTS + 1]
            values, axes = np.linalg.eigh(np.cov(dense[near].T))
            if values[0] < _FLAT * values[1] and values[1] > _ELONGATED * values[2]:
                centres.append(point)
                normals.append(axes[:, 0])
                spreads.append(values[0])
    if len(centres) < max(10, 0.5 * least / len(points) * len(sample)):
        return None
    middles, across = np.array(centres), np.array(normals)
    thick = 4 * float(np.sqrt(np.median(spreads))) + 1e-4 * diagonal
    best, share = np.zeros(len(middles), bool), 0
    for start in rng.permutation(len(middles))[:_TRIES]:
        on = np.abs((middles - middles[start]) @ across[start]) < 2 * thick
        on &= np.abs(across @ across[start]) > 0.9
        if on.sum() > share:
            best, share = on, int(on.sum())
    if share < _IN_PLANE:
        return None
    middle = middles[best].mean(axis=0)
    axes = principal_axes(middles[best])
    offset = (points - middle) @ axes.T
    on = np.abs(offset[:, 2]) < thick
    return None if on.sum() < least else Sheet(on, _even(offset[order[on[order]], :2], diagonal))


def _even(flat: np.ndarray, diagonal: float) -> float:
    """The probability that points of a plane, shape [n, 2], fill an area evenly, and are no
    flat-grown plant.

    Twice as far around a point there are four times as many of an even sheet, also beside its
    border, and twice as many of a curve. Each scale between a few points and the sheet's size
    is asked which of the two explains its counts: twigs are curves up to the gap between them. How
    sure the least even scale is follows from the scatter between discs that do not overlap.
    """
    size = flat.std(axis=0).min()
    if size < _BROAD * diagonal:
        return 0.0
    tree, some = cKDTree(flat), flat[:20 * _SAMPLE:5]
    least = max(3, len(flat) // 200)  # wider than a scanner's lines are apart
    near = float(np.median(tree.query(some, k=least + 1)[0][:, -1]))
    least_even = np.inf
    while 0 < 2 * near <= size:
        left, logs = some, list[float]()
        while len(left):
            off = np.linalg.norm(flat - left[0], axis=1)
            inner, both = int((off < near).sum()) - 1, int((off < 2 * near).sum()) - 1
            logs.append((both - inner) * np.log(1.5) - inner * np.log(2))
            left = left[np.linalg.norm(left - left[0], axis=1) > 4 * near]
        least_even = min(least_even, sum(logs) / max(float(np.linalg.norm(logs)), 1e-12))
        near *= np.sqrt(2)
    return float(ndtr(least_even))


# Ground in a scan, rough or on a slope: one layer of points below everything else.
#
# Seen from above in cells, ground is in most of them, roughly in one plane, no thicker than its
# roughness, and with nothing just above it except where a plant stands. The lower side of a crown
# is not ground: points continue above it.

_CELL = 0.03  # fraction of the cloud's diagonal
_LEAST_CELLS, _FILLED = 40, 0.25  # fewest cells of ground, and how much of their box they fill
_STEEPEST = np.deg2rad(40.0)
_ROUGH = 0.03  # largest deviation of the ground from its plane, over the diagonal
_BELOW, _NOTHING = 4.0, 0.03  # standard deviations below the plane; largest fraction of cells there
_LAYER = 3.5  # standard deviations around a cell's ground within which points belong to it
_ABOVE = 0.3  # largest fraction of cells with points in the next layer (plants)
_ROUNDS = 10


def find_ground(points: np.ndarray, up: np.ndarray, least: float) -> np.ndarray | None:
    """Mask [n] of the points [n, 3] [m] on the ground below a plant; None if none has ``least``."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    up = up / np.linalg.norm(up)
    across = np.linalg.svd(up[None])[2][1:]
    flat, height = points @ across.T, points @ up
    index = np.floor((flat - flat.min(axis=0)) / (_CELL * diagonal)).astype(np.int64)
    shape = tuple(index.max(axis=0) + 1)
    where, cell = np.unique(np.ravel_multi_index(tuple(index.T), shape), return_inverse=True)
    count = np.bincount(cell)
    middle = np.stack([np.bincount(cell, values) for values in flat.T], axis=1) / count[:, None]
    if len(count) < _LEAST_CELLS or middle.std(axis=0).min() < _BROAD * diagonal:
        return None
    low = np.full(len(count), np.inf)
    np.minimum.at(low, cell, height)
    plane, rough = _plane(middle, low)
    off = low - plane(middle)
    slope = float(np.hypot(*(plane(np.eye(2)) - plane(np.zeros((1, 2))))))
    if (slope > np.tan(_STEEPEST) or rough > _ROUGH * diagonal
            or np.mean(off < -_BELOW * rough) > _NOTHING):
        return None
    # Bumps are followed from the lower points of the neighbouring cells; a stem's cell has none
    # lower.
    bumps = np.full(shape, np.nan)
    bumps.ravel()[where] = np.clip(off, -_BELOW * rough, _BELOW * rough)
    bumps = scipy.ndimage.generic_filter(bumps, _known_median, size=3, mode="constant", cval=np.nan)
    over = height - plane(flat) - bumps.ravel()[where][cell]
    near = over < 2 * _BELOW * rough
    thick = 1.4826 * float(np.median(np.abs(over[near] - np.median(over[near]))))
    top = float(np.median(over[near])) + _LAYER * thick
    ground = over < top
    next_layer = np.bincount(cell[(over > top) & (over < 2 * top)], minlength=len(count)) > 0
    cells = middle[np.bincount(cell[ground], minlength=len(count)) > 0]
    is_ground = ground.sum() >= least and np.mean(next_layer) <= _ABOVE and len(cells) * (
        _CELL * diagonal)**2 > _FILLED * float(np.prod(np.ptp(cells, axis=0)))
    return ground if is_ground else None


def _known_median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else np.nan


def _plane(middle: np.ndarray, low: np.ndarray):
    """The plane through the cells' lowest points, and their median distance from it [m]. It is
    reweighted, since plants have lower points over the ground of some cells."""
    system = np.column_stack([middle, np.ones(len(middle))])
    weight = np.ones(len(middle))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(root * system, root[:, 0] * low, rcond=None)[0]
        off = low - system @ found
        rough = 1.4826 * float(np.median(np.abs(off))) + 1e-12
        weight = 1 / (1 + (off / rough)**2)

    def plane(flat: np.ndarray) -> np.ndarray:
        return flat @ found[:2] + found[2]
    return plane, rough
