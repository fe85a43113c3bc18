"""Triangles of an implicit surface: marching tetrahedra, then smoothing on the surface itself."""

from collections.abc import Callable

import numpy as np

from limber.geometry.surface.surface import Surface

_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0],
                     [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
# Six tetrahedra around the diagonal 0-7 of a cube (Kuhn): the same in each cube, so faces match.
_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7],
                  [0, 5, 1, 7]])
_ROUNDS = 2  # rounds of smoothing of the vertices
_NEAR = 0.05  # fraction of the step; a closer lattice point would make a sliver


def level_surface(level: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray,
                  step: float) -> Surface:
    """Triangles of ``level(x) = 0`` around the solid where it is negative; closed by the box.

    Marching tetrahedra (Doi and Koide 1991) on Kuhn's subdivision of a cubic lattice, which has
    no ambiguous case: the result is a closed manifold. Vertices then move to the mean of their
    neighbours and back along the gradient, which evens out the triangles.

    Args:
        level: Approximate distance [m] of points [n, 3], negative inside; called for many at once.
        low: Corner of the box [m], shape [3].
        high: The opposite corner [m].
        step: Edge of the lattice's cubes [m].
    """
    count = np.maximum(np.ceil((high - low) / step).astype(int), 1) + 1
    axes = [low[k] + step * np.arange(count[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    value = level(points)
    value = np.where(np.abs(value) < _NEAR * step, np.where(value < 0, -1, 1) * _NEAR * step,
                     value)
    grid = value.reshape(count)
    for axis in range(3):  # the box closes cut surfaces
        for end in (0, -1):
            face: list[slice | int] = [slice(None)] * 3
            face[axis] = end
            grid[tuple(face)] = np.maximum(grid[tuple(face)], _NEAR * step)
    surface = _march(points, grid)
    return _evened(surface, level, step) if len(surface.faces) else surface


def _march(points: np.ndarray, grid: np.ndarray) -> Surface:
    inside = grid < 0
    count = np.array(grid.shape)
    parts = [inside[c[0]:count[0] - 1 + c[0], c[1]:count[1] - 1 + c[1], c[2]:count[2] - 1 + c[2]]
             for c in _CORNERS]
    number = sum(part.astype(np.int8) for part in parts)
    cube = np.argwhere((number > 0) & (number < 8))
    if not len(cube):
        return Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))
    corner = np.ravel_multi_index(
        (cube[:, None] + _CORNERS[None]).reshape(-1, 3).T, grid.shape).reshape(-1, 8)
    tets = corner[:, _TETS].reshape(-1, 4)
    value = grid.ravel()
    # Corners inside come first, so that their number gives the case; the parity of the order is
    # kept.
    order = np.argsort(value[tets] >= 0, axis=1, kind="stable")
    odd = np.zeros(len(order), bool)
    for i in range(4):
        for j in range(i):
            odd ^= order[:, j] > order[:, i]
    tets = np.take_along_axis(tets, order, axis=1)
    within = (value[tets] < 0).sum(axis=1)
    edges, flip = [], []
    one, two, three = (np.flatnonzero(within == k) for k in (1, 2, 3))
    a, b, c, d = (tets[:, k] for k in range(4))

    def add(chosen: np.ndarray, *ends: tuple[np.ndarray, np.ndarray], turned: bool) -> None:
        edges.append(np.stack([np.stack([p[chosen], q[chosen]], axis=1) for p, q in ends], axis=1))
        flip.append(odd[chosen] ^ turned)

    add(one, (a, b), (a, c), (a, d), turned=False)
    add(two, (a, c), (a, d), (b, d), turned=False)
    add(two, (a, c), (b, d), (b, c), turned=False)
    add(three, (a, d), (b, d), (c, d), turned=False)
    corners, turned = np.vstack(edges), np.concatenate(flip)
    pairs = corners.reshape(-1, 2)
    # Both ends in one number: this sorts ten times as fast as rows.
    unique, index = np.unique(pairs.min(axis=1) * grid.size + pairs.max(axis=1),
                              return_inverse=True)
    faces = index.reshape(-1, 3)
    faces[turned] = faces[turned][:, ::-1]
    first, second = np.divmod(unique, grid.size)
    low, high = value[first], value[second]
    share = (low / (low - high))[:, None]
    vertices = points[first] + share * (points[second] - points[first])
    surface = Surface(vertices, faces)
    return surface if surface.volume > 0 else Surface(vertices, faces[:, ::-1])


def _evened(surface: Surface, level: Callable[[np.ndarray], np.ndarray], step: float,
            ) -> Surface:
    from scipy.sparse import coo_matrix

    vertices, faces = surface.vertices, surface.faces
    rows, columns = faces.ravel(), faces[:, [1, 2, 0]].ravel()  # each edge, once in each direction
    near = coo_matrix((np.ones(len(rows)), (rows, columns)), (len(vertices),) * 2).tocsr()
    degree = np.asarray(near.sum(axis=1))
    for _ in range(_ROUNDS):
        for _ in range(2):
            vertices = (vertices + near @ vertices / degree) / 2
        vertices = _onto(vertices, level, step)
    return Surface(vertices, faces)


def _onto(points: np.ndarray, level: Callable[[np.ndarray], np.ndarray], step: float,
          ) -> np.ndarray:
    """One step of Newton's method along the gradient, at most half a lattice step long."""
    small = 0.05 * step
    value = level(points)
    gradient = np.stack([level(points + small * np.eye(3)[k]) - value for k in range(3)],
                        axis=1) / small
    shift = -value[:, None] * gradient / np.maximum((gradient**2).sum(axis=1), 0.25)[:, None]
    size = np.linalg.norm(shift, axis=1, keepdims=True)
    return points + shift * np.minimum(1, 0.5 * step / np.maximum(size, 1e-300))
