"""How likely a scan's points are, given a tree: the score by which two trees are compared.

A point lies on the skin of a round axis, anywhere along the tree and around it, displaced by noise
across; or it is background, anywhere in the scan. Its density across an axis of radius r with noise
s is Rice's: (2 pi s^2)^-1 exp(-(d^2 + r^2) / 2 s^2) I0(d r / s^2) at the distance d. So a skin
needs points around its section and none inside, and a cylinder that is too thick, or goes through
several twigs, is not flattered. On the tree's skin, or along its axes, points are evenly spread:
more axes must show more points. The noise differs from point to point by Student's distribution. A
sensor at one place sees points evenly spread across its sight: on a skin by the cosine of the angle
to it. Twigs cost what their numbers do, and bends what they do by the prior of wood.
"""

from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from limber.core.numerics.rigid import any_normal
from limber.geometry.skeleton.likelihood_kernels import densities
from limber.geometry.skeleton.radii.fit_kernels import Match, match_cylinders
from limber.geometry.skeleton.radii.wood import Bends
from limber.geometry.skeleton.skeleton import Skeleton

_DIRECTIONS = [way / np.linalg.norm(way) for way in np.argwhere(np.ones((3, 3, 3))) - 1.0
               if way.any()]  # to the faces, edges and corners of a cube
_TURN, _HALVINGS = 0.35, 3  # first step of the search for the sensor [rad; 1 / size]; smaller ones
_NOISES = np.geomspace(2e-4, 0.03, 24)  # fractions of the scan's diagonal
_FREEDOM = 4.0  # of Student's distribution of the noise
_BACKGROUND, _ROUNDS = 0.05, 4  # first share of the background; rounds that find it
_MARGIN = 0.02  # [m] around the scan where background may be
_OPEN = 0.2  # sine of the angle between axis and sight under which an axis has no seen half
# A twig's fork, direction (2), length, radius and bend: each costs half the logarithm of the points
# (Schwarz 1978, Bayes' information criterion).
_TWIG_NUMBERS = 6.0


@dataclass(frozen=True)
class Scatter:
    """How points scatter about a tree: the ``scale`` of the noise [m], the share of each of
    :attr:`PointLikelihood.noises`, and that of the background."""

    scale: float
    shares: np.ndarray
    background: float


@dataclass(frozen=True)
class PointLikelihood:
    """The likelihood of points [m, 3] [m] given trees.

    Attributes:
        noises: Standard deviations across the axes that occur [m], shape [k].
        volume: Where background may be [m^3].
        sight: Unit vectors from points to the sensor, shape [m, 3]; None: seen from all around.
        power: Of the radius, by which axes show points: 1 by their skin's area, 0 by their length.
        twig_numbers: What a twig costs, in halves of the logarithm of the number of points.
    """

    points: np.ndarray
    noises: np.ndarray
    volume: float
    sight: np.ndarray | None = None
    power: float = 1.0
    twig_numbers: float = _TWIG_NUMBERS

    @classmethod
    def of(cls, points: np.ndarray) -> "PointLikelihood":
        """That of points [m], shape [m, 3]."""
        size = np.ptp(points, axis=0)
        return cls(points, _NOISES * float(np.linalg.norm(size)), float(np.prod(size + _MARGIN)))

    def seen_from(self, direction: np.ndarray, near: float = 0.0) -> "PointLikelihood":
        """The same for a sensor in a ``direction`` [3] from the middle of the points, by their size
        over ``near`` away."""
        size = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        way = direction - near / size * (self.points - self.points.mean(axis=0))
        return replace(self, sight=way / np.linalg.norm(way, axis=1)[:, None])

    def match(self, skeleton: Skeleton, near: np.ndarray | None = None,
              some: np.ndarray | slice = slice(None)) -> Match:
        """The cylinder of each or ``some`` of the points, of those of the upper nodes ``near``."""
        return match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                               self.points[some], near)

    def axes(self, skeleton: Skeleton, match: Match) -> np.ndarray:
        """Unit vector along the axis of each point's cylinder, shape [m, 3]."""
        axis = skeleton.nodes[match.segment] - skeleton.nodes[skeleton.parent[match.segment]]
        return axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]

    def facing(self, axes: np.ndarray, ways: np.ndarray, some: np.ndarray | slice = slice(None),
               ) -> np.ndarray:
        """Cosine of the angle around the ``axes`` between the sensor and ``ways`` across them at
        ``some`` of the points [m, 3], shape [m]; 0 where it looks along them; NaN: all around."""
        if self.sight is None:
            return np.full(len(ways), np.nan)
        sight = self.sight[some]
        sight = sight - np.einsum("mj,mj->m", axes, sight)[:, None] * axes
        size = np.linalg.norm(sight, axis=1)
        return np.where(size > _OPEN, np.einsum("mj,mj->m", ways, sight)
                        / np.maximum(size, _OPEN), 0.0)

    def densities(self, skeleton: Skeleton, match: Match, some: np.ndarray | slice = slice(None),
                  ) -> np.ndarray:
        """Density across the axes at ``some`` of the points, times a power of their radii, for
        each noise, shape [m, k]."""
        return densities(np.maximum(match.residual + match.thick, 0.0), match.thick,
                         self.facing(self.axes(skeleton, match), match.normal, some), self.noises,
                         self.power)

    def scattered(self, skeleton: Skeleton, density: np.ndarray) -> Scatter:
        """The likeliest scatter for densities [m, k] across the axes of a tree."""
        found = []
        along, elsewhere = density / self.skin(skeleton).sum(), 1 / self.volume
        for scale in self.noises:
            ratio = (scale / self.noises)**2
            shares = ratio**(_FREEDOM / 2) * np.exp(-0.5 * _FREEDOM * ratio)
            shares /= shares.sum()
            wood, background = along @ shares, _BACKGROUND
            for _ in range(_ROUNDS):
                off = background * elsewhere
                background = float(np.mean(off / ((1 - background) * wood + off)))
            log = float(np.log((1 - background) * wood + background * elsewhere).sum())
            found.append((log, Scatter(float(scale), (1 - background) * shares, background)))
        return max(found, key=lambda one: one[0])[1]

    def skin(self, skeleton: Skeleton) -> np.ndarray:
        """Each node's cylinder's share of the points: with power 1 its area [m^2], shape [n]."""
        radius, order, parent = skeleton.radius, skeleton.order, skeleton.parent
        return skeleton.steps * np.where(order > order[parent], radius,
                                         (radius + radius[parent]) / 2)**self.power

    def log(self, wood: np.ndarray, scatter: Scatter, skin: float, runs: int) -> float:
        """Logarithm of the likelihood of a tree with a ``skin`` [m^2] and so many ``runs``, given
        the density of the points on it [1/m], shape [m], less the cost of its twigs."""
        return float(np.log(wood / skin + scatter.background / self.volume).sum()
                     ) - self.twig_cost * runs

    @property
    def twig_cost(self) -> float:
        """By how much a twig must raise the logarithm of the likelihood."""
        return self.twig_numbers / 2 * float(np.log(len(self.points)))

    def score(self, skeleton: Skeleton, match: Match | None = None) -> float:
        """The logarithm of the likelihood of the points given a tree, less the cost of its twigs
        and bends, with the likeliest scatter. Only differences between trees of one scan mean
        something."""
        density = self.densities(skeleton, match or self.match(skeleton))
        scatter = self.scattered(skeleton, density)
        bends = float(Bends.of(skeleton).costs(skeleton.nodes).sum())
        return self.log(density @ scatter.shares, scatter, float(self.skin(skeleton).sum()),
                        skeleton.branch_count) - bends

    def where_seen(self, skeleton: Skeleton) -> "PointLikelihood":
        """The same for a sensor where a tree scores most, or itself, seen from all around."""
        def scored(direction: np.ndarray, near: float = 0.0) -> tuple[float, np.ndarray, float]:
            direction = direction / np.linalg.norm(direction)
            return self.seen_from(direction, near).score(skeleton, match), direction, near

        match = self.match(skeleton)
        score, direction, near = max(map(scored, _DIRECTIONS), key=itemgetter(0))
        if score <= self.score(skeleton, match) + self.twig_cost:  # it has three numbers too
            return self
        step, halvings = _TURN, 0
        while halvings < _HALVINGS:
            beside = any_normal(direction)
            above = np.cross(direction, beside)
            best = max([scored(direction + turn * step, near)
                        for turn in (beside, -beside, above, -above)]
                       + [scored(direction, max(near + closer, 0.0)) for closer in (step, -step)],
                       key=itemgetter(0))
            if best[0] > score:
                score, direction, near = best
            else:
                step, halvings = step / 2, halvings + 1
        return self.seen_from(direction, near)
