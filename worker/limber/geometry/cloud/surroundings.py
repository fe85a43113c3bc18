"""What stands around a plant in its scan: ground, walls, pots, stakes, posts and wires.

Shapes propose parts of a scan: circles in slices, lines, planes, a lowest layer. What speaks
against each is measured without unit, 0 for a perfect one of its kind. One table of weights,
trained by ``benchmarks.part_training`` on scenes with truth, makes odds of it.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree
from scipy.special import expit, log_ndtr

from limber.core.errors import InputError, Option, Place, Text
from limber.core.files.reading import read_arrays
from limber.core.numerics.rigid import principal_axes
from limber.geometry.cloud.cloud import own_order
from limber.geometry.settings import OPEN

ODDS = Path(__file__).with_name("part_odds.npz")
_MOST = 5.0  # most that speaks against a part in one way


class Part(NamedTuple):
    """A part of a scan that may be a ``kind`` of thing: indices of its points, the logarithm of its
    odds, and what speaks ``against`` it."""

    kind: str
    points: np.ndarray
    log_odds: float
    against: np.ndarray = np.zeros(0)

    @classmethod
    def judged(cls, kind: str, points: np.ndarray, against: list[float]) -> "Part":
        """A part with the trained odds of its kind."""
        weights, seen = _weights()[MODEL.get(kind, kind)], np.minimum(against, _MOST)
        return cls(kind, points, float(weights[0] + weights[1:] @ seen), seen)

    @property
    def probability(self) -> float:
        return float(expit(self.log_odds))


MODEL = {"post": "stake"}
"""Kinds that have the odds of another."""


def middle(points: np.ndarray) -> np.ndarray:
    """The one of points [n, 3] that is nearest to their middle: that itself may be empty."""
    return points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]


@cache
def _weights() -> dict[str, np.ndarray]:
    return read_arrays(ODDS, "the odds of a scan's parts, a part of Limber")


# Pots, stakes, posts and wires: never removed.
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
_RODS = 6  # places where most slices have points: where stakes may be
_ROD_POINTS = 8000  # points that show a stake's circles, 200 a slice
_STAKE_WIDTHS = (0.5, 2.0)  # thicknesses of a slice around its first middle: where a stake may be
_EVEN = 0.02  # scatter of a perfect stake's or wire's thickness as a scan shows it, of a logarithm
_AROUND, _FOOT = (2.0, 5.0), 0.02  # radii around a stake; fraction of what is beyond, lowest
_THICK_POST = 0.02  # radius of a post [m]; thinner ones are stakes
# A wire is looked for among so many points, from so many places that are on thin lines at this
# fraction of the scan's diagonal.
_WIRE_POINTS, _WIRE_STARTS, _WIRE_SCALE = 20_000, 120, 0.03
# Largest second spread of points on a thin line, over the first, and its largest rise.
_LINE, _STEEP = 0.1, 0.6
_BESIDE = (3.0, 8.0)  # radii between which points beside a wire show a lateral


def find_supports(points: np.ndarray, up: np.ndarray) -> list[Part]:
    """Return what may be pots, stakes, posts and wires in a scan of points [n, 3] [m]."""
    some = np.arange(0, len(points), len(points) // _SUPPORT_SAMPLE + 1)
    sample, placed = points[some], upright(points[some], up)
    found = _likely(bodies(placed), len(some))
    found += _likely(wires(sample, placed, found), len(some))
    if len(some) < len(points) and found:
        near = cKDTree(sample).query(points)[1]
        found = [each._replace(points=np.flatnonzero(np.isin(near, each.points)))
                 for each in found]
    return found


def supports_text(supports: list[Part], points: np.ndarray) -> Text:
    """Return a sentence that names the supports, at least one, of a scan of points [n, 3]."""
    named = [Text(f"{'' if each.probability >= OPEN else 'perhaps '}a {each.kind} ("
                  f"{100 * len(each.points) / len(points):.0f} % of the points"
                  f"{'' if each.probability >= OPEN else f', probability {each.probability:.2f}'}"
                  ") at ", Place(middle(points[each.points]))) for each in supports]
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


def _likely(parts: Iterable[Part], count: int) -> list[Part]:
    """Parts that are not unlikely, the likeliest first; most points of each are in no other."""
    free, found = np.ones(count, bool), list[Part]()
    for part in sorted(parts, key=lambda each: -each.log_odds):
        if part.probability > 1 - OPEN and free[part.points].mean() > 0.5:
            found.append(part._replace(points=part.points[free[part.points]]))
            free[part.points] = False
    return found


def upright(points: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Points [n, 3] with the height last."""
    up = up / np.linalg.norm(up)
    return points @ np.vstack([np.linalg.svd(up[None])[2][1:], up]).T


def bodies(placed: np.ndarray) -> Iterator[Part]:
    """What may be a pot, a stake or a post among points [n, 3] [m] with the height last."""
    flat, height = placed[:, :2], placed[:, 2]
    thick = max(float(np.ptp(height)) / _SLICES, 1e-12)
    layer = np.minimum(((height - height.min()) / thick).astype(np.int64), _SLICES - 1)
    yield from _pots(flat, layer, thick)
    cell, of = np.unique(np.floor(flat / thick).astype(np.int64), axis=0, return_inverse=True)
    pairs = np.unique(np.column_stack([of.ravel(), layer]), axis=0)
    crossed = np.bincount(pairs[:, 0], minlength=len(cell))
    for start in np.argsort(-crossed, kind="stable")[:_RODS]:
        middle = np.median(flat[of.ravel() == start], axis=0)
        for wide in _STAKE_WIDTHS:
            yield from _rods(flat, layer, height, middle, wide * thick)


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


def _pots(flat: np.ndarray, layer: np.ndarray, thick: float) -> Iterator[Part]:
    """What may be a pot at the foot of the scan, up to each slice of its lower half."""
    low = layer <= _SLICES // 2
    middle, radius, share = _circles(flat[low], layer[low])
    for top in range(2, _SLICES // 2):
        # The scan's first slice may be a part of one.
        own = slice(1, top + 1)
        away = np.linalg.norm(flat - middle[top], axis=1)
        side = np.bincount(layer[np.abs(away - radius[top]) < 3 * _ROUND * radius[top]],
                           minlength=_SLICES)
        goes_on = side[top + 1] / max(np.median(side[own]), 1)
        shift = np.linalg.norm(np.diff(middle[own], axis=0), axis=1) / radius[top]
        inside = np.bincount(layer[away < 1.2 * radius[top]], minlength=_SLICES)
        points = np.flatnonzero((layer <= top) & (away < 1.2 * radius[top]))
        if len(points):
            yield Part.judged("pot", points, [
                1 - share[own].mean(), shift.mean(), goes_on, top * thick / radius[top] / 4,
                1 / top, inside[top + 1:top + 4].mean() / max(np.median(inside[own]), 1),
                1 - len(points) / (layer <= top).sum(), thick / radius[top],
                radius[top] / thick / 10])


def _rods(flat: np.ndarray, layer: np.ndarray, height: np.ndarray, start: np.ndarray, reach: float,
          ) -> Iterator[Part]:
    """The stake that may go through ``start`` [m], shape [2]."""
    line = np.array([[start[0], 0.0], [start[1], 0.0]])
    for _ in range(4):
        aside = np.linalg.norm(flat - line[:, 0] - height[:, None] * line[:, 1], axis=1)
        near = np.flatnonzero(aside < reach)
        some = near[own_order(flat[near])[:_ROD_POINTS]] if len(near) else near
        middle, radius, share = _circles(flat[some], layer[some])
        used = (share > _ON_CIRCLE) & (radius < reach)
        if used.sum() < 3:
            return
        level = (np.bincount(layer[some], height[some], _SLICES)[used]
                 / np.bincount(layer[some], minlength=_SLICES)[used])
        (x, y), radius = middle[used].T, radius[used]
        line = np.array([_line(level, x), _line(level, y)])
        reach = 1.5 * float(np.median(radius))
    size, long = float(np.median(radius)), float(np.ptp(level))
    off = np.hypot(x - line[0, 0] - line[0, 1] * level, y - line[1, 0] - line[1, 1] * level)
    aside = np.linalg.norm(flat - line[:, 0] - height[:, None] * line[:, 1], axis=1) / size
    count = np.bincount(layer[near], minlength=_SLICES)
    shell = np.bincount(layer[(aside > _AROUND[0]) & (aside < _AROUND[1])], minlength=_SLICES)
    # What a plant's own stem carries begins where the stem forks.
    carried = height[aside > _AROUND[1]]
    foot = np.quantile(carried, _FOOT) if len(carried) else level.max()
    fall, even = _fall(level, np.log(radius))
    yield Part.judged("post" if size > _THICK_POST else "stake", near, [
        np.median(off) / size, even, fall * long, fall * long / (even + _EVEN) / 5,
        float(np.linalg.norm(line[:, 1])), 1 - used.sum() / _SLICES, 1 - share[used].mean(),
        float(np.mean(shell[used] > count[used] / 4)), max(foot - level.min(), 0.0) / long])


def wires(points: np.ndarray, placed: np.ndarray, held: list[Part]) -> Iterator[Part]:
    """What may be a wire among points [n, 3] [m] of a scan, which are on no other support;
    ``placed`` are they with the height last."""
    size = float(np.linalg.norm(np.ptp(placed, axis=0)))
    rest, on = np.ones(len(points), bool), np.zeros(len(points), bool)
    for part in held:
        rest[part.points], on[part.points] = False, True
    rest = np.flatnonzero(rest)
    if len(rest) < _LEAST:
        return
    rest = rest[own_order(points[rest])][:_WIRE_POINTS]
    places, reach = placed[rest], _WIRE_SCALE * size
    tried, tree = np.zeros(len(rest), bool), cKDTree(places)
    supports = cKDTree(placed[on]) if on.any() else None
    for start in range(min(_WIRE_STARTS, len(rest))):
        if tried[start]:
            continue
        near = tree.query_ball_point(places[start], reach)
        if len(near) < _LEAST:
            continue
        spread, axes = np.linalg.eigh(np.cov(places[near].T))
        if spread[1] > _LINE**2 * spread[2] or abs(axes[2, 2]) > _STEEP:
            continue
        tried[near] = True
        yield from _wire(places, supports, placed, places[near].mean(axis=0), axes[:, 2], reach)


def _wire(places: np.ndarray, supports: cKDTree | None, every: np.ndarray, middle: np.ndarray,
          way: np.ndarray, reach: float) -> Iterator[Part]:
    """The wire that may go through ``middle`` [3] along ``way`` [3], seen over ``reach`` [m] to
    both sides among ``places`` [r, 3] of ``every`` [n, 3]; all positions have the height last."""
    way = np.array([way[0], way[1], 0.0]) / max(np.hypot(way[0], way[1]), 1e-12)
    aside = np.array([-way[1], way[0], 0.0])
    frame = np.array([way, aside, [0.0, 0.0, 1.0]])
    own = (places - middle) @ frame.T
    # It grows from what is known of it: a line from above, a parabola from the side.
    line, hang, wide = np.zeros(2), np.zeros(3), 0.1 * reach
    low = high = 0.0
    for _ in range(40):
        off = _off(own, line, hang)
        near = (np.abs(own[:, 0] - (low + high) / 2) < (high - low) / 2 + reach) & (
            np.linalg.norm(off, axis=1) < wide)
        along = own[near, 0]
        if len(along) < _LEAST or np.ptp(along) < 1e-3 * reach:
            return
        line, hang = np.polyfit(along, own[near, 1], 1), np.polyfit(
            along, own[near, 2], 2 if high - low > 6 * reach else 1)
        hang = np.pad(hang, (3 - len(hang), 0))
        wide = max(4 * float(np.median(np.linalg.norm(_off(own[near], line, hang), axis=1))), 1e-9)
        if along.min() > low - 1e-3 * reach and along.max() < high + 1e-3 * reach and high > low:
            break
        low, high = float(along.min()), float(along.max())
    own = (every - middle) @ frame.T
    long, beside_it = high - low, _off(own, line, hang)
    off = np.linalg.norm(beside_it, axis=1)
    inside = (own[:, 0] >= low) & (own[:, 0] <= high)
    near = np.flatnonzero(inside & (off < wide))
    size = float(np.sqrt(np.mean(off[near]**2))) if len(near) else 0.0
    if size <= 0 or long <= 0:
        return
    slices = np.minimum(((own[:, 0] - low) / long * _SLICES).astype(np.int64), _SLICES - 1)
    count = np.bincount(slices[near], minlength=_SLICES)
    shell = inside & (off > _BESIDE[0] * size) & (off < _BESIDE[1] * size)
    beside = np.bincount(slices[shell], minlength=_SLICES) > count / 4
    rows = []
    for number in np.flatnonzero(count >= 3):
        aside = beside_it[near[slices[near] == number]]
        bent, thick = aside.mean(axis=0), max(np.sqrt(aside.var(axis=0).sum()), 1e-300)
        rows.append((number / _SLICES, np.linalg.norm(bent) / thick, np.log(thick)))
    if len(rows) < 3:
        return
    level, ratio, radius = np.array(rows).T
    fall, even = _fall(level, radius)
    loose = [0.0]
    for end, beyond in ((low, own[:, 0].min()), (high, own[:, 0].max())):
        place = np.array([end, np.polyval(line, end), np.polyval(hang, end)]) @ frame + middle
        apart = np.inf if supports is None else supports.query(place)[0]
        loose.append(min(abs(beyond - end), apart) / long)
    yield Part.judged("wire", near, [
        100 * size / long, max(-hang[0] * long**2 / 4, 0.0) / size, beside.mean(),
        np.median(ratio), fall / (even + _EVEN) / 5, 10 * max(loose)])


def _off(own: np.ndarray, line: np.ndarray, hang: np.ndarray) -> np.ndarray:
    """Offset of points from a wire, aside and in height [m], shape [n, 2]."""
    return np.column_stack([own[:, 1] - np.polyval(line, own[:, 0]),
                            own[:, 2] - np.polyval(hang, own[:, 0])])


def _fall(level: np.ndarray, thick: np.ndarray) -> tuple[float, float]:
    """How steeply logarithms of a thickness fall or rise, and their scatter about that."""
    start, slope = _line(level, thick)
    return abs(slope), float(np.median(np.abs(thick - start - slope * level)))


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
_SURE = 10.0  # standard deviations beyond which nothing is surer


def find_sheet(points: np.ndarray, least: float) -> Part | None:
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
    if on.sum() < least:
        return None
    return Part("sheet", np.flatnonzero(on), float(log_ndtr(even := _evenness(
        offset[order[on[order]], :2], diagonal)) - log_ndtr(-even)))


def _evenness(flat: np.ndarray, diagonal: float) -> float:
    """How surely points of a plane, shape [n, 2], fill an area evenly and are no flat-grown plant,
    in standard deviations.

    Twice as far around a point there are four times as many of an even sheet, also beside its
    border, and twice as many of a curve. Each scale between a few points and the sheet's size
    is asked which of the two explains its counts: twigs are curves up to the gap between them. How
    sure the least even scale is follows from the scatter between discs that do not overlap.
    """
    size = flat.std(axis=0).min()
    if size < _BROAD * diagonal:
        return -_SURE
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
    return float(np.clip(least_even, -_SURE, _SURE))


# Ground in a scan, rough or on a slope: one layer of points below everything else.
#
# Seen from above in cells, ground is in most of them, roughly in one plane, no thicker than its
# roughness, and with nothing just above it except where a plant stands. The lower side of a crown
# is not ground: points continue above it.

_CELL = 0.03  # fraction of the cloud's diagonal
_BELOW = 4.0  # standard deviations below the plane, where nothing is
_LAYER = 3.5  # standard deviations around a cell's ground within which points belong to it
_ROUNDS = 10


def find_ground(points: np.ndarray, up: np.ndarray) -> Part | None:
    """Return what may be the ground below a plant among points [n, 3] [m]; None of few cells."""
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    placed = upright(points, up)
    flat, height = placed[:, :2], placed[:, 2]
    side = diagonal * max(_CELL, _WIDE / np.sqrt(len(points)))
    index = np.floor((flat - flat.min(axis=0)) / side).astype(np.int64)
    shape = tuple(index.max(axis=0) + 1)
    where, cell = np.unique(np.ravel_multi_index(tuple(index.T), shape), return_inverse=True)
    count = np.bincount(cell)
    middle = np.stack([np.bincount(cell, values) for values in flat.T], axis=1) / count[:, None]
    size = float(middle.std(axis=0).min())
    if size <= 0:
        return None
    low = np.full(len(count), np.inf)
    np.minimum.at(low, cell, height)
    plane, rough = _plane(middle, low)
    off = low - plane(middle)
    # Bumps are followed from the lower points of the neighbouring cells; a stem's cell has none
    # lower.
    bumps = np.full(shape, np.nan)
    bumps.ravel()[where] = np.clip(off, -_BELOW * rough, _BELOW * rough)
    around = sliding_window_view(np.pad(bumps, 1, constant_values=np.nan), (3, 3))
    over = height - plane(flat) - np.nanmedian(around[np.unravel_index(where, shape)], (1, 2))[cell]
    near = over < 2 * _BELOW * rough
    if not near.any():
        return None
    thick = 1.4826 * float(np.median(np.abs(over[near] - np.median(over[near]))))
    top = float(np.median(over[near])) + _LAYER * thick
    ground = over <= top
    next_layer = np.bincount(cell[(over > top) & (over < 2 * top)], minlength=len(count)) > 0
    cells = middle[np.bincount(cell[ground], minlength=len(count)) > 0]
    filled = len(cells) * side**2 / max(float(np.prod(np.ptp(cells, axis=0))), 1e-12)
    return Part.judged("ground", np.flatnonzero(ground), [
        30 * rough / diagonal, 10 * np.mean(off < -_BELOW * rough), float(np.mean(next_layer)),
        1 - min(filled, 1.0), np.log(diagonal / size), 10 / len(count)])


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
