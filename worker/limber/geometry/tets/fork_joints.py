"""Blocks of tetrahedra between a carrier's side and the first ring of a twig that leaves it."""

from dataclasses import dataclass

import numpy as np

from limber.geometry.skeleton.sweep import bending_factor, rings
from limber.geometry.tets.quality import FLAT, shapes
from limber.geometry.tets.run_axis import RunAxis


@dataclass(frozen=True)
class Patch:
    """Side faces of a carrier's slice that a twig may start from.

    Attributes:
        slice: Which slice.
        faces: Which of its sides.
        loop: Nodes around them, shape [corners].
        outward: Their mean normal, shape [3].
    """

    slice: int
    faces: list[int]
    loop: np.ndarray
    outward: np.ndarray


@dataclass(frozen=True)
class Joint:
    """A valid block between a patch and a twig's first ring.

    Attributes:
        start: Position of the ring along the twig [m].
        tangent: Normal of the ring, shape [3].
        turn: Direction of the ring's first corner, shape [3].
        tets: Nodes of the mesh, or -1 - k for node k of the twig, shape [t, 4].
        quality: Shape of its flattest tetrahedron.
    """

    start: float
    tangent: np.ndarray
    turn: np.ndarray
    tets: np.ndarray
    quality: float


def joints(axis: RunAxis, start: np.ndarray, lean: np.ndarray, patch: Patch, corner: np.ndarray,
           triangles: np.ndarray) -> list[Joint]:
    """The valid blocks between a patch and a twig's first ring.

    Args:
        axis: Axis of the twig.
        start: Candidate positions of the ring along it [m], shape [j].
        lean: How far the ring leans towards the patch, shape [j].
        patch: The patch that the twig grows out of.
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
    found = []
    for k in np.flatnonzero(quality >= FLAT):
        order = patch.loop[::-1] if backwards[k] else patch.loop
        numbers = np.concatenate([order, -1 - np.arange(sides + 1)])
        found.append(Joint(float(start[k]), tangent[k], turn[k],
                             numbers[block[k]], float(quality[k])))
    return found


def _matched(corner: np.ndarray, tangent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orientation of a patch's corners about each twig, and the first normal of each twig's ring.

    Ring corner k is then above patch corner k with the least twist.

    Args:
        corner: The patch's corners [m], shape [sides, 3].
        tangent: Directions of the twigs, shape [j, 3].

    Returns:
        Whether the corners must be reversed to run counter-clockwise, shape [j]; normals, shape [j,
        3].
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
    """Tetrahedra between a patch and each ring, and the worst shape among them.

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
