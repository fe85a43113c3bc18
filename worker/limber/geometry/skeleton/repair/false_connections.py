"""Ends connected sideways across a scan's holes, cut apart before pieces are joined.

Where the foot of a twig is missing together with a stretch of its carrier, the remains of both
begin side by side, and their points may be near enough to be connected. The axis then goes up one,
across, and down the other: a turn that wood does not make. After a cut there, each end continues in
its own direction. If too little is left of the twig for a direction, it is attached to its
carrier's end like a hook, by a long step aside.
"""

import numpy as np

_ARM = 6.0  # radii on each side over which the direction is measured
_LEAVE = 1.0  # radii next to the turn that are skipped
_LEAST_NODES = 3  # fewest nodes of a side
_TURN = np.deg2rad(110.0)
_HOOK, _ASIDE, _STEP = 4.0, np.deg2rad(55.0), 1.5  # hook's radii; its turn; step's radii


def untied(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """Return the edges of a forest without those that connect two ends, shape [e, 2].

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs, shape [e, 2].
        thickness: First radii [m], shape [n].
    """
    near: list[list[int]] = [[] for _ in nodes]
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    turning = []
    for k, (a, b) in enumerate(edges.tolist()):
        if _is_hook(nodes, near, thickness, a, b) or _is_hook(nodes, near, thickness, b, a):
            turning.append((np.inf, k))
        if len(near[a]) != 2 or len(near[b]) != 2:
            continue
        thick = max(thickness[a], thickness[b])
        arms = [_arm(nodes, near, one, other, thick) for one, other in ((a, b), (b, a))]
        if any(arm is None for arm in arms):
            continue
        cosine = float(arms[0] @ arms[1])
        if cosine > -np.cos(_TURN):
            turning.append((float(np.linalg.norm(nodes[a] - nodes[b])) / thick, k))
    # Of the edges around one turn, the longest is removed: nothing was scanned beside it.
    keep, cut = np.ones(len(edges), bool), []
    for _, k in sorted(turning, reverse=True):
        middle, thick = nodes[edges[k]].mean(axis=0), float(thickness[edges[k]].max())
        if all(np.linalg.norm(middle - other) > _ARM * thick for other in cut):
            keep[k] = False
            cut.append(middle)
    return edges[keep]


def _is_hook(nodes: np.ndarray, near: list[list[int]], thickness: np.ndarray, end: int, first: int,
             ) -> bool:
    """Whether the chain that ends at ``end`` continues, by a long step aside, to a short tail."""
    step, thick = nodes[first] - nodes[end], float(thickness[end])
    size = float(np.linalg.norm(step))
    if len(near[end]) != 2 or size < _STEP * thick:
        return False
    before, node, length = end, first, 0.0
    while len(near[node]) == 2 and length < _HOOK * thick:
        ahead = near[node][0] if near[node][1] == before else near[node][1]
        length += float(np.linalg.norm(nodes[ahead] - nodes[node]))
        before, node = node, ahead
    arm = _arm(nodes, near, end, first, thick)
    return (len(near[node]) == 1 and length < _HOOK * thick and arm is not None
            and float(step @ -arm) < np.cos(_ASIDE) * size)


def _arm(nodes: np.ndarray, near: list[list[int]], start: int, before: int, thick: float,
         ) -> np.ndarray | None:
    """Direction of a chain away from an edge, a unit vector; None if it is too short."""
    chain, length = [], 0.0
    node = start
    while length < (_ARM + _LEAVE) * thick:
        if length >= _LEAVE * thick:
            chain.append(node)
        ahead = [other for other in near[node] if other != before]
        if len(ahead) != 1:
            break
        length += float(np.linalg.norm(nodes[ahead[0]] - nodes[node]))
        before, node = node, ahead[0]
    if len(chain) < _LEAST_NODES or length < 0.6 * _ARM * thick:
        return None
    vector = nodes[chain[-1]] - nodes[chain[0]]
    size = float(np.linalg.norm(vector))
    return vector / size if size > 0 else None
