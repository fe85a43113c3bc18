"""Our own tetrahedra for forked branches, swept along the axes: deterministic and quick.

Each run is a stack of prisms around its axis, six sides, or four for a thin twig, with the second
moment of area of the round section, so that it bends like one. A twig grows out
of its carrier's side: the carrier has a slice there as long as the twig is thick, and one or two
of that slice's side faces are the twig's first cross-section. The block between them and the
twig's first ring is a fan of tetrahedra around that ring's centre.
"""

import itertools
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import MeshingError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import any_normal, bending_factor, frames, rings, tangents
from limber.geometry.tets.cylinder_mesh import split_wedges
from limber.geometry.tets.tet_mesh import TetMesh

_FLAT = 0.02  # a tetrahedron's shape under that (1 is regular) is avoided
_SHIFTS = (1, -1, 2, -2, 3, -3)  # where else a twig's slice may go, in its own lengths
_CLAMP_SLICES = (1.0, 3.0)  # where the first slices end, in radii of the root
_TAPERED, _THINNEST = 2.5, 0.06  # radius ratio from which rings are graded; down to which
_STARTS, _LEANS = 60, (0.3, 0.8, 1.6)  # where a twig's first ring is tried, and how far it leans
_NEAR = 2.5  # radii beyond the first place that will do, within which the best one is taken
_STRAIGHTENED = (0.0, 3.0, 6.0, 12.0)  # radii of a twig's start that may be led straight
# Where the main run's corners stand is tried in turn while a twig cannot be joined; in large trees,
# where one or the other always cannot, once.
_TURNS, _TURNED_MOST = tuple(np.deg2rad([0.0, 30.0, 15.0, 45.0])), 60
_THICK_TWIG = 0.5  # of its carrier's radius: such a twig takes two side faces and has six sides


@dataclass(frozen=True)
class SweptTree:
    """A swept mesh.

    Attributes:
        mesh: Linear, positively oriented.
        left_out: Runs of the skeleton that could not be joined to the mesh.
    """

    mesh: TetMesh
    left_out: list[int] = field(default_factory=list)


def sweep_tree(skeleton: Skeleton, *, spacing: float = 2.5) -> SweptTree:
    """Sweep prisms along each run of a skeleton and join them at the forks.

    Args:
        skeleton: Axes and radii.
        spacing: Length of a slice in local radii.

    Raises:
        MeshingError: the main run cannot be swept, since it bends more sharply than it is thick.
    """
    best, least = None, np.inf
    for turn in _TURNS if skeleton.branch_count <= _TURNED_MOST else _TURNS[:1]:
        sweep = _TreeSweep(skeleton, spacing, turn)
        for run in range(skeleton.branch_count):
            sweep.add_run(run)
        found = sweep.result()
        lost = float(skeleton.radius[np.isin(skeleton.branch, found.left_out)].sum())
        if lost < least:
            best, least = found, lost
        if not found.left_out:
            break
    return best


@dataclass
class _Axis:
    """One run's axis as a curve of its length."""

    points: np.ndarray
    radius: np.ndarray
    along: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, run: int) -> "_Axis":
        members = skeleton.runs()[run]
        points, radius = skeleton.nodes[members], skeleton.radius[members].copy()
        if run > 0:
            radius[0] = radius[1]
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        return cls(points, radius, along)

    @property
    def length(self) -> float:
        return float(self.along[-1])

    def straight_until(self, reach: float) -> "_Axis":
        """The axis without its bends up to ``reach`` [m] from its start."""
        kept = self.along >= min(reach, 0.5 * self.length)
        kept[0] = True
        points = self.points[kept]
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        return _Axis(points, self.radius[kept], np.concatenate([[0], np.cumsum(step)]))

    def at(self, where: np.ndarray | float) -> np.ndarray:
        return np.stack([np.interp(where, self.along, self.points[:, k]) for k in range(3)],
                        axis=-1)

    def radius_at(self, where: np.ndarray | float) -> np.ndarray:
        return np.interp(where, self.along, self.radius)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance of points from the axis [m], and where along it the foot is [m]."""
        where = np.linspace(0, self.length, max(8 * len(self.points), 50))
        distance, place = cKDTree(self.at(where)).query(points)
        return distance, where[place]


@dataclass
class _Window:
    """A slice of a carrier that a twig grows out of."""

    run: int
    low: float
    high: float
    outward: np.ndarray


@dataclass
class _Swept:
    axis: _Axis
    where: np.ndarray
    node: np.ndarray  # first node index of each ring: the centre; its corners follow
    sides: int
    centres: np.ndarray
    windows: dict[int, int]  # run of the twig -> slice
    taken: set[tuple[int, int]] = field(default_factory=set)


class _TreeSweep:
    def __init__(self, skeleton: Skeleton, spacing: float, turn: float = 0.0):
        self._skeleton = skeleton
        self._spacing = spacing
        self._turn = turn
        self._axes = [_Axis.of(skeleton, run) for run in range(skeleton.branch_count)]
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
            self._sweep(run, 0.0, 6, self._first_normal())
            return
        carrier = self._swept.get(self._carrier[run])
        if carrier is None or run not in carrier.windows:
            self._left_out.append(run)
            return
        axis = self._axes[run]
        for reach in _STRAIGHTENED:
            # A twig that starts along its carrier's side, or in a hook, is led out of it straight.
            self._axes[run] = axis.straight_until(reach * float(axis.radius[0]))
            for patch in self._patches(carrier, run):
                if self._grow(carrier, run, patch):
                    carrier.taken |= {(patch.slice, side) for side in patch.faces}
                    return
        self._axes[run] = axis
        self._left_out.append(run)

    def _first_normal(self) -> np.ndarray | None:
        """Where the main run's first corner stands; None: anywhere."""
        if self._turn == 0:
            return None
        way = self._axes[0].points[1] - self._axes[0].points[0]
        normal = any_normal(way)
        other = np.cross(way / np.linalg.norm(way), normal)
        return np.cos(self._turn) * normal + np.sin(self._turn) * other

    def _sweep(self, run: int, start: float, sides: int, first_normal: np.ndarray | None,
               first_tangent: np.ndarray | None = None) -> bool:
        axis = self._axes[run]
        windows = self._plan_windows(run, start)
        first = len(self._nodes)
        where, mesh, centres = self._unfolded(axis, start, windows, sides, first_normal,
                                              first_tangent)
        nodes = mesh.nodes
        if _shapes(nodes, mesh.tets).min() < 0.1 * _FLAT:
            if run == 0:
                raise MeshingError("The main axis bends more sharply than it is thick.",
                                   "Prisms swept along it would overlap.",
                                   "Smooth the skeleton, or choose --mesher ftetwild.")
            return False
        slices = {w.run: int(np.argmin(np.abs(where - w.low))) for w in windows
                  if np.abs(where - w.low).min() < 1e-9}
        self._nodes = np.vstack([self._nodes, nodes])
        self._tets = np.vstack([self._tets, mesh.tets + first])
        self._swept[run] = _Swept(axis, where, first + np.arange(len(where)) * (sides + 1), sides,
                                  centres, slices)
        return True

    def _unfolded(self, axis: _Axis, start: float, windows: list["_Window"], sides: int,
                  first_normal: np.ndarray | None, first_tangent: np.ndarray | None,
                  ) -> tuple[np.ndarray, TetMesh, np.ndarray]:
        """Rings along an axis whose prisms are not folded over, if that can be had.

        Cross-sections cross in a sharp bend; with one fewer they may not. A twig's slice there
        moves along the axis, and is given up (taken from ``windows``) when no place is left.
        """
        moves = {window.run: 0 for window in windows}
        first_low = {window.run: window.low for window in windows}
        where = self._ring_places(axis, start, windows)
        for _ in range(4 * len(where) + 20):
            mesh, centres = _tube_mesh(axis, where, sides, first_normal, first_tangent)
            flat = _shapes(mesh.nodes, mesh.tets) < _FLAT
            wrong = np.unique(np.flatnonzero(flat) // (3 * sides))
            if not len(wrong):
                break
            low, high = where[wrong[0]], where[wrong[0] + 1]
            touching = [w for w in windows if w.low < high + 1e-9 and w.high > low - 1e-9]
            edges = [v for w in windows for v in (w.low, w.high)] + [start, axis.length]
            loose = [r for r in (wrong[0], wrong[0] + 1)
                     if min(abs(where[r] - v) for v in edges) > 1e-9]
            if loose:
                where = np.delete(where, loose[-1])
            elif touching:
                window = touching[0]
                windows.remove(window)
                moves[window.run] += 1
                length = window.high - window.low
                for shift in _SHIFTS[moves[window.run] - 1:]:
                    low = first_low[window.run] + shift * length
                    if start + 0.2 * length < low and low + length < axis.length:
                        windows.append(_Window(window.run, low, low + length, window.outward))
                        break
                    moves[window.run] += 1
                where = self._ring_places(axis, start, windows)
            else:
                break
        return where, mesh, centres

    def _plan_windows(self, run: int, start: float) -> list[_Window]:
        """Where along this run its twigs grow out, without overlap in one place."""
        axis = self._axes[run]
        planned = []
        for twig in range(1, self._skeleton.branch_count):
            if self._carrier[twig] == run:
                window = self._window(axis, twig)
                if window is not None:
                    planned.append(window)
        planned.sort(key=lambda w: w.low + w.high)
        end = axis.length + 1e-12
        placed: list[_Window] = []
        free = start + 0.3 * float(axis.radius_at(start))
        for window in planned:
            length = window.high - window.low
            low = window.low
            if placed:
                last = placed[-1]
                near = abs(low + length / 2 - (last.low + last.high) / 2) < 0.6 * (
                    last.high - last.low)
                apart = window.outward @ last.outward < 0.3
                if near and apart:
                    placed.append(_Window(window.run, last.low, last.high, window.outward))
                    continue
            low = max(min(low, axis.length - length), free)
            if low + 0.5 * length > end:
                continue
            high = min(low + length, end)
            placed.append(_Window(window.run, low, high, window.outward))
            free = high + 0.25 * length
        return placed

    def _window(self, axis: _Axis, twig: int) -> _Window | None:
        own = self._axes[twig]
        where = np.linspace(0, own.length, 200)
        distance, foot = axis.nearest(own.at(where))
        out = np.flatnonzero(distance > axis.radius_at(foot))
        if len(out) == 0:
            return None
        exit_point, place = own.at(where[out[0]]), foot[out[0]]
        outward = exit_point - axis.at(place)
        outward /= max(np.linalg.norm(outward), 1e-300)
        half = 1.25 * float(own.radius_at(where[out[0]]))
        return _Window(twig, place - half, place + half, outward)

    def _is_tapered(self, axis: _Axis, low: float, high: float) -> bool:
        radii = axis.radius_at(np.linspace(low, high, 20))
        return bool(radii.max() > _TAPERED * radii.min())

    def _graded(self, axis: _Axis, low: float, high: float) -> np.ndarray:
        """Places of rings where the radius changes much: closer where it is thin.

        Slices as long as suits the middle would be needles at a thin end, which look as if they
        were folded over.
        """
        along = np.linspace(low, high, 400)
        radii = axis.radius_at(along)
        pitch = self._spacing * np.maximum(radii, _THINNEST * radii.max())
        rings = np.concatenate([[0.0], np.cumsum((1 / pitch[1:] + 1 / pitch[:-1]) / 2
                                                 * np.diff(along))])
        count = max(round(float(rings[-1])), 1)
        return np.interp(np.linspace(0, rings[-1], count + 1), rings, along)

    def _ring_places(self, axis: _Axis, start: float, windows: list[_Window]) -> np.ndarray:
        fixed = sorted({round(v, 12) for w in windows for v in (w.low, w.high)})
        marks = [start, *[v for v in fixed if start < v < axis.length], axis.length]
        inside = {(round(w.low, 12), round(w.high, 12)) for w in windows}
        places = [start]
        if start == 0.0 and len(marks) > 1:
            # Short slices at the clamp, which keeps the section from narrowing where it is
            # stretched: long ones there made a cantilever 0.4 % too stiff, at any length elsewhere.
            near = [g * float(axis.radius[0]) for g in _CLAMP_SLICES]
            places += [v for v in near if v + near[0] < marks[1]]
            marks[0] = places[-1]
        for low, high in itertools.pairwise(marks):
            size = self._spacing * float(axis.radius_at((low + high) / 2))
            within = any(a <= low + 1e-9 and high <= b + 1e-9 for a, b in inside)
            count = 1 if within else max(round((high - low) / size), 1)
            between = np.linspace(low, high, count + 1)
            if not within and self._is_tapered(axis, low, high):
                between = self._graded(axis, low, high)
            places += list(between[1:])
        if len(places) < 3:
            places = list(np.linspace(start, axis.length, 3))
        return np.array(places)

    def _patches(self, carrier: _Swept, run: int) -> list["_Patch"]:
        """Side faces of the carrier's slice that the twig may start from, best first."""
        at = carrier.windows[run]
        low, high = carrier.node[at], carrier.node[at + 1]
        sides = carrier.sides
        radius = float(self._axes[run].radius[1 if len(self._axes[run].radius) > 1 else 0])
        thick = sides == 6 and radius > _THICK_TWIG * float(
            carrier.axis.radius_at(carrier.where[at]))
        nodes = self._nodes
        middle = (nodes[low] + nodes[high]) / 2
        outward = next(w.outward for w in self._plan_windows_of(carrier, run))
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
                found.append((wide, float(direction @ outward),
                              _Patch(at, faces, np.array(loop), direction)))
        found = [f for f in found if f[1] > -0.2]
        found.sort(key=lambda f: (-f[0], -f[1]))
        return [patch for _, _, patch in found]

    def _plan_windows_of(self, carrier: _Swept, run: int) -> list[_Window]:
        window = self._window(carrier.axis, run)
        return [window] if window is not None else []

    def _grow(self, carrier: _Swept, run: int, patch: "_Patch") -> bool:
        """Join the twig to the patch: find the best first ring clear of it, sweep, fill between."""
        axis = self._axes[run]
        corner = self._nodes[patch.loop]
        _, foot = axis.nearest(corner.mean(axis=0)[None])
        start, lean = np.meshgrid(np.linspace(foot[0], 0.75 * axis.length, _STARTS), _LEANS,
                                  indexing="ij")
        joints = _joints(axis, start.ravel(), lean.ravel(), patch, corner,
                         self._patch_triangles(patch))
        # The best one near the patch: those farther out are for twigs that leave at a small angle.
        near = [joint for joint in joints if joint.start <= joints[0].start + _NEAR * float(
            axis.radius_at(joint.start))]
        for joint in sorted(near, key=lambda found: -found.quality):
            first = len(self._nodes)
            if self._sweep(run, joint.start, len(patch.loop), joint.turn, joint.tangent):
                block = np.where(joint.tets >= 0, joint.tets, first - 1 - joint.tets)
                self._tets = np.vstack([self._tets, block])
                return True
        return False

    def _patch_triangles(self, patch: "_Patch") -> np.ndarray:
        """The carrier's boundary triangles on the patch, outward, shape [2 or 4, 3]."""
        inside = np.zeros(len(self._nodes), bool)
        inside[patch.loop] = True
        # Both tetrahedra at a face have three corners in the loop if the face has.
        near = self._tets[inside[self._tets].sum(axis=1) > 2]
        faces = TetMesh(np.empty((0, 3)), near).surface_faces()
        return faces[inside[faces].all(axis=1)]


@dataclass(frozen=True)
class _Patch:
    slice: int
    faces: list[int]
    loop: np.ndarray
    outward: np.ndarray


@dataclass(frozen=True)
class _Joint:
    start: float
    tangent: np.ndarray
    turn: np.ndarray
    tets: np.ndarray
    quality: float


def _tube_mesh(axis: _Axis, where: np.ndarray, sides: int, first_normal: np.ndarray | None,
               first_tangent: np.ndarray | None) -> tuple[TetMesh, np.ndarray]:
    """Tetrahedra of a tube with rings at places ``where``, and the rings' centres."""
    centres = axis.at(where)
    tangent = tangents(centres)
    # The flat end stands for a round one of the same volume.
    centres[-1] += 2 / 3 * axis.radius[-1] * tangent[-1]
    if first_tangent is not None:
        tangent[0] = first_tangent
    normals, binormals = frames(centres, tangent, first_normal)
    ring = rings(centres, axis.radius_at(where), normals, binormals, sides, bending_factor(sides))
    nodes = np.concatenate([centres[:, None], ring], axis=1).reshape(-1, 3)
    return TetMesh(nodes, split_wedges(_wedges(len(where), sides))), centres


def _wedges(ring_count: int, sides: int) -> np.ndarray:
    k = np.arange(sides)
    a, b = 1 + k, 1 + (k + 1) % sides
    low = np.arange(ring_count - 1)[:, None] * (sides + 1)
    high = low + sides + 1
    zero = np.zeros(sides, np.int64)
    return np.stack([low + zero, low + a, low + b, high + zero, high + a, high + b],
                    axis=2).reshape(-1, 6)


def _joints(axis: _Axis, start: np.ndarray, lean: np.ndarray, patch: _Patch, corner: np.ndarray,
            triangles: np.ndarray) -> list[_Joint]:
    """The sound blocks between a patch and a twig's first ring.

    Args:
        axis: The twig's.
        start: Where along it the ring may be [m], shape [j].
        lean: How far the ring leans over towards the patch, shape [j].
        patch: What the twig grows out of.
        corner: The patch's corners [m], shape [sides, 3].
        triangles: The carrier's faces there, node indices, shape [2 or 4, 3].
    """
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
    joints = []
    for place in np.flatnonzero(quality >= _FLAT):
        order = patch.loop[::-1] if backwards[place] else patch.loop
        numbers = np.concatenate([order, -1 - np.arange(sides + 1)])
        joints.append(_Joint(float(start[place]), tangent[place], turn[place],
                             numbers[block[place]], float(quality[place])))
    return joints


def _matched(corner: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which way a patch's corners run about each twig, and the first normal of each one's ring.

    Ring corner k then stands over patch corner k with the least twist.

    Args:
        corner: The patch's corners [m], shape [sides, 3].
        tangent: Directions of the twigs, shape [j, 3].

    Returns:
        Whether the corners must be taken backwards, to run counter-clockwise, shape [j]; normals,
        shape [j, 3].
    """
    first = _unit(np.cross(tangent, np.eye(3)[np.argmin(np.abs(tangent), axis=1)]))
    second = np.cross(tangent, first)
    flat = corner - corner.mean(axis=0)
    angle = np.arctan2(second @ flat.T, first @ flat.T)
    backwards = np.sin(np.roll(angle, -1, axis=1) - angle).sum(axis=1) < 0
    angle = np.where(backwards[:, None], angle[:, ::-1], angle)
    even = 2 * np.pi * np.arange(len(corner)) / len(corner)
    offset = np.angle(np.exp(1j * (angle - even)).sum(axis=1))[:, None]
    return backwards, np.cos(offset) * first + np.sin(offset) * second


def _blocks(nodes: np.ndarray, below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra between a patch and each ring, and the flattest shape among them.

    Args:
        nodes: The patch's corners, the ring's centre and its corners [m], shape
            [j, 2 sides + 1, 3].
        below: The carrier's triangles on the patch, shape [j, 2 or 4, 3].

    Returns:
        Indices into ``nodes``, shape [j, t, 4]; smallest shape (1 is regular, negative inverted),
        shape [j].
    """
    count, sides = len(nodes), (nodes.shape[1] - 1) // 2
    k = np.arange(sides)
    after, top = (k + 1) % sides, sides
    a, b, top_a, top_b = k, after, sides + 1 + k, sides + 1 + after
    hub = np.full(sides, top)
    # Each side quadrilateral lies on the surface, so either diagonal will do.
    one = np.stack([[b, a, top_b, hub], [top_b, a, top_a, hub]], axis=0).transpose(2, 0, 1)
    two = np.stack([[b, a, top_a, hub], [top_b, b, top_a, hub]], axis=0).transpose(2, 0, 1)
    shape_one, shape_two = (_shape(nodes[:, cut]).min(axis=2) for cut in (one, two))
    sidewise = np.where((shape_one >= shape_two)[:, :, None, None], one, two)
    under = np.concatenate([below, np.full((*below.shape[:2], 1), top)], axis=2)
    block = np.concatenate([under, sidewise.reshape(count, -1, 4)], axis=1)
    corner = nodes[np.arange(count)[:, None, None], block]
    return block, _shape(corner).min(axis=1)


def _shapes(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    return _shape(nodes[tets])


def _shape(corner: np.ndarray) -> np.ndarray:
    """Volume over the cube of the mean edge, 1 for a regular tetrahedron, negative if inverted.

    Args:
        corner: Corners [m], shape [..., 4, 3].
    """
    edges = [corner[..., i, :] - corner[..., j, :] for i in range(4) for j in range(i)]
    square = sum(np.einsum("...k,...k->...", e, e) for e in edges) / 6
    a, b, c = (corner[..., k, :] - corner[..., 0, :] for k in (1, 2, 3))
    volume = np.einsum("...k,...k->...", a, np.cross(b, c)) / 6
    return 6 * np.sqrt(2) * volume / np.maximum(square, 1e-300)**1.5


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]
