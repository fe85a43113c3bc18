"""L-systems by published rules: monopodial (Honda 1971) and sympodial trees (Aono, Kunii 1984).

As in "The Algorithmic Beauty of Plants", figures 2.6 and 2.7: straight internodes, each forks.
"""

from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.plant import Growth, Plant

_STEP = 0.008  # [m] between the nodes of an internode
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
        count = max(round(length / _STEP), 2)
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
