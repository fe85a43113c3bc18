"""From a file's points to a prepared cloud: unit, origin, crop, outliers."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError, Option, Place, Text
from limber.geometry.cloud.cloud import Cloud, own_axes
from limber.geometry.cloud.single_view import Sight, View, find_sight, flying_pixels, scan_line_view
from limber.geometry.cloud.surroundings import Part, find_ground, find_sheet, middle
from limber.geometry.settings import OPEN, PreparationSettings

POINT_MINIMUM = 50
_SHEET_LEAST = 0.08  # smallest fraction of the points that makes a wall or the ground
_SHEETS_MOST = 6  # a box has six
_NAMES = {"sheet": "a wide flat sheet", "ground": "ground"}
_AT_ONCE = 200_000  # points whose neighbours are held in memory at a time
# A step between neighbouring pixels of a depth camera is no surface if that surface would be seen
# at a larger angle [degrees]. Fewer pixels than the speck between such steps are flying pixels: of
# groups of three and more in images with truth (seeds 9600 to 9607), all of 1,120 were on branches.
_FLYING_ANGLE, _FLYING_SPECK = 78.0, 3
# A point is an outlier if its neighbours are this many times farther than is usual around them.
_OUTLIER_NEIGHBOURS, _OUTLIER_RATIO = 8, 5.0
# Places that show how isolated a point anywhere would be. As far as the scan's background
# explains at least half of the points so isolated, the ratio falls to one of these.
_ANYWHERE, _STRAY_RATIOS = 5000, (4.0, 3.2, 2.56, 2.05)
_COARSEST_STEP = 5e-3  # fraction of the cloud's size: the thickness of its twigs


@dataclass(frozen=True)
class Prepared:
    """A cleaned cloud [m] near the origin: ``origin`` [3] [m] in the file's axes was subtracted
    from ``scale`` times its numbers. It counts dropped points by reason, and has a ``view`` if
    there was one depth camera."""

    cloud: Cloud
    origin: np.ndarray
    counts: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    view: View | None = None
    scale: float = 1.0

    def outside(self, place: np.ndarray) -> np.ndarray:
        """Return positions [m], shape [..., 3], in the coordinates of the file."""
        return (place + self.origin) / self.scale


def prepare(cloud: Cloud, scale: float, settings: PreparationSettings | None = None, *,
            eye: np.ndarray | None = None, up: np.ndarray | None = None) -> Prepared:
    """Crop, convert to metres, recentre, and drop duplicates, flying pixels and outliers. ``eye``
    [3] is the camera in the file's coordinates; with ``up`` [3] rough ground is found too.
    InputError if too few points stay, or all are at one position."""
    settings = settings or PreparationSettings()
    counts = {"read": len(cloud) + cloud.left_out, "not_finite": cloud.not_finite}
    if cloud.left_out:
        counts["thinned_on_reading"] = cloud.left_out
    counts["cropped"] = len(cloud)
    cloud = _cropped(cloud, settings)
    counts["cropped"] -= len(cloud)
    _enough(cloud, "The cloud")
    count = len(cloud)
    # Before the cloud is viewed as an image, which has one point per pixel.
    single = _first_of_each(cloud.points)
    counts["duplicates"] = int((~single).sum())
    cloud = cloud.subset(single)
    cloud, view = _without_flying(cloud, scale, settings, eye, counts)
    # Subtracted in float64 before anything else: with map coordinates, float32 has no digits left.
    scaled = cloud.points * scale
    origin = np.round(scaled.mean(axis=0), 3)
    points = scaled - origin
    if np.ptp(points, axis=0).max() <= 1e-9 * max(float(np.abs(scaled).max()), 1e-9):
        raise InputError(f"All {count} points are at the same position.",
                         "The points of a branch spread out in space.",
                         "Check the columns and the number of digits of the export.")
    _enough_digits(cloud.points)
    _, middle, longest = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
    if middle < 1e-6 * longest:
        raise InputError(f"All {len(points)} points lie on one straight line.",
                         "A branch has a thickness.",
                         "Check the columns and the number of digits of the export.")
    cloud = cloud.with_points(points)
    keep, flat = _without_outliers(points), list[str]()
    if "sheets" not in settings.keep:
        used = np.flatnonzero(keep)
        on, open_ = _beside_plant(points[keep], up, counts)
        flat = _sheet_texts((points[used] + origin) / scale, on, open_, counts)
        if on.any():
            # What is usual for a plant does not depend on the ground around it.
            rest = np.setdiff1d(np.arange(len(points)), used[on])
            keep[:] = False
            keep[rest] = _without_outliers(points[rest])
    counts["outliers"] = len(points) - int(keep.sum()) - sum(
        counts.get(name, 0) for name in ("sheets", "ground"))
    cloud = cloud.subset(keep)
    _enough(cloud, "After cropping and cleaning, the cloud")
    if view is not None:
        view = replace(view, eye=view.eye - origin)
    return Prepared(cloud, origin, counts, _plausible(cloud.points, counts, flat), view, scale)


def voxel_thinned(points: np.ndarray, size: float) -> np.ndarray:
    """Indices of the first point in each cell of ``size`` [m], sorted."""
    cell = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    extent = cell.max(axis=0) + 1
    if float(extent[0]) * float(extent[1]) * float(extent[2]) > 2.0**62:
        raise InputError(f"Cells of {size:g} m are too small for this cloud.", "There would be too "
                         "many of them to count.", "Check the unit (", Option("unit"), "), or crop "
                         "stray points (", Option("crop"), ").")
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])


def _cropped(cloud: Cloud, settings: PreparationSettings) -> Cloud:
    if settings.crop is None:
        return cloud
    low, high = np.reshape(settings.crop, (2, 3))
    keep = ((cloud.points >= low) & (cloud.points <= high)).all(axis=1)
    if not keep.any():
        low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
        raise InputError("The crop box holds no points.",
                         f"The cloud reaches from {low.tolist()} to {high.tolist()}.",
                         "Give the box in the coordinates and the unit of the file.")
    return cloud if keep.all() else cloud.subset(keep)


def _beside_plant(points: np.ndarray, up: np.ndarray | None, counts: dict[str, int],
                  ) -> tuple[np.ndarray, list[Part]]:
    """Mask of walls and ground, unless little else remains: that is refused later. Also the sheets
    of which it is an open question whether they are any."""
    on, least = np.zeros(len(points), bool), max(0.1 * len(points), POINT_MINIMUM)
    open_, ground = list[Part](), None if up is None else find_ground(points, up)
    if ground is not None and len(points) - len(ground.points) >= least:
        open_ += [ground] if 1 - OPEN < ground.probability < OPEN else []
        if ground.log_odds > 0:
            on[ground.points] = True
            counts["ground"] = len(ground.points)
    rest = np.flatnonzero(~on)
    for _ in range(_SHEETS_MOST):
        sheet = find_sheet(points[rest], _SHEET_LEAST * len(points))
        if sheet is None:
            break
        sheet = sheet._replace(points=rest[sheet.points])
        open_ += [sheet] if 1 - OPEN < sheet.probability < OPEN else []
        if sheet.log_odds < 0:
            break
        rest = np.setdiff1d(rest, sheet.points)
    counts["sheets"] = int((~on).sum()) - len(rest) if len(rest) >= least else 0
    if counts["sheets"]:
        on[np.setdiff1d(np.arange(len(points)), rest)] = True
    return on, open_


def _sheet_texts(points: np.ndarray, on: np.ndarray, open_: list[Part], counts: dict[str, int],
                 ) -> list[str]:
    """What was removed of points [n, 3] in the file's coordinates, and which sheets are open."""
    keep = Option("keep", ("sheets",))
    texts: list[str] = [Text(
        f"{on.sum()} of {counts['read']} points lie on wide flat sheets or rough ground, as at ",
        Place(middle(points[on])), ", and were removed (", keep, " keeps them).")
        ] if on.any() else []
    for sheet in open_:
        rest = np.delete(points, sheet.points, axis=0)
        box = (*rest.min(axis=0).tolist(), *rest.max(axis=0).tolist()) if len(rest) else None
        is_gone = on[sheet.points].all()
        done = ("They were removed. If they are the plant's: ", keep) if is_gone else (
            "They were kept. If they are no plant's: ", Option("crop", box))
        texts.append(Text(
            f"Are {len(sheet.points)} points {_NAMES[sheet.kind]}, as at ", Place(middle(
                points[sheet.points])), ", or the plant's? They are that with a probability of "
            f"{sheet.probability:.2f}. ", *done, "."))
    return texts


def _enough_digits(points: np.ndarray) -> None:
    """Refuse coordinates far from the origin that lost their digits in single precision."""
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    step = float(np.spacing(np.float32(np.abs(points).max())))
    if step > _COARSEST_STEP * extent and (points == points.astype(np.float32)).all():
        raise InputError(f"The coordinates reach {np.abs(points).max():.7g} and have a resolution "
                         f"of {step:g}, but the cloud is only {extent:.3g} long.",
                         "They were stored in single precision (7 digits), which loses the shape.",
                         "Export in double precision, or subtract an offset first.")


def _without_flying(cloud: Cloud, scale: float, settings: PreparationSettings,
                    eye: np.ndarray | None, counts: dict[str, int]) -> tuple[Cloud, View | None]:
    """Drop flying pixels if one depth camera saw the cloud; also return its position."""
    if eye is None and settings.camera_at is not None:
        eye = np.asarray(settings.camera_at)
    if eye is None:
        scanner, sight = _own_sight(cloud.points * scale)
    else:
        scanner = np.array(eye) * scale
        sight = find_sight(cloud.points * scale, scanner)
    if sight is None:
        return cloud, None
    view = View(scanner, sight.pitch)
    if "flying" in settings.keep:
        return cloud, view
    flying = flying_pixels(sight, _FLYING_ANGLE, _FLYING_SPECK)
    counts["flying"] = int(flying.sum())
    rest = cloud.subset(~flying)
    _enough(rest, Text("Without flying pixels (", Option("keep"), " flying keeps them), the depth "
                       "camera's cloud"))
    return rest, view


def _own_sight(points: np.ndarray) -> tuple[np.ndarray, Sight | None]:
    """The cloud as an image, and its camera's position [m], shape [3]: from the order of its
    points, or as seen from the origin of the file's coordinates."""
    estimated = scan_line_view(points)
    if estimated is not None:
        sight = find_sight(points - estimated[0], forward=estimated[1])
        if sight is not None:
            return estimated[0], sight
    return np.zeros(3), find_sight(points)


def _enough(cloud: Cloud, what: str) -> None:
    if len(cloud) < POINT_MINIMUM:
        raise InputError(f"{what} has {len(cloud)} point{'s' * (len(cloud) != 1)}.",
                         f"A skeleton needs at least {POINT_MINIMUM} points.",
                         "Scan more densely, or crop less.")


def _first_of_each(points: np.ndarray) -> np.ndarray:
    """Mask of the points that are not a copy of an earlier one."""
    order = np.lexsort(points.T)
    again = np.ones(len(points), bool)
    again[0] = False
    for column in points.T:
        again[1:] &= column[order[1:]] == column[order[:-1]]
    single = np.empty(len(points), bool)
    single[order] = ~again
    return single


def _without_outliers(points: np.ndarray) -> np.ndarray:
    """Mask [n] of the points to keep. An outlier is far more isolated than is usual around it, or
    as isolated as most places of a background of stray points anywhere in the scan's box."""
    tree = cKDTree(points)
    count = min(_OUTLIER_NEIGHBOURS + 1, len(points))
    own, near = np.empty(len(points)), np.empty((len(points), count), np.int32)
    for part in _parts(len(points)):
        distance, near[part] = tree.query(points[part], k=count)
        own[part] = distance[:, 1:].mean(axis=1)
    # The median over the neighbours is itself large for a lone point among lone points, so the
    # statistics of the whole cloud count too.
    overall = max(float(np.median(own)), 1e-300)

    def isolation(mean: np.ndarray, around: np.ndarray) -> np.ndarray:
        usual = np.maximum(np.median(around, axis=1), overall)
        return mean / np.minimum(usual, 3 * overall)

    isolated = np.concatenate([isolation(own[part], own[near[part]])
                               for part in _parts(len(points))])
    axes = own_axes(points)
    placed = points @ axes
    anywhere = np.random.default_rng(0).uniform(
        placed.min(axis=0), placed.max(axis=0), (_ANYWHERE, 3)) @ axes.T
    distance, around = tree.query(anywhere, k=max(count - 1, 1))
    mean = distance.reshape(_ANYWHERE, -1).mean(axis=1)
    stray = isolation(mean, np.column_stack([mean, own[around.reshape(_ANYWHERE, -1)]]))
    return isolated <= _stray_from(isolated, stray)


def _stray_from(isolated: np.ndarray, stray: np.ndarray) -> float:
    """Isolation above which points are outliers, from that of the scan's points [n] and that at
    places ``stray`` [k] anywhere in its box."""
    far = max(float(np.median(stray)), _OUTLIER_RATIO)
    count = float((isolated > far).sum()) / max(float((stray > far).mean()), 1 / len(stray))
    limit = _OUTLIER_RATIO
    for lower in _STRAY_RATIOS:
        expected = count * float(((stray > lower) & (stray <= _OUTLIER_RATIO)).mean())
        between = int(((isolated > lower) & (isolated <= _OUTLIER_RATIO)).sum())
        # Half of them and more are stray, as far as so few points can tell.
        if between <= 2 * expected + np.sqrt(expected):
            limit = lower
    return limit


def _parts(count: int) -> Iterator[slice]:
    """Slices of the points that are processed at once."""
    return (slice(begin, begin + _AT_ONCE) for begin in range(0, count, _AT_ONCE))


def _rounding(points: np.ndarray) -> float:
    """Step [m] to which coordinates are rounded, if it blurs branches; else 0."""
    steps = []
    for axis in points.T:
        step = np.diff(np.unique(np.round(axis, 9)))
        if len(step) < 3 or np.quantile(step, 0.1) < 0.99 * np.median(step):
            return 0.0
        steps.append(float(np.median(step)))
    near = float(np.median(cKDTree(points).query(points[::max(len(points) // 2000, 1)], k=2)[0][
        :, 1]))
    return steps[0] if max(steps) < 1.01 * min(steps) and near < 1.5 * steps[0] else 0.0


def _plausible(points: np.ndarray, counts: dict[str, int], flat: list[str]) -> list[str]:
    texts = list(flat)
    if counts.get("not_finite"):
        texts.append("Points with coordinates that are not finite (NaN or infinity) were "
                     f"discarded: {counts['not_finite']}.")
    if counts.get("thinned_on_reading"):
        texts.append(f"The scan has {counts['read']} points. One point in each cell of a grid was "
                     f"kept, {counts['read'] - counts['thinned_on_reading']} in all: more do not "
                     "make the axes better. Crop the scan before the export if finer twigs are "
                     "missing.")
    step = _rounding(points)
    if step > 0:
        texts.append(f"The coordinates are rounded to {1000 * step:.4g} mm, which limits the "
                     "accuracy of the radii. Export with more digits.")
    flying = counts.get("flying", 0)
    if flying > 0.02 * counts["read"]:
        texts.append(Text(f"{flying} of {counts['read']} points were discarded as flying pixels of "
                          "a depth camera (", Option("keep"), " flying keeps them)."))
    lost = counts.get("outliers", 0)
    if lost > 0.1 * len(points):
        texts.append(f"{lost} points were discarded as outliers.")
    return texts


# Scans read in pieces; only the points needed to find axes and leaves are kept.

MOST_POINTS = 5_000_000
"""Most points kept of a scan: a tenth of a millimetre apart on a branch of one metre."""
PIECE_POINTS = 1_000_000
"""Points that readers take from a file at once."""
_FINEST = 1e-5  # first grid step, as a fraction of the scan's size


def gathered(pieces: Iterable[Cloud], most: int = MOST_POINTS) -> Cloud:
    """Join pieces, with the attributes that all have. Of over ``most`` points it keeps the first in
    each cell of the finest grid that leaves no more. Its cells are within those of the next, twice
    as wide, so the pieces do not matter. It needs memory for twice ``most`` points and a piece."""
    grid = _Grid(most)
    held: list[Cloud] = []
    for piece in pieces:
        held.append(piece)
        if sum(map(len, held)) > 2 * most:
            held = [grid.thinned(_together(held))]
    whole = _together(held)
    return grid.thinned(whole) if len(whole) > most else whole


class _Grid:
    """A grid that becomes coarser; all points are measured from the first one."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._anchor: np.ndarray | None = None
        self._size = 0.0

    def thinned(self, cloud: Cloud) -> Cloud:
        """One point per cell, in cells large enough to keep few enough points."""
        finite = np.isfinite(cloud.points).all(axis=1)
        lost = int((~finite).sum())
        cloud = replace(cloud.subset(finite), not_finite=cloud.not_finite + lost)
        if len(cloud) <= self._most:
            return cloud
        if self._anchor is None:
            self._anchor = cloud.points[0]
        extent = float(np.ptp(cloud.points, axis=0).max())
        if self._size == 0:
            self._size = 2.0**np.floor(np.log2(max(_FINEST * extent, 1e-300)))
        chosen = self._firsts(cloud.points)
        while len(chosen) > self._most and self._size < extent:
            self._size *= 2
            chosen = chosen[self._firsts(cloud.points[chosen])]
        return replace(cloud.subset(chosen), left_out=cloud.left_out + len(cloud) - len(chosen))

    def _firsts(self, points: np.ndarray) -> np.ndarray:
        cell = np.floor((points - self._anchor) / self._size).astype(np.int64)
        cell -= cell.min(axis=0)
        extent = cell.max(axis=0) + 1
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        return np.sort(np.unique(key, return_index=True)[1])


def _together(pieces: list[Cloud]) -> Cloud:
    if len(pieces) == 1:
        return pieces[0]
    first = pieces[0]
    return replace(
        first, points=np.concatenate([piece.points for piece in pieces]),
        attributes={name: np.concatenate([piece.attributes[name] for piece in pieces])
                    for name in first.attributes
                    if all(name in piece.attributes for piece in pieces)},
        not_finite=sum(piece.not_finite for piece in pieces),
        left_out=sum(piece.left_out for piece in pieces))


# Plausible sizes of a plant: outside them the unit is asked for; impossible sizes are refused.

LONGEST, SHORTEST = 30.0, 0.01
"""Largest and smallest size [m] without a question about the unit; the add-on reads the largest."""
_POSSIBLE = (0.003, 100.0)  # m
_UNUSUAL = 10.0  # m


def size_doubts(points: np.ndarray, what: str, unit: str, *, is_stated: bool) -> list[str]:
    """Return a question about the unit of positions [n, 3] [m] of unusual extent; ``what`` is named
    in it. InputError if a plant of this size needs a stated unit, or none has it."""
    extent = float(np.ptp(points, axis=0).max())
    is_possible = _POSSIBLE[0] <= extent <= _POSSIBLE[1]
    if is_possible and (is_stated or SHORTEST <= extent <= _UNUSUAL):
        return []
    number = extent / UNIT_METRES[unit]
    other = [Text(Option("unit", name), f" ({size:.3g} m)") for name in ("m", "cm", "mm", "in")
             if name != unit and SHORTEST <= (size := number * UNIT_METRES[name]) <= _UNUSUAL]
    seen = f"The {what} is {extent:.4g} m long, read in {unit}."
    if SHORTEST <= extent <= LONGEST:
        return [Text(f"{seen} Is its unit another: ", Text.joined(" or ", other), "?")]
    if is_possible:
        raise InputError(seen, Text("Neither the file nor ", Option("unit"), " states the unit, "
                                    "and this would be an unusual size."),
                         "State it: ", Text.joined(", ", [*other, Option("unit", unit)]), ".")
    raise InputError(seen, f"No plant that a robot moves has this size ({_POSSIBLE[0]:g} to "
                     f"{_POSSIBLE[1]:g} m).",
                     *(("State the unit of its numbers: ", Text.joined(", ", other), ".") if other
                       else ("Check its numbers and its unit (", Option("unit"), ").")))
