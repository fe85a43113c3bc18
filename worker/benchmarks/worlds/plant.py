"""A plant of a world: axes with radii, and its skin of triangles, which sensors see."""

from dataclasses import dataclass, field

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton

_SIDES = 16
# A polygon's area is that of the circle through its corners times this.
_POLYGON = _SIDES / (2 * np.pi) * np.sin(2 * np.pi / _SIDES)


@dataclass(frozen=True)
class Plant:
    """Axes of one plant, node by node; a parent comes before its children.

    Attributes:
        nodes: Positions [m], shape [n, 3].
        parent: Index of each node's parent, -1 for the root, shape [n].
        radius: Radius of the circle of the section's area [m], shape [n].
        oval: Long over short diameter of the section, shape [n]; 1 where it is round.
        knob: Swelling of the skin over the radius, as at buds, shape [n]; 1 where there is none.
    """

    nodes: np.ndarray
    parent: np.ndarray
    radius: np.ndarray
    oval: np.ndarray = field(default=None)
    knob: np.ndarray = field(default=None)

    def __post_init__(self) -> None:
        for name in ("oval", "knob"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.ones(len(self.nodes)))

    @property
    def skeleton(self) -> Skeleton:
        return Skeleton.from_edges(self.nodes, self.parent, self.radius)

    def chains(self) -> list[np.ndarray]:
        """Nodes of each unforked run, from its carrier's node outwards; thick children go on."""
        child: list[list[int]] = [[] for _ in self.nodes]
        for node, parent in enumerate(self.parent):
            if parent >= 0:
                child[parent].append(node)
        begins = [(-1, int(np.flatnonzero(self.parent < 0)[0]))]
        found = []
        while begins:
            carrier, node = begins.pop()
            own = [node] if carrier < 0 else [carrier, node]
            while child[own[-1]]:
                after = sorted(child[own[-1]], key=lambda each: -self.radius[each])
                begins += [(own[-1], each) for each in after[1:]]
                own.append(after[0])
            found.append(np.array(own))
        return [own for own in found if len(own) > 1]

    def branch(self, limb: float = 1 / 3) -> "Plant":
        """The longest axis with its side limbs, as cut from a tree for a robot's cell.

        Limbs bear no twigs, and are cut at ``limb`` of what the axis has left there.
        """
        arc = np.zeros(len(self.nodes))
        for node in range(1, len(arc)):
            above = self.parent[node]
            arc[node] = arc[above] + np.linalg.norm(self.nodes[node] - self.nodes[above])
        path = [int(arc.argmax())]
        while self.parent[path[-1]] >= 0:
            path.append(int(self.parent[path[-1]]))
        kept, end, limit = set(path), float(arc.max()), arc.copy()
        goes_on = {(int(own[k]), int(own[k + 1])) for own in self.chains()
                   for k in range(1, len(own) - 1)}
        for node in range(1, len(arc)):
            above = int(self.parent[node])
            if node in kept or above not in kept:
                continue
            begins = above in path
            limit[node] = arc[above] + limb * (end - arc[above]) if begins else limit[above]
            if arc[node] <= limit[node] and (begins or (above, node) in goes_on):
                kept.add(node)
        chosen = np.array(sorted(kept))
        place = np.full(len(arc) + 1, -1)
        place[chosen] = np.arange(len(chosen))
        return Plant(self.nodes[chosen], place[self.parent[chosen]], self.radius[chosen],
                     self.oval[chosen], self.knob[chosen])

    def volume(self) -> float:
        """Volume [m^3] of the tapered runs, less what lies inside their carriers."""
        total = 0.0
        for own in self.chains():
            radius = self._run_radius(own)
            steps = np.linalg.norm(np.diff(self.nodes[own], axis=0), axis=1)
            share = np.ones(len(steps))
            if self.parent[own[0]] >= 0:
                inside = float(self.radius[own[0]])
                begins = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
                share = 1 - np.clip((inside - begins) / np.maximum(steps, 1e-12), 0, 1)
            near, far = radius[:-1], radius[1:]
            total += float((share * steps * (near**2 + near * far + far**2)).sum() * np.pi / 3)
        return total

    def skin(self) -> np.ndarray:
        """Triangles of the surface [m], shape [t, 3, 3]."""
        return np.concatenate([self._tube(own) for own in self.chains()])

    def _run_radius(self, own: np.ndarray) -> np.ndarray:
        """A side run keeps its own radius down to its carrier's axis."""
        radius = self.radius[own].copy()
        if self.parent[own[1]] == own[0] and self.parent[own[0]] >= 0:
            radius[0] = radius[1]
        return radius

    def _tube(self, own: np.ndarray) -> np.ndarray:
        places, radius = self.nodes[own], self._run_radius(own) * self.knob[own]
        way = np.gradient(places, axis=0)
        way /= np.linalg.norm(way, axis=1)[:, None]
        side = np.cross(way[0], np.eye(3)[np.argmin(np.abs(way[0]))])
        angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
        rings = []
        for place, along, thick, oval in zip(places, way, radius, self.oval[own], strict=True):
            side = side - (side @ along) * along
            side /= np.linalg.norm(side)
            long = thick / np.sqrt(_POLYGON) * np.sqrt(oval)
            rings.append(place + long * np.cos(angle)[:, None] * side
                         + long / oval * np.sin(angle)[:, None] * np.cross(along, side))
        end = np.broadcast_to(places[-1] + way[-1] * radius[-1], (_SIDES, 3))
        return sheet_triangles(np.array([*rings, end]), closed=True)


def sheet_triangles(grid: np.ndarray, closed: bool = False) -> np.ndarray:
    """Two triangles for each cell of a grid of positions [m], shape [rows, columns, 3].

    Args:
        grid: Positions.
        closed: The last column is next to the first.
    """
    grid = np.concatenate([grid, grid[:, :1]], axis=1) if closed else grid
    low, high = grid[:-1], grid[1:]
    first = np.stack([low[:, :-1], low[:, 1:], high[:, 1:]], axis=2)
    second = np.stack([low[:, :-1], high[:, 1:], high[:, :-1]], axis=2)
    return np.concatenate([first, second]).reshape(-1, 3, 3)


class Growth:
    """Nodes of a plant as they grow."""

    def __init__(self, base: np.ndarray, radius: float = 0.0):
        self.nodes, self.parent, self.radius = [np.asarray(base, float)], [-1], [radius]

    def add(self, place: np.ndarray, parent: int, radius: float = 0.0) -> int:
        """Add one node; returns its index."""
        self.nodes.append(np.asarray(place, float))
        self.parent.append(parent)
        self.radius.append(radius)
        return len(self.nodes) - 1

    def line(self, parent: int, places: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Add a line of nodes; returns their indices."""
        added = []
        for place, thick in zip(places, radius, strict=True):
            parent = self.add(place, parent, float(thick))
            added.append(parent)
        return np.array(added, int)

    def plant(self, **more: np.ndarray) -> Plant:
        return Plant(np.array(self.nodes), np.array(self.parent), np.array(self.radius), **more)


def pipe_radii(parent: np.ndarray, tip: float, power: float) -> np.ndarray:
    """Radii [m] of the pipe model: r^power of a node is the sum over its children.

    Args:
        parent: A parent comes before its children, shape [n].
        tip: Radius of tips [m].
        power: 2 is da Vinci's rule, 3 Murray's law.
    """
    total = np.zeros(len(parent))
    for node in range(len(parent) - 1, -1, -1):
        total[node] = total[node] or tip**power
        if parent[node] >= 0:
            total[parent[node]] += total[node]
    return total**(1 / power)
