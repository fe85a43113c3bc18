"""Branches of other allometry: opposite and whorled twigs, bud knobs, oval sections, even forks."""

import numpy as np

from benchmarks.worlds.plant import Growth, Plant, pipe_radii

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
