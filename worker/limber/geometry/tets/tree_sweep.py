"""Our own tetrahedra for forked branches, swept along the axes: deterministic and fast.

Each run is a stack of prisms around its axis. They have six sides, or four for a thin twig, and the
second moment of area of the round section, so that they bend like it. A twig grows out of its
carrier's side: the carrier has a slice there as long as the twig is thick, and one or two of that
slice's side faces are the twig's first cross-section. The block between them and the twig's first
ring is a fan of tetrahedra around that ring's centre.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import InputError, MeshingError, Option
from limber.core.numerics.rigid import any_normal
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import (
    arc_lengths,
    bending_factor,
    frames,
    resample,
    rings,
    tangents,
)
from limber.geometry.tets.tet_mesh import FLAT, TetMesh, shapes

# Structured tetrahedral meshes swept along axes: deterministic, fast, of known quality.


def straight_beam(length: float, radius_root: float, radius_tip: float | None = None, *,
                  slice_count: int | None = None, sides: int = 6,
                  direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
                  quadratic: bool = True, young: float = 1e8, poisson: float = 0.35,
                  density: float = 900.0, fractions: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8),
                  grasp_fraction: float = 1.0) -> TetMesh:
    """Mesh a straight round beam that starts at the origin and is fixed there.

    The cross-section is a regular polygon of the circle's area (for 6 sides its second moment is
    0.8 % over the circle's), with one node on the axis.

    Args:
        length: Length [m].
        radius_root: Radius at the origin [m].
        radius_tip: Radius at the end [m]; None: as at the root.
        slice_count: Number of slices; None: each about two radii long.
        sides: Sides of the polygon.
        direction: Direction of the beam.
        quadratic: 10-node tetrahedra, else 4-node ones.
        young: Young's modulus [Pa].
        poisson: Poisson's ratio.
        density: Density [kg/m^3].
        fractions: Positions of the control points on the axis.
        grasp_fraction: Position of the grasp patch; at 1 the end face.

    Returns:
        A mesh with all the data that a branch's mesh has.
    """
    radius_tip = radius_root if radius_tip is None else radius_tip
    if not (length > 0 and radius_root > 0 and radius_tip > 0):
        raise InputError("The length and the radii of a beam must be positive.", "",
                         "Give them in metres.")
    if slice_count is None:
        slice_count = max(round(length / (radius_root + radius_tip)), 4)
    axis = np.array(direction, float) / np.linalg.norm(direction)
    centres = np.linspace(0, length, slice_count + 1)[:, None] * axis
    radius = np.linspace(radius_root, radius_tip, slice_count + 1)
    mesh = sweep_run(centres, radius, sides=sides)
    if quadratic:
        mesh = mesh.quadratic()
    return _with_beam_data(mesh, axis, length, fractions, grasp_fraction, young, poisson, density)


def curved_beam(points: np.ndarray, radius: np.ndarray, *, slice_length: float = 2.0,
                sides: int = 6, quadratic: bool = True) -> TetMesh:
    """Mesh a round beam along an axis [n, 3] [m] with radii [n] [m], without data on the mesh;
    ``slice_length`` is in local radii."""
    centres, radii = resample(np.asarray(points, float), np.asarray(radius, float),
                              slice_length * np.asarray(radius, float))
    mesh = sweep_run(centres, radii, sides=sides)
    return mesh.quadratic() if quadratic else mesh


def sweep_run(centres: np.ndarray, radius: np.ndarray, *, sides: int = 6) -> TetMesh:
    """Linear tetrahedra of the tube with rings around ``centres`` [n, 3]: one slice a step."""
    tangent = tangents(centres)
    normals, binormals = frames(centres, tangent)
    return swept(centres, rings(centres, radius, normals, binormals, sides))


def swept(centres: np.ndarray, ring: np.ndarray) -> TetMesh:
    """Linear tetrahedra of the tube with these rings, shape [n, sides, 3], around ``centres``."""
    return tube(centres, ring).oriented()


def tube(centres: np.ndarray, ring: np.ndarray) -> TetMesh:
    """The same, oriented like the rings."""
    count, sides = ring.shape[:2]
    nodes = np.concatenate([centres[:, None], ring], axis=1).reshape(-1, 3)
    centre, a = np.zeros(sides, np.int64), 1 + np.arange(sides)
    triangle = np.stack([centre, a, 1 + a % sides], axis=1)
    low = triangle + (np.arange(count - 1) * (sides + 1))[:, None, None]
    return TetMesh(nodes, split_wedges(np.concatenate(
        [low, low + sides + 1], axis=2).reshape(-1, 6)))


def split_wedges(wedges: np.ndarray) -> np.ndarray:
    """Split prisms [n, 6] (a triangle and, above it, its copy) into three tetrahedra each. Each
    side is cut from its corner of the lowest index, so neighbours agree: Dompierre et al., How to
    subdivide pyramids, prisms and hexahedra into tetrahedra (1999)."""
    turns = np.array([[0, 1, 2, 3, 4, 5], [1, 2, 0, 4, 5, 3], [2, 0, 1, 5, 3, 4],
                      [3, 5, 4, 0, 2, 1], [4, 3, 5, 1, 0, 2], [5, 4, 3, 2, 1, 0]])
    # After the rotation the lowest index is first, so two quadrilaterals are cut from corner 0.
    w = np.take_along_axis(wedges, turns[np.argmin(wedges, axis=1)], axis=1)
    first = np.minimum(w[:, 1], w[:, 5]) < np.minimum(w[:, 2], w[:, 4])
    tets = np.where(
        first[:, None, None],
        w[:, [[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]]],
        w[:, [[0, 1, 2, 4], [0, 4, 2, 5], [0, 4, 5, 3]]])
    return tets.reshape(-1, 4)


def _with_beam_data(mesh: TetMesh, axis: np.ndarray, length: float, fractions: tuple[float, ...],
                    grasp_fraction: float, young: float, poisson: float, density: float) -> TetMesh:
    along = mesh.nodes @ axis
    control = np.full(mesh.node_count, -1, np.int64)
    for k, fraction in enumerate(fractions):
        distance = np.linalg.norm(mesh.nodes - fraction * length * axis, axis=1)
        control[int(np.argmin(distance))] = k
    planes = np.unique(np.round(along, 12))
    grasp_plane = planes[int(np.argmin(np.abs(planes - grasp_fraction * length)))]
    tolerance = 1e-9 * length
    full = np.ones(mesh.tet_count)
    return mesh.with_data(
        cell_data={"young": young * full, "poisson": poisson * full, "density": density * full},
        point_data={"fixed": (along < tolerance).astype(np.int64), "control_point": control,
                    "grasp": (np.abs(along - grasp_plane) < 1e-6 * length).astype(np.int64)})


# A run's axis as a curve of its length.


@dataclass
class RunAxis:
    """One run's axis: nodes [n, 3] [m], radii [n] [m], and the length ``along`` up to each [m]."""

    points: np.ndarray
    radius: np.ndarray
    along: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, run: int) -> "RunAxis":
        """The axis of a run from its fork on, with the twig's own radius there."""
        points, radius = skeleton.curve(run)
        return cls(points, radius, arc_lengths(points))

    @property
    def length(self) -> float:
        """[m]."""
        return float(self.along[-1])

    def straight_until(self, reach: float) -> "RunAxis":
        """The axis with its first ``reach`` [m] straightened."""
        kept = self.along >= min(reach, 0.5 * self.length)
        kept[0] = True
        points = self.points[kept]
        return RunAxis(points, self.radius[kept], arc_lengths(points))

    def at(self, where: np.ndarray | float) -> np.ndarray:
        """Positions [m], shape [..., 3], at lengths along it [m]."""
        return np.stack([np.interp(where, self.along, self.points[:, k]) for k in range(3)],
                        axis=-1)

    def radius_at(self, where: np.ndarray | float) -> np.ndarray:
        """Radii [m] at lengths along it [m]."""
        return np.interp(where, self.along, self.radius)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance of points from the axis [m], and position of the foot along it [m]."""
        where = np.linspace(0, self.length, max(8 * len(self.points), 50))
        distance, index = cKDTree(self.at(where)).query(points)
        return distance, where[index]


# Blocks of tetrahedra between a carrier's side and the first ring of a twig that leaves it.


@dataclass(frozen=True)
class Patch:
    """Side faces of a carrier's slice that a twig may start from; ``loop`` are the nodes around
    them, ``outward`` [3] is their mean normal."""

    slice: int
    faces: list[int]
    loop: np.ndarray
    outward: np.ndarray


@dataclass(frozen=True)
class Joint:
    """A valid block between a patch and a twig's first ring at ``start`` [m], with normal
    ``tangent`` and its first corner towards ``turn`` [3]. In ``tets`` [t, 4], -1 - k is node k of
    the twig; ``quality`` is the shape of the flattest one."""

    start: float
    tangent: np.ndarray
    turn: np.ndarray
    tets: np.ndarray
    quality: float


def joints(axis: RunAxis, start: np.ndarray, lean: np.ndarray, patch: Patch, corner: np.ndarray,
           triangles: np.ndarray) -> list[Joint]:
    """The valid blocks between a patch of ``corner`` [sides, 3] [m] and the carrier's ``triangles``
    [2 or 4, 3], and a twig's ring at ``start`` [j] [m] that leans by ``lean`` [j] to the patch."""
    sides = len(corner)
    radius = axis.radius_at(start)
    ahead = axis.at(np.minimum(start + radius, axis.length)) - axis.at(
        np.maximum(start - radius, 0.0))
    tangent = _unit(ahead) + lean[:, None] * patch.outward
    tangent = _unit(tangent)
    centre = axis.at(start)
    backwards, turn = _matched(corner, tangent)
    ring = rings(centre, radius, turn, np.cross(tangent, turn), sides, bending_factor(sides))
    base = np.where(backwards[:, None, None], corner[::-1], corner)
    nodes = np.concatenate([base, centre[:, None], ring], axis=1)
    sorter = np.argsort(patch.loop)
    local = sorter[np.searchsorted(patch.loop, triangles, sorter=sorter)]
    local = np.where(backwards[:, None, None], sides - 1 - local, local)
    block, quality = _blocks(nodes, local)
    found = []
    for k in np.flatnonzero(quality >= FLAT):
        order = patch.loop[::-1] if backwards[k] else patch.loop
        numbers = np.concatenate([order, -1 - np.arange(sides + 1)])
        found.append(Joint(float(start[k]), tangent[k], turn[k],
                           numbers[block[k]], float(quality[k])))
    return found


def _matched(corner: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether a patch's corners [sides, 3] [m] must be reversed about each ``tangent`` [j, 3], and
    normals [j, 3] of rings whose corner k is above patch corner k with the least twist."""
    first = any_normal(tangent)
    second = np.cross(tangent, first)
    flat = corner - corner.mean(axis=0)
    angle = np.arctan2(second @ flat.T, first @ flat.T)
    backwards = np.sin(np.roll(angle, -1, axis=1) - angle).sum(axis=1) < 0
    angle = np.where(backwards[:, None], angle[:, ::-1], angle)
    even = 2 * np.pi * np.arange(len(corner)) / len(corner)
    offset = np.angle(np.exp(1j * (angle - even)).sum(axis=1))[:, None]
    return backwards, np.cos(offset) * first + np.sin(offset) * second


def _blocks(nodes: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra [j, t, 4] between triangles ``below`` [j, 2 or 4, 3] and each ring, and the worst
    shape [j]. ``nodes`` [j, 2 sides + 1, 3] [m]: the patch, the ring's centre, the ring."""
    count, sides = len(nodes), (nodes.shape[1] - 1) // 2
    k = np.arange(sides)
    after, top = (k + 1) % sides, sides
    a, b, top_a, top_b = k, after, sides + 1 + k, sides + 1 + after
    hub = np.full(sides, top)
    # Each side quadrilateral is on the surface, so either diagonal will do.
    one = np.stack([[b, a, top_b, hub], [top_b, a, top_a, hub]], axis=0).transpose(2, 0, 1)
    two = np.stack([[b, a, top_a, hub], [top_b, b, top_a, hub]], axis=0).transpose(2, 0, 1)
    shape_one, shape_two = (shapes(nodes[:, cut]).min(axis=2) for cut in (one, two))
    sidewise = np.where((shape_one >= shape_two)[:, :, None, None], one, two)
    under = np.concatenate([below, np.full((*below.shape[:2], 1), top)], axis=2)
    block = np.concatenate([under, sidewise.reshape(count, -1, 4)], axis=1)
    corner = nodes[np.arange(count)[:, None, None], block]
    return block, shapes(corner).min(axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


# Slices of a run: one for each of its twigs, and even ones between.

_CLAMP_SLICES = (1.0, 3.0)  # ends of the first slices, in root radii
_SHARED = 0.5  # cosine between twigs of one slice below which they leave through different sides
_TAPERED, _THINNEST = 2.5, 0.06  # radius ratio above which rings are graded; smallest ratio


@dataclass
class Window:
    """A slice from ``low`` to ``high`` [m] along a carrier that the twig ``run`` grows out of in
    the direction ``outward`` [3]."""

    run: int
    low: float
    high: float
    outward: np.ndarray

    @classmethod
    def of(cls, axis: RunAxis, twig: RunAxis, run: int) -> "Window | None":
        """The slice of a carrier that a ``twig`` leaves through; None if it stays inside."""
        where = np.linspace(0, twig.length, 200)
        distance, foot = axis.nearest(twig.at(where))
        out = np.flatnonzero(distance > axis.radius_at(foot))
        if len(out) == 0:
            return None
        exit_point, foot_arc = twig.at(where[out[0]]), foot[out[0]]
        outward = exit_point - axis.at(foot_arc)
        outward /= max(np.linalg.norm(outward), 1e-300)
        half = 1.25 * float(twig.radius_at(where[out[0]]))
        return cls(run, foot_arc - half, foot_arc + half, outward)


def without_overlap(windows: Iterable[Window], axis: RunAxis, start: float) -> list[Window]:
    """Move slices along an axis from ``start`` [m] so that none overlap, as little as possible.
    Twigs that leave through different sides may share a slice, as those of a whorl do."""
    end = axis.length + 1e-12
    slices: list[list[Window]] = []
    free = start + 0.3 * float(axis.radius_at(start))
    for window in sorted(windows, key=lambda w: w.low + w.high):
        length, middle = window.high - window.low, (window.low + window.high) / 2
        low = max(min(window.low, axis.length - length), free)
        high = min(low + length, end)
        own = abs((low + high) / 2 - middle) if low + 0.5 * length <= end else np.inf
        moves = {k: abs((one[0].low + one[0].high) / 2 - middle) for k, one in enumerate(slices)
                 if all(window.outward @ other.outward < _SHARED for other in one)}
        best = min(moves, key=moves.__getitem__, default=None)
        if best is not None and moves[best] < own:
            one = slices[best]
            one.append(Window(window.run, one[0].low, one[0].high, window.outward))
        elif np.isfinite(own):
            slices.append([Window(window.run, low, high, window.outward)])
            free = high + 0.25 * length
    return [window for one in slices for window in one]


def ring_positions(axis: RunAxis, start: float, windows: list[Window],
                   spacing: float) -> np.ndarray:
    """Positions [r] [m] of rings along an axis from ``start`` [m], ``spacing`` radii apart."""
    fixed = sorted({round(v, 12) for w in windows for v in (w.low, w.high)})
    marks = [start, *[v for v in fixed if start < v < axis.length], axis.length]
    inside = {(round(w.low, 12), round(w.high, 12)) for w in windows}
    positions = [start]
    if start == 0.0 and len(marks) > 1:
        # Short slices at the clamp, which keeps the section from narrowing under tension: long ones
        # there made a cantilever 0.4 % too stiff, at any length elsewhere.
        near = [g * float(axis.radius[0]) for g in _CLAMP_SLICES]
        positions += [v for v in near if v + near[0] < marks[1]]
        marks[0] = positions[-1]
    for low, high in itertools.pairwise(marks):
        size = spacing * float(axis.radius_at((low + high) / 2))
        within = any(a <= low + 1e-9 and high <= b + 1e-9 for a, b in inside)
        count = 1 if within else max(round((high - low) / size), 1)
        between = np.linspace(low, high, count + 1)
        if not within and _is_tapered(axis, low, high):
            between = _graded(axis, low, high, spacing)
        positions += list(between[1:])
    if len(positions) < 3:
        positions = list(np.linspace(start, axis.length, 3))
    return np.array(positions)


def _is_tapered(axis: RunAxis, low: float, high: float) -> bool:
    radii = axis.radius_at(np.linspace(low, high, 20))
    return bool(radii.max() > _TAPERED * radii.min())


def _graded(axis: RunAxis, low: float, high: float, spacing: float) -> np.ndarray:
    """Positions [m] of rings where the radius changes much: closer where it is thin. Slices sized
    for the middle would be needles at a thin end, which look as if folded over."""
    along = np.linspace(low, high, 400)
    radii = axis.radius_at(along)
    pitch = spacing * np.maximum(radii, _THINNEST * radii.max())
    rings = np.concatenate([[0.0], np.cumsum((1 / pitch[1:] + 1 / pitch[:-1]) / 2
                                             * np.diff(along))])
    count = max(round(float(rings[-1])), 1)
    return np.interp(np.linspace(0, rings[-1], count + 1), rings, along)


# Tubes along bent axes whose slices are not folded over.

_SHIFTS = (1, -1, 2, -2, 3, -3)  # shifts tried for a twig's slice, in its own lengths


def unfolded(axis: RunAxis, start: float, windows: list[Window], sides: int, spacing: float,
             first_normal: np.ndarray | None, first_tangent: np.ndarray | None,
             ) -> tuple[np.ndarray, TetMesh]:
    """Positions [m] of rings along an axis from ``start``, and prisms that are not folded if
    possible: in a sharp bend a ring goes, or a twig's slice in ``windows`` moves or goes."""
    moves = dict.fromkeys((window.run for window in windows), 0)
    first_low = {window.run: window.low for window in windows}
    where, ends = ring_positions(axis, start, windows, spacing), [start, axis.length]
    for _ in range(len(where) + 20):
        mesh = _tube_mesh(axis, where, sides, first_normal, first_tangent)
        flat = shapes(mesh.nodes[mesh.tets]) < FLAT
        if not flat.any():
            break
        folded = np.unique(np.flatnonzero(flat) // (3 * sides))
        kept = np.array([v for w in windows for v in (w.low, w.high)] + ends)
        loose = _loose(where, folded, kept)
        low, high = where[folded[0]:folded[0] + 2]
        touching = [w for w in windows if w.low < high + 1e-9 and w.high > low - 1e-9]
        if loose:
            where = np.delete(where, loose)
        elif touching:
            _move_on(touching[0], windows, moves, first_low[touching[0].run], *ends)
            where = ring_positions(axis, start, windows, spacing)
        else:
            break
    return where, mesh


def _loose(where: np.ndarray, folded: np.ndarray, kept: np.ndarray) -> list[int]:
    """One ring of each folded slice that need not be kept; none of two slices side by side."""
    found: list[int] = []
    for low in folded:
        free = [ring for ring in (low + 1, low) if np.abs(where[ring] - kept).min() > 1e-9]
        if free and not (found and low <= found[-1]):
            found.append(int(free[0]))
    return found


def _move_on(window: Window, windows: list[Window], moves: dict[int, int], first_low: float,
             start: float, end: float) -> None:
    """Move a twig's slice to the next untried position, or give it up."""
    windows.remove(window)
    moves[window.run] += 1
    length = window.high - window.low
    for shift in _SHIFTS[moves[window.run] - 1:]:
        low = first_low + shift * length
        if start + 0.2 * length < low and low + length < end:
            windows.append(Window(window.run, low, low + length, window.outward))
            break
        moves[window.run] += 1


def _tube_mesh(axis: RunAxis, where: np.ndarray, sides: int, first_normal: np.ndarray | None,
               first_tangent: np.ndarray | None) -> TetMesh:
    """Tetrahedra of a tube with rings at positions ``where`` [m] along an axis."""
    centres = axis.at(where)
    tangent = tangents(centres)
    # The flat end replaces a round one of the same volume.
    centres[-1] += 2 / 3 * axis.radius[-1] * tangent[-1]
    if first_tangent is not None:
        tangent[0] = first_tangent
    normals, binormals = frames(centres, tangent, first_normal)
    ring = rings(centres, axis.radius_at(where), normals, binormals, sides, bending_factor(sides))
    return tube(centres, ring)


_STARTS, _LEANS = 60, (0.3, 0.8, 1.6)  # positions tried for a twig's first ring; its lean
_NEAR = 2.5  # radii beyond the first possible position within which the best one is used
_STRAIGHTENED = (0.0, 3.0, 6.0, 12.0)  # radii of a twig's start that may be straightened
_OTHERS = 4  # slices nearest to a twig's foot, tried where its own has no room
_THICK_TWIG = 0.5  # fraction of its carrier; such a twig uses two side faces and has six sides


@dataclass(frozen=True)
class SweptTree:
    """A swept mesh, linear and positively oriented, and the runs that could not be joined to it."""

    mesh: TetMesh
    left_out: list[int] = field(default_factory=list)


def sweep_tree(skeleton: Skeleton, *, spacing: float = 2.5) -> SweptTree:
    """Sweep prisms along each run, ``spacing`` local radii long, and join them at the forks.
    MeshingError if the main run bends too sharply for its thickness."""
    sweep = _TreeSweep(skeleton, spacing)
    for run in range(skeleton.branch_count):
        sweep.add_run(run)
    return sweep.result()


@dataclass
class _Swept:
    axis: RunAxis
    where: np.ndarray
    node: np.ndarray  # first node index of each ring: the centre, then its corners
    sides: int
    windows: dict[int, int]  # slice by run of the twig
    taken: set[tuple[int, int]] = field(default_factory=set)


class _TreeSweep:
    def __init__(self, skeleton: Skeleton, spacing: float):
        self._skeleton = skeleton
        self._spacing = spacing
        self._axes = [RunAxis.of(skeleton, run) for run in range(skeleton.branch_count)]
        starts = [members[0] for members in skeleton.runs()]
        self._carrier = [-1] + [int(skeleton.branch[start]) for start in starts[1:]]
        self._nodes = np.empty((0, 3))
        self._tets = np.empty((0, 4), np.int64)
        self._swept: dict[int, _Swept] = {}
        self._left_out: list[int] = []

    def result(self) -> SweptTree:
        return SweptTree(TetMesh(self._nodes, self._tets), self._left_out)

    def add_run(self, run: int) -> None:
        if run == 0:
            self._sweep(run, 0.0, 6, None)
            return
        carrier, axis = self._swept.get(self._carrier[run]), self._axes[run]
        if carrier is None:
            self._left_out.append(run)
            return
        for at in self._slices(carrier, run):
            for reach in _STRAIGHTENED:
                # A twig that starts along its carrier's side, or in a hook, leaves it on a straight
                # line instead.
                self._axes[run] = axis.straight_until(reach * float(axis.radius[0]))
                for patch in self._patches(carrier, run, at):
                    if self._grow(carrier, run, patch):
                        carrier.taken |= {(patch.slice, side) for side in patch.faces}
                        return
        self._axes[run] = axis
        self._left_out.append(run)

    def _slices(self, carrier: _Swept, run: int) -> list[int]:
        """Slices of the carrier that a twig may grow out of: its own, then those near it."""
        window = Window.of(carrier.axis, self._axes[run], run)
        if window is None:
            return []
        middle = (carrier.where[1:] + carrier.where[:-1]) / 2
        away = np.abs(middle - (window.low + window.high) / 2)
        near = [int(at) for at in np.argsort(away, kind="stable")[:_OTHERS]]
        own = [carrier.windows[run]] if run in carrier.windows else []
        return own + [at for at in near if at not in own]

    def _sweep(self, run: int, start: float, sides: int, first_normal: np.ndarray | None,
               first_tangent: np.ndarray | None = None) -> bool:
        axis = self._axes[run]
        twigs = [twig for twig in range(1, len(self._axes)) if self._carrier[twig] == run]
        windows = without_overlap(filter(None, (
            Window.of(axis, self._axes[twig], twig) for twig in twigs)), axis, start)
        first = len(self._nodes)
        where, mesh = unfolded(axis, start, windows, sides, self._spacing, first_normal,
                               first_tangent)
        if shapes(mesh.nodes[mesh.tets]).min() < 0.1 * FLAT:
            if run == 0:
                raise MeshingError("The main axis bends too sharply for its thickness.", "Prisms "
                                   "swept along it would overlap.", "Smooth the skeleton, or "
                                   "choose ", Option("mesher", "ftetwild"), ".")
            return False
        slices = {w.run: int(np.argmin(np.abs(where - w.low))) for w in windows
                  if np.abs(where - w.low).min() < 1e-9}
        self._nodes = np.vstack([self._nodes, mesh.nodes])
        self._tets = np.vstack([self._tets, mesh.tets + first])
        self._swept[run] = _Swept(axis, where, first + np.arange(len(where)) * (sides + 1), sides,
                                  slices)
        return True

    def _patches(self, carrier: _Swept, run: int, at: int) -> list[Patch]:
        """Side faces of the carrier's slice that the twig may start from, best first."""
        low, high = carrier.node[at], carrier.node[at + 1]
        sides = carrier.sides
        radius = float(self._axes[run].radius[1 if len(self._axes[run].radius) > 1 else 0])
        thick = sides == 6 and radius > _THICK_TWIG * float(
            carrier.axis.radius_at(carrier.where[at]))
        nodes = self._nodes
        middle = (nodes[low] + nodes[high]) / 2
        window = Window.of(carrier.axis, self._axes[run], run)
        if window is None:
            return []
        found = []
        for wide in ((2, 1) if thick else (1,)):
            for side in range(sides):
                faces = [(side + k) % sides for k in range(wide)]
                if any((at, face) in carrier.taken for face in faces):
                    continue
                corners = [1 + (side + k) % sides for k in range(wide + 1)]
                loop = [low + c for c in corners] + [high + c for c in reversed(corners)]
                direction = nodes[loop].mean(axis=0) - middle
                direction /= np.linalg.norm(direction)
                found.append((wide, float(direction @ window.outward),
                              Patch(at, faces, np.array(loop), direction)))
        found = [f for f in found if f[1] > -0.2]
        found.sort(key=lambda f: (-f[0], -f[1]))
        return [patch for _, _, patch in found]

    def _grow(self, carrier: _Swept, run: int, patch: Patch) -> bool:
        """Join the twig to the patch: find the best first ring clear of it, sweep, fill between."""
        axis = self._axes[run]
        corner = self._nodes[patch.loop]
        _, foot = axis.nearest(corner.mean(axis=0)[None])
        start, lean = np.meshgrid(np.linspace(foot[0], 0.75 * axis.length, _STARTS), _LEANS,
                                  indexing="ij")
        found = joints(axis, start.ravel(), lean.ravel(), patch, corner,
                       self._patch_triangles(patch))
        # The best one near the patch; those farther out are for twigs that leave at a small angle.
        near = [joint for joint in found if joint.start <= found[0].start + _NEAR * float(
            axis.radius_at(joint.start))]
        for joint in sorted(near, key=lambda one: -one.quality):
            first = len(self._nodes)
            if self._sweep(run, joint.start, len(patch.loop), joint.turn, joint.tangent):
                block = np.where(joint.tets >= 0, joint.tets, first - 1 - joint.tets)
                self._tets = np.vstack([self._tets, block])
                return True
        return False

    def _patch_triangles(self, patch: Patch) -> np.ndarray:
        """The carrier's boundary triangles on the patch, outward, shape [2 or 4, 3]."""
        inside = np.zeros(len(self._nodes), bool)
        inside[patch.loop] = True
        # Both tetrahedra at a face have three corners in the loop if the face has.
        near = self._tets[inside[self._tets].sum(axis=1) > 2]
        faces = TetMesh(np.empty((0, 3)), near).surface_faces()
        return faces[inside[faces].all(axis=1)]
