"""Plants of the worlds, by published rules: axes with radii, and a skin of triangles."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

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


# --- space colonisation (Runions, Lane, Prusinkiewicz 2007): axes compete for points in the crown

_GROWN = 0.012  # [m] that an axis grows in one turn
_REACH, _TAKEN = 0.25, 0.05  # [m]: influence and kill distance of attraction points
_TURNS = 160


def colonised(rng: np.random.Generator) -> Plant:
    """A small tree in an ellipsoid of attraction points, thick by the pipe model."""
    height = rng.uniform(0.6, 0.9)
    spread = rng.normal(size=(int(rng.integers(45, 90)), 3))
    spread *= (rng.uniform(size=len(spread))**(1 / 3) / np.linalg.norm(spread, axis=1))[:, None]
    wanted = spread * [0.4 * height, 0.3 * height, 0.5 * height] + [0, 0, 0.8 * height]
    growth = Growth(np.zeros(3))
    for _ in range(_TURNS):
        nodes = np.array(growth.nodes)
        distance, near = cKDTree(nodes).query(wanted)
        drawn = distance < max(_REACH, distance.min(initial=np.inf) * 1.01)
        pull = np.zeros_like(nodes)
        np.add.at(pull, near[drawn], (wanted[drawn] - nodes[near[drawn]]) / np.maximum(
            distance[drawn], 1e-9)[:, None])
        grown = 0
        for node in np.unique(near[drawn]):
            way = pull[node] + 0.02 * rng.normal(size=3)
            place = nodes[node] + _GROWN * way / np.linalg.norm(way)
            if cKDTree(np.array(growth.nodes)).query(place)[0] > 0.5 * _GROWN:
                growth.add(place, int(node))
                grown += 1
        wanted = wanted[cKDTree(np.array(growth.nodes)).query(wanted)[0] > _TAKEN]
        if not grown or not len(wanted):
            break
    tip, power = rng.uniform(0.0018, 0.0026), rng.uniform(2.1, 2.8)
    growth.radius = list(pipe_radii(np.array(growth.parent), tip, power))
    return growth.plant()


# --- L-systems: monopodial (Honda 1971) and sympodial trees (Aono, Kunii 1984), as in "The
# Algorithmic Beauty of Plants", figures 2.6 and 2.7: straight internodes, each forks

_APART = 0.008  # [m] between the nodes of an internode
_THINNEST = 0.0015  # [m] radius
_ROLL = np.radians(137.5)


@dataclass(frozen=True)
class _Turtle:
    """A place [m], its frame (heading, left, up), and the node there."""

    place: np.ndarray
    frame: np.ndarray
    node: int

    def turned(self, axis: int, angle: float) -> "_Turtle":
        """Turned about one of its own axes by an angle [rad]."""
        about = self.frame[axis]
        cross = np.array([[0, -about[2], about[1]], [about[2], 0, -about[0]],
                          [-about[1], about[0], 0]])
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        return _Turtle(self.place, self.frame @ turn.T, self.node)

    def level(self) -> "_Turtle":
        """Rolled until its left is horizontal, as `$` does."""
        left = np.cross([0.0, 0.0, 1.0], self.frame[0])
        if np.linalg.norm(left) < 1e-6:
            return self
        left /= np.linalg.norm(left)
        return _Turtle(self.place, np.array([self.frame[0], left, np.cross(self.frame[0], left)]),
                       self.node)

    def forward(self, growth: Growth, length: float, radius: float) -> "_Turtle":
        count = max(round(length / _APART), 2)
        places = self.place + np.linspace(0, length, count + 1)[1:, None] * self.frame[0]
        nodes = growth.line(self.node, places, np.full(count, radius))
        return _Turtle(places[-1], self.frame, int(nodes[-1]))


def monopodial(rng: np.random.Generator) -> Plant:
    """A leader with one lateral at each of its nodes; laterals fork from side to side."""
    growth, turtle = _begun(rng)
    leader, side, thin = rng.uniform(0.85, 0.92), rng.uniform(0.55, 0.7), rng.uniform(0.66, 0.74)
    down, aside = np.radians(rng.uniform(35, 60, 2))

    def lateral(turtle: _Turtle, length: float, radius: float, left: int, depth: int) -> None:
        turtle = turtle.forward(growth, length, radius)
        if depth == 0:
            return
        lateral(turtle.turned(2, left * aside).level(), length * side,
                max(radius * thin, _THINNEST), -left, max(depth - 2, 0))
        lateral(turtle, length * leader, max(radius * 0.88, _THINNEST), -left, depth - 1)

    length, radius = rng.uniform(0.13, 0.18), growth.radius[0]
    for _ in range(6):
        turtle = turtle.forward(growth, length, radius)
        lateral(turtle.turned(1, down), length * side, max(radius * thin, _THINNEST), 1, 1)
        turtle = turtle.turned(0, _ROLL)
        length, radius = length * leader, radius * 0.85
    turtle.forward(growth, length, radius)
    return growth.plant()


def sympodial(rng: np.random.Generator) -> Plant:
    """Each axis ends at its fork: two children, one nearly straight, one flat."""
    growth, turtle = _begun(rng)
    long, short = rng.uniform(0.85, 0.92), rng.uniform(0.65, 0.8)
    steep, flat = np.radians(rng.uniform(5, 20)), np.radians(rng.uniform(45, 68))

    def shoot(turtle: _Turtle, length: float, radius: float, depth: int) -> None:
        turtle = turtle.forward(growth, length, radius)
        if depth == 0:
            return
        first, second = turtle.turned(2, steep).level(), turtle.turned(2, -flat).level()
        if depth % 2:
            first, second = turtle.turned(1, steep), turtle.turned(0, np.pi).turned(1, flat)
        shoot(first, length * long, radius * 0.8, depth - 1)
        shoot(second, length * short, max(radius * 0.62, _THINNEST), depth - 1)

    shoot(turtle, rng.uniform(0.17, 0.23), growth.radius[0], 4)
    return growth.plant()


def _begun(rng: np.random.Generator) -> tuple[Growth, _Turtle]:
    growth = Growth(np.zeros(3), float(rng.uniform(0.008, 0.013)))
    lean = rng.uniform(0.0, 0.5)
    turtle = _Turtle(np.zeros(3), np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0]]), 0)
    return growth, turtle.turned(0, rng.uniform(0, 2 * np.pi)).turned(1, lean)


# --- other allometry: opposite and whorled twigs, bud knobs, oval sections, even forks

_STEP = 0.006  # [m] between nodes


def opposite(rng: np.random.Generator) -> Plant:
    """Two orders of twigs in pairs (or whorls) at flat angles; knobs, ovals, a blunt taper."""
    growth = Growth(np.zeros(3))
    whorl = int(rng.choice([2, 2, 3, 4]))
    length = rng.uniform(0.6, 1.0)
    main = _shoot(growth, 0, np.array([rng.normal(0, 0.3), rng.normal(0, 0.3), 1.0]), length, rng)
    knob = {0: 1.0}
    for order, share in enumerate(np.linspace(0.2, 0.85, int(rng.integers(3, 6)))):
        at = int(main[int(share * len(main))])
        knob[at] = rng.uniform(1.15, 1.4)
        for number in range(whorl):
            way = _aside(growth, at, 2 * np.pi * (number / whorl + 0.25 * (order % 2)),
                         np.radians(rng.uniform(60, 85)))
            twig = _shoot(growth, at, way, length * rng.uniform(0.12, 0.35) * (1.1 - share), rng)
            if len(twig) > 14 and rng.uniform() < 0.4:
                on = int(twig[len(twig) // 2])
                for sign in (-1, 1):
                    _shoot(growth, on, _aside(growth, on, sign * np.pi / 2, np.radians(70)),
                           rng.uniform(0.03, 0.06), rng)
    parent = np.array(growth.parent)
    radius = pipe_radii(parent, rng.uniform(0.0016, 0.0024), rng.uniform(1.9, 2.6))
    # Wood is also laid down between forks: the taper is steep first, then blunt.
    depth = _arc(np.array(growth.nodes), parent)
    growth.radius = list(radius * (1 + 0.6 * np.exp(-depth / 0.15) + 0.3 * (1 - depth / length)
                                   .clip(0)**2))
    oval = np.full(len(parent), rng.uniform(1.1, 1.35))
    swelling = np.array([knob.get(node, 1.0) for node in range(len(parent))])
    return growth.plant(oval=oval, knob=swelling)


def dichotomous(rng: np.random.Generator) -> Plant:
    """A random binary tree by Murray's law: both children of a fork are about alike."""
    growth = Growth(np.zeros(3))
    tips = [(0, np.array([0.1, 0.0, 1.0]), 0)]
    while tips:
        at, way, depth = tips.pop(0)
        shoot = _shoot(growth, at, way, rng.uniform(0.12, 0.24) * 0.85**depth, rng)
        if depth == 4 or (depth > 1 and rng.uniform() < 0.35):
            continue
        roll, spread = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(20, 40, 2))
        tips += [(int(shoot[-1]), _aside(growth, int(shoot[-1]), roll + np.pi * side, angle),
                  depth + 1) for side, angle in enumerate(spread)]
    parent = np.array(growth.parent)
    growth.radius = list(pipe_radii(parent, rng.uniform(0.002, 0.0032), rng.uniform(2.5, 3.0)))
    return growth.plant()


def weber_penn(rng: np.random.Generator) -> Plant:
    """Stems by Weber and Penn 1995: curved back, down angles by place, radii by a ratio power."""
    growth = Growth(np.zeros(3))
    length, ratio, power = rng.uniform(0.7, 1.1), rng.uniform(0.011, 0.016), rng.uniform(1.1, 1.4)
    radius: dict[int, float] = {0: length * ratio}

    def stem(at: int, way: np.ndarray, long: float, thick: float, level: int) -> None:
        own = _shoot(growth, at, way, long, rng, bend=rng.uniform(-0.6, 0.9))
        along = np.arange(1, len(own) + 1) / len(own)
        for node, share in zip(own, along, strict=True):
            radius[int(node)] = max(thick * (1 - 0.75 * share), 0.0014)
        if level == 2:
            return
        roll = rng.uniform(0, 2 * np.pi)
        for share in np.sort(rng.uniform(0.2, 0.9, int(rng.integers(3, 8) if not level else 2))):
            node = int(own[int(share * len(own))])
            child = long * (0.35 + 0.3 * (1 - share)) * rng.uniform(0.7, 1.1) * (1 - 0.3 * level)
            roll += np.radians(140 + 20 * rng.normal())
            if child > 0.03:
                stem(node, _aside(growth, node, roll, np.radians(60 - 25 * share)), child,
                     min(thick * (child / long)**power * 1.4, 0.8 * radius[node]), level + 1)

    stem(0, np.array([rng.normal(0, 0.3), rng.normal(0, 0.3), 1.0]), length, radius[0], 0)
    growth.radius = [radius[node] for node in range(len(growth.nodes))]
    return growth.plant()


# --- a drooping branch: zig-zag axes, limbs that alternate or are opposite, collars at forks


def drooping(rng: np.random.Generator) -> Plant:
    """One branch of a tree, bent down by its weight; no constant of the program was set on it."""
    growth, collar = Growth(np.zeros(3), rng.uniform(0.0045, 0.008)), rng.uniform(0.1, 0.35)
    paired, droop = rng.uniform() < 0.4, rng.uniform(0.3, 1.2)
    swollen: dict[int, float] = {}

    def axis(at: int, way: np.ndarray, long: float, thick: float, order: int) -> None:
        side = np.cross(way, [0.0, 0.0, 1.0] + 0.2 * rng.normal(size=3))
        side /= np.linalg.norm(side)
        done, sign, zigzag = 0.0, 1.0, np.radians(rng.uniform(5, 20))
        while done < long:
            step = min(rng.uniform(0.025, 0.07), long - done + 0.005)
            way = way / np.linalg.norm(way) - droop * step * np.array([0, 0, 1.0])
            heading = way + sign * np.tan(zigzag) * side
            count = max(round(step / 0.005), 1)
            places = growth.nodes[at] + step * np.linspace(0, 1, count + 1)[1:, None] * (
                heading / np.linalg.norm(heading))
            taper = thick * (1 - 0.65 * (done + step * np.linspace(0, 1, count + 1)[1:]) / long)
            at = int(growth.line(at, places, np.maximum(taper, 0.0013))[-1])
            done, sign = done + step, -sign
            left = long - done
            for turn in (1, -1) if paired else (1,):
                twig = left * rng.uniform(0.25, 0.6)
                if order < 2 and twig > 0.04 and rng.uniform() < (0.7, 0.25)[order]:
                    swollen[at] = 1 + collar
                    limb = way - turn * sign * rng.uniform(0.7, 1.6) * side
                    axis(at, limb, twig, growth.radius[at] * rng.uniform(0.45, 0.8), order + 1)

    axis(0, np.array([*rng.normal(size=2), rng.uniform(-0.3, 0.6)]), rng.uniform(0.4, 0.8),
         growth.radius[0], 0)
    return growth.plant(knob=np.array([swollen.get(k, 1.0) for k in range(len(growth.nodes))]))


def _shoot(growth: Growth, at: int, way: np.ndarray, length: float, rng: np.random.Generator,
           bend: float = 0.3) -> np.ndarray:
    """A wandering line of nodes from ``at`` [m]; it bends up (or down) by ``bend`` [rad]."""
    count = max(int(length / _STEP), 3)
    way, places, place = way / np.linalg.norm(way), [], growth.nodes[at]
    for _ in range(count):
        way = way + bend / count * np.array([0, 0, 1.0]) + 0.02 * rng.normal(size=3)
        way /= np.linalg.norm(way)
        place = place + length / count * way
        places.append(place)
    return growth.line(at, np.array(places), np.zeros(count))


def _aside(growth: Growth, at: int, roll: float, angle: float) -> np.ndarray:
    """A direction off the axis at a node by ``angle`` [rad], rolled about it by ``roll`` [rad]."""
    along = growth.nodes[at] - growth.nodes[growth.parent[at]]
    along = along / np.linalg.norm(along)
    side = np.cross(along, [0.31, 0.95, 0.05])
    side /= np.linalg.norm(side)
    across = np.cross(along, side)
    return np.cos(angle) * along + np.sin(angle) * (np.cos(roll) * side + np.sin(roll) * across)


def _arc(nodes: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """Distance of each node from the root along the axes [m], shape [n]."""
    far = np.zeros(len(nodes))
    for node in range(1, len(nodes)):
        far[node] = far[parent[node]] + np.linalg.norm(nodes[node] - nodes[parent[node]])
    return far
