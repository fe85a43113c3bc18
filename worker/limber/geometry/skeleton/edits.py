"""Edits of a skeleton by its user: a small list that is applied again after each reconstruction.

Nodes are named by their place, not by their number: a new reconstruction numbers them anew.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from limber.errors import InputError
from limber.geometry.skeleton.skeleton import MEASURED, Skeleton

Place = tuple[float, float, float]
_FAR = 8.0  # radii from an axis, from which a place is none on it


class _Edit(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    at: Place


class MoveNode(_Edit):
    """Put the node nearest to ``at`` at ``to``."""

    do: Literal["move"] = "move"
    to: Place


class DeleteBranch(_Edit):
    """Cut off the branch nearest to ``at``, from there outwards."""

    do: Literal["delete"] = "delete"


class Bridge(_Edit):
    """Hang the branch that starts nearest to ``at`` on the node nearest to ``to`` instead."""

    do: Literal["bridge"] = "bridge"
    to: Place


class SetRoot(_Edit):
    """Make the node nearest to ``at`` the root."""

    do: Literal["root"] = "root"


class SetRadius(_Edit):
    """Set the radius [m] of the node nearest to ``at``, known to 2 %."""

    do: Literal["radius"] = "radius"
    radius: float = Field(gt=0)


Edit = Annotated[MoveNode | DeleteBranch | Bridge | SetRoot | SetRadius, Field(discriminator="do")]
EDITS = TypeAdapter(list[Edit])
"""Reads and writes edits as JSON."""


def edited(skeleton: Skeleton, edits: Iterable[Edit]) -> Skeleton:
    """Apply edits, in their order.

    Args:
        skeleton: In the frame of the edits' places [m].
        edits: What to change.

    Raises:
        InputError: a place is on no axis, or an edit would leave no tree.
    """
    doing = {"move": _moved, "delete": _deleted, "bridge": _bridged, "root": _rooted,
             "radius": _with_radius}
    for number, edit in enumerate(edits, start=1):
        try:
            skeleton = doing[edit.do](skeleton, edit)
        except InputError as error:
            raise InputError(f"Edit {number} ({edit.do}): {error.seen}", error.why, error.fix,
                             ) from error
    return skeleton


def _nearest(skeleton: Skeleton, at: Place) -> int:
    distance = np.linalg.norm(skeleton.nodes - np.array(at), axis=1)
    node = int(np.argmin(distance))
    if distance[node] > _FAR * skeleton.radius[node]:
        raise InputError(
            f"{at} is {1000 * distance[node]:.0f} mm from the nearest node.",
            "It is on no branch.", "Give a place on an axis, in the skeleton file's coordinates.")
    return node


def _moved(skeleton: Skeleton, edit: MoveNode) -> Skeleton:
    nodes = skeleton.nodes.copy()
    nodes[_nearest(skeleton, edit.at)] = edit.to
    return skeleton.moved(nodes)


def _deleted(skeleton: Skeleton, edit: DeleteBranch) -> Skeleton:
    keep = np.ones(skeleton.node_count, bool)
    keep[_nearest(skeleton, edit.at)] = False
    for node in range(1, skeleton.node_count):
        keep[node] &= keep[skeleton.parent[node]]
    if keep.sum() < 2:
        raise InputError("Nothing would be left.", "The root cannot be deleted.",
                         "Name a place farther out.")
    return skeleton.subset(keep)


def _bridged(skeleton: Skeleton, edit: Bridge) -> Skeleton:
    node, onto = _nearest(skeleton, edit.at), _nearest(skeleton, edit.to)
    run = skeleton.runs()[int(skeleton.branch[node])]
    start = int(run[1]) if skeleton.branch[node] else -1
    way = onto
    while way >= 0 and way != start:
        way = int(skeleton.parent[way])
    if start < 0 or way == start:
        raise InputError("The branch carries what it should hang on.", "That makes a circle.",
                         "Name the branch that is carried, and what carries it.")
    parent = skeleton.parent.copy()
    parent[start] = onto
    return _remade(skeleton, parent)


def _rooted(skeleton: Skeleton, edit: SetRoot) -> Skeleton:
    node, before = _nearest(skeleton, edit.at), -1
    parent = skeleton.parent.copy()
    while node >= 0:
        parent[node], before, node = before, node, int(parent[node])
    return _remade(skeleton, parent)


def _with_radius(skeleton: Skeleton, edit: SetRadius) -> Skeleton:
    node = _nearest(skeleton, edit.at)
    radius, sigma, state = (values.copy() for values in (
        skeleton.radius, skeleton.radius_sigma, skeleton.radius_state))
    radius[node], sigma[node], state[node] = edit.radius, 0.02 * edit.radius, MEASURED
    return replace(skeleton, radius=radius, radius_sigma=sigma, radius_state=state)


def _remade(skeleton: Skeleton, parent: np.ndarray) -> Skeleton:
    return Skeleton.from_edges(
        skeleton.nodes, parent, skeleton.radius, radius_sigma=skeleton.radius_sigma,
        radius_state=skeleton.radius_state, probability=skeleton.probability)
