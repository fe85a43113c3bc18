"""The skeleton: a rooted tree of nodes with radii along the axes of a branch and its twigs."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.alignment import Alignment
from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError
from limber.core.json_values import stored_lengths
from limber.core.numerics.rigid import any_normal
from limber.geometry.skeleton.sweep import tangents

MEASURED, LIMITED, INTERPOLATED, UNRESOLVED, BRIDGED = 0, 1, 2, 3, 4
"""Values of ``radius_state``: fitted to points, limited to the cloud's scale, filled in, too
thin for the scan's points and noise, or in a gap."""
STATES = {"measured": MEASURED, "limited": LIMITED, "interpolated": INTERPOLATED,
          "unresolved": UNRESOLVED, "bridged": BRIDGED}
"""Names of these values."""
_GRID, _EVEN = 1e-5, 2.0**-20  # of the median radius: step of places; step of probabilities


@dataclass(frozen=True)
class Skeleton:
    """A rooted tree of nodes; a parent's index is smaller than its children's.

    Attributes:
        nodes: Positions [m], shape [n, 3]; node 0 is the root.
        parent: Index of each node's parent, -1 for the root, shape [n].
        radius: Radii [m], shape [n].
        radius_sigma: Standard deviation of each radius [m], shape [n]; 0 where unknown.
        branch: Index of the unforked run that each node belongs to, shape [n]; 0 is the main one.
        order: Branching order, 0 for the main run, shape [n].
        radius_state: ``MEASURED``, ``LIMITED``, ``INTERPOLATED``, ``UNRESOLVED`` or ``BRIDGED``,
            shape [n].
        probability: Probability that the node exists, shape [n]; 1 where it is certain.
    """

    nodes: np.ndarray
    parent: np.ndarray
    radius: np.ndarray
    radius_sigma: np.ndarray = field(default=cast(np.ndarray, None))
    branch: np.ndarray = field(default=cast(np.ndarray, None))
    order: np.ndarray = field(default=cast(np.ndarray, None))
    radius_state: np.ndarray = field(default=cast(np.ndarray, None))
    probability: np.ndarray = field(default=cast(np.ndarray, None))
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value in (("radius_sigma", 0.0), ("radius_state", np.int8(0)),
                            ("probability", 1.0)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(len(self.nodes), value))
        if self.branch is None or self.order is None:
            for name, run in zip(("branch", "order"), _runs(self.parent, self.steps), strict=True):
                object.__setattr__(self, name, run)

    @classmethod
    def from_edges(cls, nodes: np.ndarray, parent: np.ndarray, radius: np.ndarray,
                   **data: np.ndarray) -> "Skeleton":
        """Make a skeleton of nodes in any order; they are renumbered run by run, main run first.

        Args:
            nodes: Positions [m], shape [n, 3].
            parent: Parents, -1 for the one root, shape [n].
            radius: Radii [m], shape [n].
            data: Further arrays of the class, shape [n].

        Raises:
            InputError: no root, several roots, a cycle, a negative radius, or numbers that are
                not finite.
        """
        nodes, parent = np.asarray(nodes, float).reshape(-1, 3), np.asarray(parent, np.int64)
        radius = np.asarray(radius, float)
        _check_tree(nodes, parent, radius)
        order = _depth_first(nodes, parent)
        new_index = np.empty(len(nodes), np.int64)
        new_index[order] = np.arange(len(nodes))
        moved = np.where(parent[order] < 0, -1, new_index[parent[order]])
        return cls(nodes[order], moved, radius[order],
                   **{name: np.asarray(values)[order] for name, values in data.items()})

    @property
    def node_count(self) -> int:
        return len(self.nodes)

    @property
    def branch_count(self) -> int:
        return int(self.branch.max()) + 1

    @property
    def steps(self) -> np.ndarray:
        """Distance of each node from its parent [m], 0 for the root, shape [n]."""
        step = np.linalg.norm(self.nodes - self.nodes[self.parent], axis=1)
        step[self.parent < 0] = 0.0
        return step

    @property
    def length(self) -> float:
        """Total length of all axes [m]."""
        return float(self.steps.sum())

    @property
    def arc_length(self) -> np.ndarray:
        """Distance from the root along the tree [m], shape [n]."""
        step, total = self.steps, np.zeros(self.node_count)
        for node in range(1, self.node_count):
            total[node] = total[self.parent[node]] + step[node]
        return total

    def child_counts(self) -> np.ndarray:
        """Number of children of each node, shape [n]."""
        return np.bincount(self.parent[self.parent >= 0], minlength=self.node_count)

    def forks(self) -> np.ndarray:
        """Indices of the nodes with two children or more."""
        return np.flatnonzero(self.child_counts() > 1)

    def tips(self) -> np.ndarray:
        """Indices of the nodes without children."""
        return np.flatnonzero(self.child_counts() == 0)

    def main_path(self) -> np.ndarray:
        """Indices from the root to the tip that is farthest from it along the tree."""
        node, path = int(np.argmax(self.arc_length)), []
        while node >= 0:
            path.append(node)
            node = int(self.parent[node])
        return np.array(path[::-1])

    def runs(self) -> list[np.ndarray]:
        """Node indices of each unforked run, in branch order.

        A side run starts with the node that it forks off from, which belongs to its parent.
        """
        return [self._members(run) for run in range(self.branch_count)]

    def own_runs(self) -> list[np.ndarray]:
        """Node indices of each unforked run without the node that it forks off from."""
        return [np.flatnonzero(self.branch == branch) for branch in range(self.branch_count)]

    def curve(self, run: int) -> tuple[np.ndarray, np.ndarray]:
        """Nodes [m], shape [k, 3], and radii [m] of a run from its fork on; a twig has its own
        radius there, not its carrier's.
        """
        members = self._members(run)
        radius = self.radius[members]
        if run > 0:
            radius[0] = radius[1]
        return self.nodes[members], radius

    def _members(self, run: int) -> np.ndarray:
        own = np.flatnonzero(self.branch == run)
        return own if self.parent[own[0]] < 0 else np.concatenate([self.parent[own[:1]], own])

    def point_at(self, fraction: float) -> np.ndarray:
        """Position [m], shape [3], at a fraction of the main path's length."""
        path = self.main_path()
        along = self.arc_length[path]
        distance = float(fraction) * along[-1]
        return np.array([np.interp(distance, along, self.nodes[path, k]) for k in range(3)])

    def radius_at(self, fraction: float) -> float:
        """Radius [m] at a fraction of the main path's length."""
        path = self.main_path()
        along = self.arc_length[path]
        return float(np.interp(float(fraction) * along[-1], along, self.radius[path]))

    def moved(self, nodes: np.ndarray) -> "Skeleton":
        """Return the skeleton with other node positions [m], shape [n, 3]."""
        return replace(self, nodes=np.asarray(nodes, float))

    def on_grid(self) -> "Skeleton":
        """Return the skeleton on a grid far finer than anything is known: how a processor or a
        library rounds does not outlast a step that ends with it."""
        step = 2.0**np.floor(np.log2(_GRID * float(np.median(self.radius))))
        nodes, radius, sigma = (np.round(values / step) * step for values in (
            self.nodes, self.radius, self.radius_sigma))
        return replace(self, nodes=nodes, radius=np.maximum(radius, step), radius_sigma=sigma,
                       probability=np.round(self.probability / _EVEN) * _EVEN)

    def axes(self) -> np.ndarray:
        """Unit vector along the axis at each node, shape [n, 3]."""
        axis = np.empty_like(self.nodes)
        for members, own in zip(self.runs(), self.own_runs(), strict=True):
            axis[own] = tangents(self.nodes[members])[-len(own):]
        return axis

    def subset(self, keep: np.ndarray, parent: np.ndarray | None = None) -> "Skeleton":
        """Return the skeleton of the nodes where ``keep`` [n] is true; a parent must be kept.

        Args:
            keep: Shape [n].
            parent: Other parents of all nodes, shape [n]; None: the present ones.
        """
        new_index = np.cumsum(keep) - 1
        parent = (self.parent if parent is None else parent)[keep]
        parent = np.where(parent < 0, -1, new_index[parent])
        return Skeleton.from_edges(
            self.nodes[keep], parent, self.radius[keep], radius_sigma=self.radius_sigma[keep],
            radius_state=self.radius_state[keep], probability=self.probability[keep])

    def in_file(self, alignment: Alignment) -> "Skeleton":
        """Return it in the coordinates and the unit of the file that the branch was made from."""
        return replace(self, nodes=alignment.undo(self.nodes),
                       radius=self.radius / alignment.scale,
                       radius_sigma=self.radius_sigma / alignment.scale)

    def write_swc(self, path: Path, *, unit: str = "m") -> None:
        """Write an SWC file in the unit that its header states. All nodes have one type, 3: viewers
        of neurons refuse one that changes between forks, and take 1 for a cell's body."""
        lines = ["# Limber skeleton, SWC", f"# unit: {unit}", "# id type x y z radius parent"]
        nodes = stored_lengths(self.nodes * UNIT_METRES[unit]) / UNIT_METRES[unit]
        parents = np.where(self.parent < 0, -1, self.parent + 1)
        lines += [f"{i} 3 {x:.15g} {y:.15g} {z:.15g} {r:.9g} {up}" for i, ((x, y, z), r, up) in
                  enumerate(zip(nodes, self.radius, parents, strict=True), 1)]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _check_tree(nodes: np.ndarray, parent: np.ndarray, radius: np.ndarray) -> None:
    fix = "Correct the skeleton file, or reconstruct from the cloud instead."
    if len(nodes) < 2:
        raise InputError(f"The skeleton has {len(nodes)} nodes.",
                         "A branch needs at least two nodes.", fix)
    if not (np.isfinite(nodes).all() and np.isfinite(radius).all()):
        bad = np.flatnonzero(~(np.isfinite(nodes).all(axis=1) & np.isfinite(radius)))
        raise InputError(f"Skeleton node {bad[0] + 1} has a number that is not finite.",
                         "Positions and radii must be numbers.", fix)
    if (radius < 0).any():
        worst = int(np.argmin(radius))
        raise InputError(f"Skeleton node {worst + 1} has radius {radius[worst]:g}.",
                         "A radius cannot be negative.", fix)
    roots = np.flatnonzero(parent < 0)
    if len(roots) != 1:
        names = ", ".join(str(r + 1) for r in roots[:5]) or "none"
        raise InputError(f"The skeleton has {len(roots)} roots (nodes {names}).",
                         "A branch has exactly one root.", fix)
    if (parent >= len(nodes)).any():
        lost = int(np.flatnonzero(parent >= len(nodes))[0])
        raise InputError(f"Skeleton node {lost + 1} has a parent that does not exist in the file.",
                         "Each node except the root must have another node as its parent.", fix)
    depth = _depths(parent)
    if (depth < 0).any():
        lost = int(np.flatnonzero(depth < 0)[0])
        raise InputError(f"Skeleton node {lost + 1} is on a cycle, or is attached to one.",
                         "The skeleton of a branch must be a tree.", fix)


def _depths(parent: np.ndarray) -> np.ndarray:
    """Number of edges to the root; -1 for nodes that never reach it."""
    ancestor, depth = parent.copy(), (parent >= 0).astype(np.int64)
    # Each round doubles the distance to the ancestor.
    for _ in range(len(parent).bit_length() + 1):
        alive = np.flatnonzero(ancestor >= 0)
        if len(alive) == 0:
            return depth
        depth[alive] += depth[ancestor[alive]]
        ancestor[alive] = ancestor[ancestor[alive]]
    depth[ancestor >= 0] = -1
    return depth


def _children(parent: np.ndarray) -> list[list[int]]:
    children: list[list[int]] = [[] for _ in parent]
    for node, up in enumerate(parent):
        if up >= 0:
            children[up].append(node)
    return children


def _reach(parent: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Distance from each node to the farthest tip below it."""
    reach = np.zeros(len(parent))
    for node in np.argsort(-_depths(parent), kind="stable"):
        up = parent[node]
        if up >= 0:
            reach[up] = max(reach[up], reach[node] + step[node])
    return reach


def _depth_first(nodes: np.ndarray, parent: np.ndarray) -> np.ndarray:
    step = np.linalg.norm(nodes - nodes[parent], axis=1)
    reach = _reach(parent, step) + step
    children = _children(parent)
    stack, order = [int(np.flatnonzero(parent < 0)[0])], []
    while stack:
        node = stack.pop()
        order.append(node)
        # The child that reaches farthest comes next, so that a run's nodes are consecutive.
        stack.extend(sorted(children[node], key=lambda child: reach[child]))
    return np.array(order)


def _runs(parent: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    reach = _reach(parent, step) + step
    children = _children(parent)
    branch, order = np.zeros(len(parent), np.int64), np.zeros(len(parent), np.int64)
    count = 0
    for node in range(len(parent)):
        below = children[node]
        if not below:
            continue
        main = max(below, key=lambda child: reach[child])
        branch[main], order[main] = branch[node], order[node]
        for child in below:
            if child != main:
                count += 1
                branch[child], order[child] = count, order[node] + 1
    return branch, order


# Control points: positions along a branch where Young's modulus is estimated.

FRACTIONS = (0.2, 0.4, 0.6, 0.8)
"""The paper's: 1/5 to 4/5 of the branch."""


def control_points(skeleton: Skeleton, fractions: tuple[float, ...] = FRACTIONS) -> np.ndarray:
    """Return positions [m], shape [K, 3], at fractions of the main path's length.

    The paper samples them "linearly across the length of the branch" (section Branch Parameters
    Estimation).
    """
    return np.array([skeleton.point_at(fraction) for fraction in fractions])


# Rotation of a branch to upright: its principal growth direction along z.


def upright_rotation(skeleton: Skeleton, up: np.ndarray, upright: bool) -> np.ndarray:
    """Return the rotation [3, 3] from the file's axes to the branch's frame: ``up`` [3] becomes z.
    If ``upright``, the shortest one follows that turns the main path's first principal axis, from
    root to tip, to z: the paper's principal growth direction."""
    first = shortest_turn(np.asarray(up, float), np.array([0.0, 0.0, 1.0]))
    if not upright:
        return first
    path = skeleton.nodes[skeleton.main_path()]
    offset = path - path.mean(axis=0)
    growth = np.linalg.svd(offset, full_matrices=False)[2][0]
    growth = growth if growth @ (path[-1] - path[0]) > 0 else -growth
    return shortest_turn(first @ growth, np.array([0.0, 0.0, 1.0])) @ first


def shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation by the smallest angle from direction ``start`` to ``end``, shape [3, 3]."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis, cosine = np.cross(start, end), float(start @ end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        return Rotation.from_rotvec(np.pi * any_normal(start)).as_matrix()
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()
