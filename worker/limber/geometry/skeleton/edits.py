"""Edits of a skeleton by its user: a small list that is applied again after each reconstruction.

Edits refer to nodes by position, because each reconstruction numbers the nodes again. A
file of edits is a JSON list. Positions and radii have the coordinates and the unit of the scan's
file, as `limber skeleton` lists them::

    [{"do": "delete", "at": [0.12, 0.03, 0.85]},
     {"do": "radius", "at": [0.00, 0.01, 0.30], "radius": 0.011}]
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.spatial import cKDTree

from limber.core.alignment import Alignment
from limber.core.errors import Command, InputError, Text
from limber.core.files.reading import read_json
from limber.core.json_values import refusal_of, validated
from limber.geometry.skeleton.skeleton import BRIDGED, MEASURED, Skeleton

Place = tuple[float, float, float]
FAR = 4.0  # radii from an axis beyond which a point is not on it
_KNOWN = 0.02  # standard deviation of a radius that a user gave, over the radius
_SAME = 1e-3  # radii within which two positions are the same; files round


class _Edit(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    at: Place

    def aligned(self, alignment: Alignment) -> Self:
        """Return the edit with positions and radius in the branch's frame [m]."""
        return self._placed(alignment.apply, alignment.scale)

    def in_file(self, alignment: Alignment) -> Self:
        """Return an edit of the branch's frame [m] in the coordinates of the scan's file."""
        return self._placed(alignment.undo, 1.0 / alignment.scale)

    def _placed(self, taken: Callable[[np.ndarray], np.ndarray], factor: float) -> Self:
        positions = {name: tuple(taken(np.array(getattr(self, name))).tolist())
                     for name in ("at", "to") if getattr(self, name, None) is not None}
        sizes = {"radius": self.radius * factor} if hasattr(self, "radius") else {}
        return self.model_copy(update=positions | sizes)


class MoveNode(_Edit):
    """Move the node nearest to ``at`` to ``to``."""

    do: Literal["move"] = "move"
    to: Place


class DeleteBranch(_Edit):
    """Delete the branch nearest to ``at``, from there outwards."""

    do: Literal["delete"] = "delete"


class MergeBranch(_Edit):
    """Merge a branch up to ``at`` with the branch at ``to``, from which it then continues. What it
    carried before ``at`` is attached to the nearest nodes of that other branch."""

    do: Literal["merge"] = "merge"
    to: Place


class Bridge(_Edit):
    """Attach the whole branch at ``at`` to the node nearest to ``to`` instead."""

    do: Literal["bridge"] = "bridge"
    to: Place


class SplitBranch(_Edit):
    """Cut a branch at ``at`` and attach the outer part to the node nearest to ``to``."""

    do: Literal["split"] = "split"
    to: Place


class SetRoot(_Edit):
    """Make the node nearest to ``at`` the root."""

    do: Literal["root"] = "root"


class SetRadius(_Edit):
    """Set the radius at ``at``, or along the axes from ``at`` to ``to``. Its uncertainty is 2 %."""

    do: Literal["radius"] = "radius"
    radius: float = Field(gt=0)
    to: Place | None = None


class ConfirmBranch(_Edit):
    """Confirm that the branch at ``at`` exists, and the branches that carry it."""

    do: Literal["confirm"] = "confirm"


class AddBranch(_Edit):
    """Add a straight branch from the node nearest to ``at`` to its tip ``to``."""

    do: Literal["add"] = "add"
    to: Place
    radius: float = Field(gt=0)


Edit = Annotated[AddBranch | MoveNode | DeleteBranch | MergeBranch | Bridge | SplitBranch | SetRoot
                 | SetRadius | ConfirmBranch, Field(discriminator="do")]


def read_edits(path: Path) -> list[Edit]:
    """Read a file of edits; InputError if it is not JSON, or names the edit that is invalid."""
    try:
        return validated(list[Edit], read_json(path, "a JSON file of edits"))
    except ValidationError as error:
        first = error.errors()[0]
        key = first["loc"]
        where = f"edit {key[0] + 1}: " if key and isinstance(key[0], int) else ""
        field = ".".join(str(part) for part in key[1:])
        raise InputError(
            f"{path}: {where}{field + ': ' if field else ''}{refusal_of(first)}.",
            "Edits are a JSON list of objects such as {\"do\": \"delete\", \"at\": [x, y, z]}.",
            "Correct the file. Give positions in the coordinates of the scan file.") from error


def edits_text(edits: Sequence[Edit]) -> str:
    """Return edits as the text of their file: one per line, the same text for equal edits."""
    lines = [edit.model_dump_json(exclude_none=True) for edit in edits]
    return "[" + ",\n ".join(lines) + "]\n"


def edited(skeleton: Skeleton, edits: Iterable[Edit], misfits: list[str] | None = None,
           ) -> Skeleton:
    """Apply edits with positions [m] in the skeleton's frame. InputError if a position is on no
    axis or the result is no tree; ``misfits`` receives its message instead, and the edit is
    skipped."""
    doing: dict[str, Callable[[Skeleton, Any], Skeleton]] = {
        "add": _added, "move": _moved, "delete": _deleted, "merge": _merged,
        "bridge": _bridged, "split": _split, "root": _rooted, "radius": _with_radius,
        "confirm": _confirmed}
    for number, edit in enumerate(edits, start=1):
        try:
            skeleton = doing[edit.do](skeleton, edit)
        except InputError as error:
            refusal = InputError(Text(f"Edit {number} ({edit.do}): ", error.seen), error.why,
                                 error.fix)
            if misfits is None:
                raise refusal from error
            misfits.append(str(refusal))
    return skeleton


@dataclass(frozen=True)
class EditEffect:
    """What an edit did: the node [3] [m] that it took, that node's distance [m] from the requested
    position, and the change of all branches' length [m], negative where it removed something."""

    do: str
    node: np.ndarray
    distance: float
    length_change: float


def effects_of(skeleton: Skeleton, edits: Iterable[Edit], misfits: list[str],
               ) -> list[EditEffect]:
    """Return what each edit that fits does; applied in order, arguments as for :func:`edited`."""
    found = []
    for edit in edits:
        skipped = len(misfits)
        after = edited(skeleton, [edit], misfits)
        if len(misfits) > skipped:
            continue
        node = skeleton.nodes[_nearest(skeleton, edit.at)]
        found.append(EditEffect(edit.do, node, float(np.linalg.norm(node - np.array(edit.at))),
                                after.length - skeleton.length))
        skeleton = after
    return found


def _nearest(skeleton: Skeleton, at: Place) -> int:
    distance = np.linalg.norm(skeleton.nodes - np.array(at), axis=1)
    node = int(np.argmin(distance))
    if distance[node] > FAR * skeleton.radius[node]:
        raise InputError(f"({', '.join(f'{value:.3f}' for value in at)}) m in the branch's frame "
                         f"is {1000 * distance[node]:.0f} mm from the nearest node.",
                         "The position does not belong to any branch.",
                         "Give a position on an axis in the coordinates of the scan file, as ",
                         Command("skeleton"), " lists them.")
    return node


def _moved(skeleton: Skeleton, edit: MoveNode) -> Skeleton:
    nodes = skeleton.nodes.copy()
    nodes[_nearest(skeleton, edit.at)] = edit.to
    return _remade(skeleton, nodes=nodes)


def _deleted(skeleton: Skeleton, edit: DeleteBranch) -> Skeleton:
    keep = np.ones(skeleton.node_count, bool)
    keep[_nearest(skeleton, edit.at)] = False
    for node in range(1, skeleton.node_count):
        keep[node] &= keep[skeleton.parent[node]]
    if keep.sum() < 2:
        raise InputError("This edit would delete the whole skeleton.",
                         "The root cannot be deleted.", "Give a position farther from the root.")
    return skeleton.subset(keep)


def _merged(skeleton: Skeleton, edit: MergeBranch) -> Skeleton:
    node, onto = _nearest(skeleton, edit.at), _nearest(skeleton, edit.to)
    run, other = int(skeleton.branch[node]), int(skeleton.branch[onto])
    if run == 0 or run == other:
        raise InputError("The main branch cannot be merged into another branch, and no branch can "
                         "be merged into itself.",
                         "Only a branch that grows from another one can become part of another "
                         "branch.", "Give the superfluous branch as `at`.")
    members = skeleton.runs()[run][1:]
    gone = np.zeros(skeleton.node_count, bool)
    gone[members[members <= node]] = True
    if gone[_path_to_root(skeleton, onto)].any():
        raise _circle()
    parent = skeleton.parent.copy()
    hosts = np.flatnonzero(skeleton.branch == other)
    for child in np.flatnonzero(~gone & gone[skeleton.parent] & (skeleton.parent >= 0)):
        near = np.linalg.norm(skeleton.nodes[hosts] - skeleton.nodes[child], axis=1)
        parent[child] = onto if skeleton.parent[child] == node else hosts[np.argmin(near)]
    return skeleton.subset(~gone, parent)


def _bridged(skeleton: Skeleton, edit: Bridge) -> Skeleton:
    node, onto = _nearest(skeleton, edit.at), _nearest(skeleton, edit.to)
    if skeleton.branch[node] == 0:
        raise _circle()
    return _hung(skeleton, int(skeleton.runs()[int(skeleton.branch[node])][1]), onto)


def _split(skeleton: Skeleton, edit: SplitBranch) -> Skeleton:
    node, onto = _nearest(skeleton, edit.at), _nearest(skeleton, edit.to)
    above, children = _path_to_root(skeleton, onto), skeleton.child_counts()
    if node in above:
        raise _circle()
    keep = np.ones(skeleton.node_count, bool)
    before = int(skeleton.parent[node])
    # A path through a gap that now leads nowhere goes too.
    while skeleton.radius_state[before] == BRIDGED and children[before] == 1 and (
            before not in above):
        keep[before] = False
        before = int(skeleton.parent[before])
    parent = skeleton.parent.copy()
    parent[node] = onto
    moved = skeleton.subset(keep, parent)
    return _hung(moved, *(int(np.argmin(np.linalg.norm(moved.nodes - place, axis=1)))
                          for place in skeleton.nodes[[node, onto]]))


def _hung(skeleton: Skeleton, node: int, onto: int) -> Skeleton:
    """Attach a node, with all that it carries, to another one; nodes are added along a long gap."""
    if node in _path_to_root(skeleton, onto):
        raise _circle()
    thick = float(skeleton.radius[node])
    vector = skeleton.nodes[node] - skeleton.nodes[onto]
    count = int(np.linalg.norm(vector) / (2 * max(thick, 1e-12)))
    share = (np.arange(count) + 1)[:, None] / (count + 1)
    parent = skeleton.parent.copy()
    parent[node] = skeleton.node_count + count - 1 if count else onto
    return _with_chain(skeleton, parent, onto, skeleton.nodes[onto] + share * vector, thick, {
        "radius_sigma": skeleton.radius_sigma[node], "radius_state": BRIDGED,
        "probability": skeleton.probability[node]})


def _added(skeleton: Skeleton, edit: AddBranch) -> Skeleton:
    onto = _nearest(skeleton, edit.at)
    vector = np.array(edit.to) - skeleton.nodes[onto]
    count = max(int(np.linalg.norm(vector) / (2 * edit.radius)), 2)
    share = (np.arange(count) + 1)[:, None] / count
    return _with_chain(
        skeleton, skeleton.parent, onto, skeleton.nodes[onto] + share * vector, edit.radius, {
            "radius_sigma": _KNOWN * edit.radius, "radius_state": MEASURED, "probability": 1.0})


def _with_chain(skeleton: Skeleton, parent: np.ndarray, onto: int, places: np.ndarray,
                radius: float, filled: dict[str, float]) -> Skeleton:
    """Add a chain of nodes at ``places`` [m], shape [k, 3], to node ``onto``."""
    count, data = len(places), _data(skeleton)
    before = np.concatenate([[onto], skeleton.node_count + np.arange(count - 1)])[:count]
    return Skeleton.from_edges(
        np.vstack([skeleton.nodes, places]), np.concatenate([parent, before.astype(np.int64)]),
        np.concatenate([skeleton.radius, np.full(count, radius)]),
        **{name: np.concatenate([values, np.full(count, filled[name], values.dtype)])
           for name, values in data.items()})


def _rooted(skeleton: Skeleton, edit: SetRoot) -> Skeleton:
    node, before = _nearest(skeleton, edit.at), -1
    parent = skeleton.parent.copy()
    while node >= 0:
        parent[node], before, node = before, node, int(parent[node])
    return _remade(skeleton, parent=parent)


def _with_radius(skeleton: Skeleton, edit: SetRadius) -> Skeleton:
    node = _nearest(skeleton, edit.at)
    chosen = [node]
    if edit.to is not None:
        one = _path_to_root(skeleton, node)
        other = _path_to_root(skeleton, _nearest(skeleton, edit.to))
        # The path between two nodes: the nodes on only one of their paths to the root, and the
        # fork.
        fork = next(step for step in one if step in other)
        chosen = [*one[:one.index(fork)], *other[:other.index(fork)], fork]
    radius, sigma, state = (values.copy() for values in (
        skeleton.radius, skeleton.radius_sigma, skeleton.radius_state))
    radius[chosen], sigma[chosen], state[chosen] = edit.radius, _KNOWN * edit.radius, MEASURED
    return replace(skeleton, radius=radius, radius_sigma=sigma, radius_state=state)


def _confirmed(skeleton: Skeleton, edit: ConfirmBranch) -> Skeleton:
    node = _nearest(skeleton, edit.at)
    probability = skeleton.probability.copy()
    probability[skeleton.branch == skeleton.branch[node]] = 1.0
    probability[_path_to_root(skeleton, node)] = 1.0
    return replace(skeleton, probability=probability)


def _path_to_root(skeleton: Skeleton, node: int) -> list[int]:
    """Nodes from one to the root, both included."""
    nodes = []
    while node >= 0:
        nodes.append(node)
        node = int(skeleton.parent[node])
    return nodes


def _circle() -> InputError:
    return InputError("The branch carries the one to which it would be attached.",
                      "The skeleton would contain a cycle.", "Give the carried branch as `at`. Or "
                      "split, `at` the first node of what hangs wrongly, `to` where it belongs.")


def _data(skeleton: Skeleton) -> dict[str, np.ndarray]:
    return {name: getattr(skeleton, name)
            for name in ("radius_sigma", "radius_state", "probability")}


def _remade(skeleton: Skeleton, *, nodes: np.ndarray | None = None,
            parent: np.ndarray | None = None) -> Skeleton:
    """Return the skeleton with other positions or parents; runs and orders are computed again."""
    return Skeleton.from_edges(
        skeleton.nodes if nodes is None else nodes,
        skeleton.parent if parent is None else parent, skeleton.radius, **_data(skeleton))


def differing(skeleton: Skeleton, found: Skeleton) -> np.ndarray:
    """Mask [n] of an edited skeleton's nodes that differ from the found one's. A node is unchanged
    if one with its position, radius, parent and probability was found."""
    distance, same = cKDTree(found.nodes).query(skeleton.nodes)

    def carrier(tree: Skeleton, nodes: np.ndarray) -> np.ndarray:
        return tree.nodes[np.where(tree.parent[nodes] < 0, nodes, tree.parent[nodes])]
    near = _SAME * skeleton.radius
    rehung = np.linalg.norm(carrier(skeleton, np.arange(skeleton.node_count))
                            - carrier(found, same), axis=1)
    return ((distance > near) | (np.abs(skeleton.radius - found.radius[same]) > near)
            | (rehung > near) | (np.abs(skeleton.probability - found.probability[same]) > 1e-2))
