"""What stands in a world (wood, leaves), and what sensors see of it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.worlds.plants import Plant, sheet_triangles

WOOD, LEAF = 0, 1


@dataclass(frozen=True)
class Scene:
    """Triangles [m], shape [t, 3, 3], and what each belongs to (``WOOD``, ...), shape [t]."""

    triangles: np.ndarray
    label: np.ndarray

    @classmethod
    def bare(cls, plant: Plant) -> "Scene":
        skin = plant.skin()
        return cls(skin, np.full(len(skin), WOOD))

    def plus(self, triangles: np.ndarray, label: int) -> "Scene":
        return Scene(np.concatenate([self.triangles, triangles]),
                     np.concatenate([self.label, np.full(len(triangles), label)]))


def leafy(plant: Plant, rng: np.random.Generator) -> Scene:
    """With curved blades on the outer half of the twigs and at all tips."""
    scene = Scene.bare(plant)
    skeleton = plant.skeleton
    depth = skeleton.arc_length
    outer = np.flatnonzero((skeleton.radius < np.median(skeleton.radius))
                           & (depth > 0.3 * depth.max()))
    at = np.concatenate([skeleton.tips(), rng.choice(outer, min(len(outer), int(
        rng.integers(8, 30))), replace=False)])
    for node in at:
        along = skeleton.nodes[node] - skeleton.nodes[skeleton.parent[node]]
        scene = scene.plus(_blade(skeleton.nodes[node], along, rng), LEAF)
    return scene


def _blade(at: np.ndarray, along: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A leaf with a stalk's gap of 4 mm, arched along and across."""
    along = along / max(float(np.linalg.norm(along)), 1e-9) + 0.8 * rng.normal(size=3)
    along /= np.linalg.norm(along)
    across = np.cross(along, rng.normal(size=3))
    across /= np.linalg.norm(across)
    long, wide = rng.uniform(0.03, 0.09), rng.uniform(0.01, 0.03)
    u, v = np.meshgrid(np.linspace(0, 1, 12), np.linspace(-1, 1, 7), indexing="ij")
    width = wide * np.sin(np.pi * np.clip(u, 0.02, 0.98))**0.8 * v
    rise = -0.3 * long * u**2 + 0.25 * wide * v**2
    grid = (at + 0.004 * along + long * u[..., None] * along + width[..., None] * across
            + rise[..., None] * np.cross(along, across))
    return sheet_triangles(grid)


def revolved(base: np.ndarray, profile: list[tuple[float, float]]) -> np.ndarray:
    """A profile of (radius, height) [m] turned about the vertical through ``base``."""
    angle = np.linspace(0, 2 * np.pi, 33)[:-1]
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(32)], axis=1)
    return sheet_triangles(np.array([base + radius * ring + [0, 0, height]
                                     for radius, height in profile]), closed=True)


# --- rays through the pixels of a view against triangles: the nearest hit of each ---------------


@dataclass(frozen=True)
class Hits:
    """First hits of a view's rays.

    Attributes:
        eye: Position of the sensor [m], shape [3].
        axes: Right, down and forward of the view, shape [3, 3].
        way: Unit direction of each ray, shape [n, 3].
        distance: To the hit [m], shape [n].
        incidence: Cosine between ray and surface normal, 0 to 1, shape [n].
        triangle: Index of the hit triangle, shape [n].
        edge: Whether a neighbouring ray misses, or hits a centimetre or more off, shape [n].
    """

    eye: np.ndarray
    axes: np.ndarray
    way: np.ndarray
    distance: np.ndarray
    incidence: np.ndarray
    triangle: np.ndarray
    edge: np.ndarray


def cast(triangles: np.ndarray, eye: np.ndarray, at: np.ndarray, pitch: float,
         jitter: np.ndarray | None = None) -> Hits:
    """Look from ``eye`` towards ``at`` [m] with rays ``pitch`` apart (of a distance of 1).

    Args:
        triangles: Shape [t, 3, 3].
        eye: Shape [3]. at: Shape [3].
        pitch: Distance of neighbouring rays in the plane one unit ahead.
        jitter: Shift of the grid of rays in pitches, shape [2].
    """
    axes = _view(at - eye)
    seen = (triangles - eye) @ axes.T
    facing = np.flatnonzero((seen[:, :, 2] > 0.02).all(axis=1))
    seen = seen[facing]
    flat = seen[:, :, :2] / seen[:, :, 2:] / pitch - (0.0 if jitter is None else jitter)
    low = np.ceil(flat.min(axis=1)).astype(np.int64)
    size = np.maximum(np.floor(flat.max(axis=1)).astype(np.int64) - low + 1, 0)
    count = size.prod(axis=1)
    owner = np.repeat(np.arange(len(seen)), count)
    inside = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    pixel = low[owner] + np.stack([inside // size[owner, 1], inside % size[owner, 1]], axis=1)
    shift = 0.0 if jitter is None else jitter
    ray = np.column_stack([(pixel + shift) * pitch, np.ones(len(pixel))])
    depth, normal = _crossing(seen, owner, ray)
    hit = depth > 0
    owner, pixel, ray, depth = owner[hit], pixel[hit], ray[hit], depth[hit]
    order = np.lexsort([depth, pixel[:, 1], pixel[:, 0]])
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(pixel[order], axis=0) != 0).any(axis=1)
    kept = order[first]
    pixel, ray, depth, owner = pixel[kept], ray[kept], depth[kept], owner[kept]
    long = np.linalg.norm(ray, axis=1)
    towards = np.abs(np.einsum("ij,ij->i", ray / long[:, None], normal[owner]))
    return Hits(eye, axes, ray / long[:, None] @ axes, depth * long, towards, facing[owner],
                _edges(pixel, depth))


def _crossing(seen: np.ndarray, owner: np.ndarray, ray: np.ndarray,
              ) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] at which each ray crosses its triangle, -1 where it misses; triangle normals."""
    one, two = seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0]
    normal = np.cross(one, two)
    size = np.linalg.norm(normal, axis=1)
    across = np.cross(ray, two[owner])
    scale = np.einsum("ij,ij->i", one[owner], across)
    scale = np.where(np.abs(scale) < 1e-18, 1e-18, scale)
    start = -seen[owner, 0]
    u = np.einsum("ij,ij->i", start, across) / scale
    turned = np.cross(start, one[owner])
    v = np.einsum("ij,ij->i", ray, turned) / scale
    depth = np.einsum("ij,ij->i", two[owner], turned) / scale
    good = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0)
    return np.where(good, depth, -1.0), normal / np.maximum(size, 1e-18)[:, None]


def _edges(pixel: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Pixels beside a miss or a step of a centimetre."""
    corner = pixel.min(axis=0) - 1
    image = np.full(pixel.max(axis=0) - corner + 2, np.inf)
    row, column = (pixel - corner).T
    image[row, column] = depth
    found = np.zeros(len(pixel), bool)
    for down, right in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        found |= np.abs(image[row + down, column + right] - depth) > 0.01
    return found


def _view(forward: np.ndarray) -> np.ndarray:
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.95 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


# --- sensors: where they stand, what they see, and how they err ---------------------------------


@dataclass(frozen=True)
class Seen:
    """A cloud [m], shape [n, 3], what each point is on, shape [n], and up in its axes.

    ``turn`` and ``shift`` bring the scene into the cloud's frame: ``turn @ (place - shift)``.
    """

    points: np.ndarray
    label: np.ndarray
    turn: np.ndarray
    shift: np.ndarray

    def placed(self, places: np.ndarray) -> np.ndarray:
        """Places of the scene [m], shape [n, 3], in the cloud's frame."""
        return (places - self.shift) @ self.turn.T


def one_station(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """A terrestrial laser scanner: noise along its rays, blurred edges, coordinates on a map."""
    return stations(scene, rng, noise, 1)


def stations(scene: Scene, rng: np.random.Generator, noise: float, count: int = 0) -> Seen:
    """Three to five stations all around, each with its own error of registration."""
    count = count or int(rng.integers(3, 6))
    middle, size = _middle(scene)
    begin, parts, labels = rng.uniform(0, 2 * np.pi), [], []
    spacing = rng.uniform(0.0013, 0.0022) * (1 if count == 1 else 1.5)
    for number in range(count):
        angle = begin + 2 * np.pi * number / count + rng.normal(0, 0.15)
        far = rng.uniform(2.5, 5.0) * size
        eye = middle + [far * np.cos(angle), far * np.sin(angle), rng.uniform(-0.3, 1.0) * size]
        hits = cast(scene.triangles, eye, middle, spacing / far, rng.uniform(0, 1, 2))
        spread = noise / np.sqrt(np.maximum(hits.incidence, 0.1))
        range_error = spread * rng.normal(size=len(spread)) + np.where(
            hits.edge & (rng.uniform(size=len(spread)) < 0.1), rng.exponential(0.004, len(spread)),
            0.0)
        points = _at(hits, range_error) + rng.normal(0, 0.0003 if count > 1 else 0.0, 3)
        kept = hits.incidence > 0.05
        parts.append(points[kept])
        labels.append(scene.label[hits.triangle[kept]])
    # One station's file may have its origin at the scanner, or be on a map as several are.
    origin = eye if count == 1 and rng.uniform() < 0.5 else np.round(rng.uniform(-50, 50, 3), 2)
    return _placed(np.vstack(parts), np.concatenate(labels), shift=origin)


def depth_camera(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """One image in the camera's frame; ``noise`` [m] is that of a surface seen face on.

    Structured light and stereo round to steps of disparity and err jointly in patches, time of
    flight does not; all err more at grazing angles, and mix depths at edges.
    """
    middle, size = _middle(scene)
    angle = rng.uniform(0, 2 * np.pi)
    far = 1.1 * size
    eye = middle + far * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.2, 0.3)])
    hits = cast(scene.triangles, eye, middle, rng.uniform(0.0013, 0.002) / far)
    depth = hits.distance * (hits.way @ hits.axes[2])
    spread = noise * (depth / far)**2 / np.maximum(hits.incidence, 0.15)
    error = spread * rng.normal(size=len(depth))
    if rng.uniform() < 0.6:
        waves = rng.normal(size=(12, 3)) * 40.0
        error = 0.7 * error + 0.7 * noise * np.sin(
            _at(hits, 0.0) @ waves.T + rng.uniform(0, 6.3, 12)).sum(axis=1) / np.sqrt(6)
        step = 0.5 * noise * (depth / far)**2
        error = np.round((depth + error) / step) * step - depth
    flying = hits.edge & (rng.uniform(size=len(depth)) < 0.06)
    error = np.where(flying, error + rng.exponential(0.02, len(depth)), error)
    kept = hits.incidence > 0.12
    return _placed(_at(hits, error / (depth / hits.distance))[kept],
                   scene.label[hits.triangle[kept]], hits.axes, eye)


def photogrammetry(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """Structure from motion: heavy tails, blur, holes, stray points, a scale that drifts."""
    points, label = _walked(scene, rng, 10, 0.0024, 0.0)
    holes = points[rng.integers(len(points), size=6)]
    away = cKDTree(holes).query(points)[0]
    kept = (away > rng.uniform(0.004, 0.012)) & (rng.uniform(size=len(points)) < 0.6)
    points, label = points[kept], label[kept]
    near = cKDTree(points).query(points, k=6)[1]
    points = 0.5 * points + 0.5 * points[near].mean(axis=1)
    points = points + 0.6 * noise * rng.standard_t(3, size=points.shape)
    stray = rng.integers(len(points), size=len(points) // 50)
    points[stray] += rng.normal(0, 0.02, (len(stray), 3))
    base = points[:, 2].min()
    points = points * (1 + 0.004 * rng.normal() * ((points[:, 2] - base) / np.ptp(points[:, 2]))[
        :, None])
    return _placed(points, label)


def hand_scanner(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """Many close frames whose pose drifts; small noise of its own, merged on a fine grid."""
    points, label = _walked(scene, rng, 14, 0.002, 0.3 * noise)
    points = points + 0.5 * noise * rng.normal(size=points.shape)
    _, first = np.unique(np.round(points / 0.0017).astype(int), axis=0, return_index=True)
    return _placed(points[first], label[first])


def strewn(scene: Scene, rng: np.random.Generator, noise: float) -> Seen:
    """Points anywhere on the surfaces, seen or not, with the same noise in all directions."""
    start, one, other = scene.triangles.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(one - start, other - start), axis=1) / 2
    own = rng.choice(len(area), int(area.sum() / rng.uniform(0.003, 0.008)**2),
                     p=area / area.sum())
    points = np.einsum("tk,tkj->tj", rng.dirichlet(np.ones(3), len(own)), scene.triangles[own])
    return _placed(points + rng.normal(0, noise, points.shape), scene.label[own])


def _walked(scene: Scene, rng: np.random.Generator, views: int, spacing: float, drift: float,
            ) -> tuple[np.ndarray, np.ndarray]:
    """Hits of views on a walk around, whose pose errors [m] add up, and their labels."""
    middle, size = _middle(scene)
    error, parts, labels = np.zeros(3), [], []
    for angle in np.linspace(0, 2 * np.pi, views, endpoint=False):
        far = rng.uniform(0.9, 1.4) * size
        eye = middle + far * np.array([np.cos(angle), np.sin(angle), rng.uniform(-0.5, 0.6)])
        hits = cast(scene.triangles, eye, middle, spacing * np.sqrt(views / 3) / far,
                    rng.uniform(0, 1, 2))
        kept = hits.incidence > 0.25
        error = 0.8 * error + rng.normal(0, drift, 3)
        parts.append(_at(hits, 0.0)[kept] + error)
        labels.append(scene.label[hits.triangle[kept]])
    return np.vstack(parts), np.concatenate(labels)


def _at(hits: Hits, error: np.ndarray | float) -> np.ndarray:
    """Positions [m] of hits whose ranges have an error [m]."""
    return hits.eye + (hits.distance + error)[:, None] * hits.way


def _middle(scene: Scene) -> tuple[np.ndarray, float]:
    """Middle [m] and size [m] of a scene."""
    low, high = scene.triangles.min(axis=(0, 1)), scene.triangles.max(axis=(0, 1))
    return (low + high) / 2, float((high - low).max())


def _placed(points: np.ndarray, label: np.ndarray, turn: np.ndarray | None = None,
            shift: np.ndarray | None = None) -> Seen:
    turn = np.eye(3) if turn is None else turn
    shift = np.zeros(3) if shift is None else shift
    return Seen((points - shift) @ turn.T, label, turn, shift)


ONE_SIDED = (one_station, depth_camera)
ALL_AROUND = (stations, photogrammetry, hand_scanner)
