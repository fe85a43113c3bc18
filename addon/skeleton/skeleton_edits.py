"""The user's changes of a skeleton's nodes, as the worker's list of edits. No bpy.

The worker applies edits one after the other (``limber skeleton --help``). This module lists the
changes, in an order in which each is valid: nodes first move to their present positions.
"""

import enum
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np


class Mark(enum.IntEnum):
    """Kind of edit of a node; the worker's help describes what each edit needs."""

    NONE = 0
    BRIDGE = 1
    MERGE = 2
    SPLIT = 3
    CONFIRM = 4

    @property
    def has_target(self) -> bool:
        return self in (Mark.BRIDGE, Mark.MERGE, Mark.SPLIT)


class SkeletonEditError(ValueError):
    """The worker has no edit for this change of the nodes; states what to do."""


@dataclass(frozen=True)
class Skeleton:
    """A skeleton from the worker: positions [n, 3], radii [n] m, parents [n], -1 at a root.

    A parent comes before its children.
    """

    nodes: np.ndarray
    radius: np.ndarray
    parent: np.ndarray

    @property
    def root(self) -> int:
        return int(np.flatnonzero(self.parent < 0)[0])

    def outwards(self, node: int, stops: set[int] = frozenset()) -> set[int]:
        """Return a node and all its descendants, except those of ``stops`` and beyond."""
        found = {node}
        for child in range(node + 1, len(self.parent)):
            if int(self.parent[child]) in found and child not in stops:
                found.add(child)
        return found


@dataclass(frozen=True)
class Nodes:
    """The nodes as the user left them, in any order.

    Attributes:
        number: Number of each node in the skeleton, [k]; shows which are gone and which are new.
        places: Positions, [k, 3] m. radius: [k] m. is_root: [k].
        marks: :class:`Mark` of each, [k]; ``targets`` the number of the node that it names, and
            ``turns`` the order of the marks.
        edges: Indices into this list, [e, 2].
    """

    number: np.ndarray
    places: np.ndarray
    radius: np.ndarray
    is_root: np.ndarray
    marks: np.ndarray
    targets: np.ndarray
    turns: np.ndarray
    edges: np.ndarray = field(default_factory=lambda: np.empty((0, 2), int))


def edits_of(before: Skeleton, now: Nodes) -> list[dict[str, Any]]:
    """Return the edits, in the branch's frame [m], that turn ``before`` into ``now``.

    Raises:
        SkeletonEditError: nodes were added, edges drawn or cut, or nodes are detached.
    """
    _require_known(before, now)
    place = {int(number): now.places[k] for k, number in enumerate(now.number)}
    marked = {int(number): Mark(int(mark)) for number, mark in zip(
        now.number, now.marks, strict=True) if mark}
    gone = [node for node in range(len(before.nodes)) if node not in place]
    _require_carried(before, place, marked, gone)
    return [*_moves(before, now), *_radii(before, now), *_marks(now, place),
            *_deletions(before, gone), *_root(before, now)]


def _require_known(before: Skeleton, now: Nodes) -> None:
    number = now.number
    if len(np.unique(number)) != len(number) or (
            len(number) and (number.min() < 0 or number.max() >= len(before.nodes))):
        raise SkeletonEditError(
            "Nodes were added. The worker can only move, remove and reattach nodes that it found. "
            "Undo the additions or discard the edits.")
    given = number[now.edges]
    drawn = {tuple(sorted(edge)) for edge in given.tolist()}
    there = set(number.tolist())
    known = {tuple(sorted((node, int(before.parent[node])))) for node in there
             if int(before.parent[node]) in there}
    if drawn - known:
        raise SkeletonEditError(
            "An edge was drawn between nodes that do not carry each other. Undo it, select both "
            "nodes and press Bridge.")
    if known - drawn:
        raise SkeletonEditError("An edge was cut. Undo it, and press Split, or Delete Branch.")


def _require_carried(before: Skeleton, place: dict[int, Any], marked: dict[int, Mark],
                     gone: list[int]) -> None:
    """A child of a removed node must be removed too, or be attached elsewhere by then."""
    if before.root in gone:
        raise SkeletonEditError("The root was deleted. Undo that, and set another root first.")
    rehung = {node for node, mark in marked.items() if mark.has_target}
    left = set().union(*(before.outwards(node, rehung) for node in gone)) & place.keys()
    if left:
        raise SkeletonEditError(
            f"{len(left)} nodes are detached because the nodes that carried them were deleted. "
            "Delete them too, or undo the deletion and attach them to another branch first "
            "(Split, Bridge).")


def _point(values: np.ndarray) -> list[float]:
    return [float(value) for value in values]


def _moves(before: Skeleton, now: Nodes) -> Iterator[dict[str, Any]]:
    was = before.nodes[now.number]
    # As Blender stores them, in single precision.
    for k in np.flatnonzero((was.astype(np.float32) != now.places).any(axis=1)):
        yield {"do": "move", "at": _point(was[k]), "to": _point(now.places[k])}


def _radii(before: Skeleton, now: Nodes) -> Iterator[dict[str, Any]]:
    for k in np.flatnonzero(before.radius[now.number].astype(np.float32) != now.radius):
        if not now.radius[k] > 0:
            raise SkeletonEditError("A radius is not positive. Give a positive one with Set "
                                    "Radius.")
        yield {"do": "radius", "at": _point(now.places[k]), "radius": float(now.radius[k])}


def _marks(now: Nodes, place: dict[int, np.ndarray]) -> Iterator[dict[str, Any]]:
    chosen = np.flatnonzero(now.marks)
    for k in chosen[np.argsort(now.turns[chosen], kind="stable")]:
        mark, target = Mark(int(now.marks[k])), int(now.targets[k])
        edit = {"do": mark.name.lower(), "at": _point(now.places[k])}
        if mark.has_target:
            if target not in place:
                raise SkeletonEditError(
                    f"The target node of a {mark.name.lower()} was deleted. Undo the deletion or "
                    "clear the mark.")
            edit["to"] = _point(place[target])
        yield edit


def _deletions(before: Skeleton, gone: list[int]) -> Iterator[dict[str, Any]]:
    for node in gone:
        # The first takes its children with it.
        if int(before.parent[node]) not in gone:
            yield {"do": "delete", "at": _point(before.nodes[node])}


def _root(before: Skeleton, now: Nodes) -> Iterator[dict[str, Any]]:
    chosen = [k for k in np.flatnonzero(now.is_root) if int(now.number[k]) != before.root]
    if len(chosen) > 1:
        raise SkeletonEditError("Several nodes are marked as the root. Keep only one.")
    for k in chosen:
        yield {"do": "root", "at": _point(now.places[k])}
