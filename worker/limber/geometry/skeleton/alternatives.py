"""The most likely graphs of a skeleton: its branches, attachments and root, and what else may be.

Each open question is a decision between two: a branch exists or not, a bridged piece is attached
here or at its rival, a dropped twig is missing or not, the root is here or at the other end.
Decisions are independent, except that a branch can only exist where its carrier does. So the best
combinations follow exactly, from the outermost branches inwards.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import InputError
from limber.core.json_values import validated
from limber.geometry.settings import OPEN
from limber.geometry.skeleton.confidence import (
    DoubtfulKind,
    DoubtfulPart,
    probability_given_carrier,
)
from limber.geometry.skeleton.edits import (
    FAR,
    AddBranch,
    DeleteBranch,
    Edit,
    SetRoot,
    SplitBranch,
    edited,
)
from limber.geometry.skeleton.skeleton import Skeleton

_DETOUR = 1.5  # longest path over a bridge that is still its own, in its lengths
_Combination = tuple[float, tuple[Edit, ...]]
"""Logarithm of its probability, and its edits."""


@dataclass(frozen=True)
class SearchDoubts:
    """What the search for a skeleton left open, in the skeleton's frame [m]: fields of
    :class:`~limber.geometry.skeleton.search_result.SkeletonResult`."""

    bridges: Sequence[dict[str, Any]] = ()
    unlikely: Sequence[dict[str, Any]] = ()
    root_ends: Sequence[dict[str, Any]] = ()
    length_spread: float | None = None

    @classmethod
    def of(cls, result: dict[str, Any]) -> "SearchDoubts":
        """The same from a stage's result; empty for a skeleton that was not searched."""
        return cls(result.get("bridges") or (), result.get("unlikely_twigs") or (),
                   result.get("root_ends") or (), result.get("length_spread"))


@dataclass(frozen=True)
class Attachment:
    """A bridged piece, its first node at the bridge's outer end. It is there with ``probability``,
    or else at ``to`` [3] [m], where the axes would be ``longer`` [m]."""

    node: int
    to: np.ndarray
    probability: float
    longer: float


@dataclass(frozen=True)
class Alternative:
    """A graph that is the true one with ``probability``, the ``length`` [m] of all its axes, and
    the edits that make it of the skeleton in use: none for that skeleton itself."""

    probability: float
    length: float
    edits: tuple[Edit, ...]


def attachments(skeleton: Skeleton, bridges: Iterable[dict[str, Any]]) -> list[Attachment]:
    """Return the bridged pieces with a rival place that are still attached by their bridge. A user
    who confirms such a branch, or attaches it elsewhere, has settled the question."""
    tree, along, found = cKDTree(skeleton.nodes), skeleton.arc_length, []
    for bridge in bridges:
        if bridge.get("rival_to") is None:
            continue
        places = np.array([bridge["rival_from"], bridge["from"], bridge["to"],
                           bridge["rival_to"]], float)
        away, node = tree.query(places)
        outer = int(node[0])
        inner = int(node[1] if np.allclose(places[0], places[2]) else node[2])
        path = float(along[outer] - along[inner])
        if (away > FAR * skeleton.radius[node]).any() or skeleton.probability[outer] >= 1.0 or (
                path > _DETOUR * bridge["length"] + FAR * skeleton.radius[inner]
                or inner not in _ancestors(skeleton, outer)
                or outer in _ancestors(skeleton, int(node[3]))):
            continue
        other = float(np.linalg.norm(places[3] - places[0]))
        found.append(Attachment(outer, places[3], float(bridge["probability"]),
                                other - float(bridge["length"])))
    return found


def alternatives(skeleton: Skeleton, doubts: SearchDoubts, count: int = 5) -> list[Alternative]:
    """Return the ``count`` most likely graphs: first the one in use, then the others by their
    probability. ``doubts`` is what its search left open, in the same frame."""
    decisions, root = _decisions(skeleton, doubts), _root_edit(skeleton, doubts)
    existing = probability_given_carrier(skeleton)
    ends = [end["probability"] for end in doubts.root_ends[:2]] if root else [1.0, 0.0]
    rooted, elsewhere = _logs(ends).tolist()
    used = float(_logs([*existing, *(chance for _, chance, _ in decisions)]).sum()) + rooted
    found = [Alternative(float(np.exp(used)), skeleton.length, ())]
    ranked = _ranked(skeleton, existing, decisions, count + 1)
    if root:
        # Last: the other edits refer to the directions of this root.
        ranked = _product(ranked, [(rooted, ()), (elsewhere, (root,))], count + 1)
    for log, edits in ranked:
        if edits and len(found) < count:
            length = _length_after(skeleton, edits)
            if length is not None:
                found.append(Alternative(float(np.exp(log)), length, edits))
    return found


def _length_after(skeleton: Skeleton, edits: tuple[Edit, ...]) -> float | None:
    """Length of all axes [m] after edits; None where they exclude each other."""
    try:
        return edited(skeleton, edits).length
    except InputError:
        return None


def _decisions(skeleton: Skeleton, doubts: SearchDoubts) -> list[tuple[int, float, Edit]]:
    """Decisions besides the existence of runs: their run, the probability of what is, the edit."""
    found: list[tuple[int, float, Edit]] = [
        (int(skeleton.branch[one.node]), one.probability,
         SplitBranch(at=_place(skeleton.nodes[one.node]), to=_place(one.to)))
        for one in attachments(skeleton, doubts.bridges)]
    twigs = [twig for twig in doubts.unlikely
             if twig.get("from") is not None and 0 < twig["probability"] < 1]
    if not twigs:
        return found
    tree = cKDTree(skeleton.nodes)
    away, fork = tree.query(np.array([twig["from"] for twig in twigs], float))
    beyond, near = tree.query(np.array([twig["at"] for twig in twigs], float))
    # A twig whose carrier was dropped too cannot be added; one that was added before is inside.
    able = (away <= FAR * skeleton.radius[fork]) & (beyond > skeleton.radius[near])
    for number in np.flatnonzero(able):
        twig = twigs[number]
        found.append((int(skeleton.branch[fork[number]]), 1 - twig["probability"], AddBranch(
            at=_place(twig["from"]), to=_place(twig["at"]), radius=twig["radius"])))
    return found


def _root_edit(skeleton: Skeleton, doubts: SearchDoubts) -> SetRoot | None:
    """What makes the other likely end the root; None where there is none."""
    if len(doubts.root_ends) < 2:
        return None
    away, node = cKDTree(skeleton.nodes).query(np.array(doubts.root_ends[1]["at"], float))
    if node == 0 or away > FAR * skeleton.radius[node]:
        return None
    return SetRoot(at=_place(skeleton.nodes[node]))


def _ranked(skeleton: Skeleton, existing: np.ndarray, decisions: list[tuple[int, float, Edit]],
            count: int) -> list[_Combination]:
    """The ``count`` most likely combinations of edits."""
    runs = skeleton.runs()
    below: list[list[_Combination]] = [[(0.0, ())] for _ in runs]
    for run, chance, edit in decisions:
        below[run] = _product(below[run], _either(chance, edit), count)
    # A run carried by another one has a higher number.
    for run in range(len(runs) - 1, 0, -1):
        gone = DeleteBranch(at=_place(skeleton.nodes[runs[run][1]]))
        (there, _), absent = _either(float(existing[run]), gone)
        options = [*((there + log, edits) for log, edits in below[run]), absent]
        carrier = int(skeleton.branch[runs[run][0]])
        below[carrier] = _product(below[carrier], options, count)
    return below[0]


def _product(one: list[_Combination], other: list[_Combination], count: int,
             ) -> list[_Combination]:
    """The ``count`` most likely pairs of independent combinations."""
    pairs = [(log + further, edits + more) for log, edits in one for further, more in other
             if np.isfinite(log + further)]
    return sorted(pairs, key=lambda pair: -pair[0])[:count]


def _either(chance: float, edit: Edit) -> list[_Combination]:
    """What is, and what an edit makes of it."""
    there, absent = _logs([chance, 1 - chance]).tolist()
    return [(there, ()), (absent, (edit,))]


def _logs(chances: Sequence[float]) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.log(np.asarray(chances, float))


def _ancestors(skeleton: Skeleton, node: int) -> set[int]:
    above = set()
    while node >= 0:
        above.add(node)
        node = int(skeleton.parent[node])
    return above


def _place(position: Any) -> tuple[float, float, float]:
    x, y, z = np.asarray(position, float).tolist()
    return x, y, z


def open_questions(skeleton: Skeleton, doubts: SearchDoubts) -> list[DoubtfulPart]:
    """Return attachments and the root, where they are uncertain, for the list of such parts."""
    found = []
    for one in attachments(skeleton, doubts.bridges):
        if one.probability < OPEN:
            found.append(_part(skeleton, DoubtfulKind.attachment, one.node, one.probability))
    ends = doubts.root_ends
    if len(ends) > 1 and ends[0]["probability"] < OPEN and _root_edit(skeleton, doubts):
        found.append(_part(skeleton, DoubtfulKind.root, 0, ends[0]["probability"]))
    return found


def _part(skeleton: Skeleton, kind: DoubtfulKind, node: int, probability: float) -> DoubtfulPart:
    return DoubtfulPart(kind, int(skeleton.branch[node]), skeleton.nodes[node], 0.0,
                        float(skeleton.radius[node]), probability)


def entries(graphs: Sequence[Alternative], in_file: Callable[[Edit], Edit]) -> list[dict[str, Any]]:
    """Return graphs for JSON; ``in_file`` moves their edits to the coordinates of a scan's file."""
    return [{"probability": graph.probability, "length_m": graph.length,
             "edits": [in_file(edit).model_dump(mode="json", exclude_none=True)
                       for edit in graph.edits]} for graph in graphs]


def from_entries(known: Sequence[dict[str, Any]]) -> tuple[Alternative, ...]:
    """Return the graphs of a stage's result, their edits in the coordinates of the scan's file."""
    return tuple(Alternative(one["probability"], one["length_m"],
                             tuple(validated(list[Edit], one["edits"]))) for one in known)
