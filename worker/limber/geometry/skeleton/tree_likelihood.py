"""How likely a scan's points are, given a tree: the score by which two trees are compared.

A point lies on the skin of a round axis, anywhere along the tree and around it, displaced by noise
across; or it is background, anywhere in the scan. Its density across an axis of radius r with noise
s is Rice's: (2 pi s^2)^-1 exp(-(d^2 + r^2) / 2 s^2) I0(d r / s^2) at the distance d. So a skin
needs points around its section and none inside, and a cylinder that is too thick, or goes through
several twigs, is not flattered. Along the tree points are evenly spread: more axes must show more
points. The noise differs from point to point by Student's distribution. Where a scan saw only one
side, the part of the skin that faces it has nearly all points.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ive, ndtr

from limber.geometry.skeleton.radii.fit_kernels import Match, match_cylinders
from limber.geometry.skeleton.skeleton import Skeleton

DIRECTIONS = [way / np.linalg.norm(way) for way in np.argwhere(np.ones((3, 3, 3))) - 1.0
              if way.any()]
"""Directions to a sensor: to the faces, edges and corners of a cube."""
_NOISES = np.geomspace(2e-4, 0.03, 24)  # fractions of the scan's diagonal
_FREEDOM = 4.0  # of Student's distribution of the noise
_BACKGROUND, _ROUNDS = 0.05, 4  # first share of the background; rounds that find it
_MARGIN = 0.02  # [m] around the scan where background may be
HIDDEN = 0.1
"""Density of the hidden half, as a fraction of that all around."""
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
        side: Direction to the sensor, a unit vector [3]; None: seen from all around.
    """

    points: np.ndarray
    noises: np.ndarray
    volume: float
    side: np.ndarray | None = None

    @classmethod
    def of(cls, points: np.ndarray) -> "PointLikelihood":
        """That of points [m], shape [m, 3]."""
        size = np.ptp(points, axis=0)
        return cls(points, _NOISES * float(np.linalg.norm(size)), float(np.prod(size + _MARGIN)))

    def seen_from(self, side: np.ndarray | None) -> "PointLikelihood":
        """The same where a scan saw the skin from one side."""
        return replace(self, side=side)

    def match(self, skeleton: Skeleton) -> Match:
        """The cylinder of each point."""
        return match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                               self.points)

    def across(self, distance: np.ndarray, radius: np.ndarray, facing: np.ndarray | None = None,
               ) -> np.ndarray:
        """Density [1/m^2] at distances from axes [m] with radii [m] for each noise, [m, k];
        ``facing`` is the cosine of the angle to the sensor, [m]; None: from all around."""
        sharpness = distance[:, None] * radius[:, None] / self.noises**2
        off = (distance - radius)[:, None] / self.noises
        density = ive(0, sharpness) * np.exp(-0.5 * off**2) / (2 * np.pi * self.noises**2)
        if facing is None:
            return density
        # The fraction of a von Mises distribution in the seen half: exact to its first order where
        # it is flat, and where it is sharp.
        flat = np.sqrt(2 / np.pi)
        seen = ndtr(facing[:, None] * flat * sharpness / np.sqrt(1 + flat**2 * sharpness))
        return density * (HIDDEN + (1 - HIDDEN) * 2 * seen)

    @staticmethod
    def axes(skeleton: Skeleton, match: Match) -> np.ndarray:
        """Unit vector along the axis of each point's cylinder, shape [m, 3]."""
        axis = skeleton.nodes[match.segment] - skeleton.nodes[skeleton.parent[match.segment]]
        return axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]

    def facing(self, skeleton: Skeleton, match: Match, ways: np.ndarray) -> np.ndarray | None:
        """Cosine of the angle around the axis between the sensor and ``ways`` across the axis at
        each point [m, 3], shape [m]; 0 where the sensor looks along it; None: all around."""
        if self.side is None:
            return None
        axis = self.axes(skeleton, match)
        sight = self.side - (axis @ self.side)[:, None] * axis
        size = np.linalg.norm(sight, axis=1)
        return np.where(size > _OPEN, np.einsum("mj,mj->m", ways, sight)
                        / np.maximum(size, _OPEN), 0.0)

    def scattered(self, skeleton: Skeleton, match: Match, density: np.ndarray) -> Scatter:
        """The likeliest scatter for densities [m, k] across the axes of a tree."""
        found = []
        along, elsewhere = density / skeleton.length, 1 / self.volume
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

    def log(self, wood: np.ndarray, scatter: Scatter, length: float, runs: int) -> float:
        """Logarithm of the likelihood of a tree of ``length`` [m] and so many ``runs``, given the
        density of the points across its axes [1/m^2], shape [m], less the cost of its twigs."""
        return float(np.log(wood / length + scatter.background / self.volume).sum()
                     ) - _TWIG_NUMBERS / 2 * np.log(len(self.points)) * runs

    def score(self, skeleton: Skeleton) -> float:
        """The logarithm of the likelihood of the points given a tree, less the cost of its twigs,
        with the likeliest scatter. Only differences between trees of one scan mean something."""
        match = self.match(skeleton)
        density = self.across(np.maximum(match.residual + match.thick, 0.0), match.thick,
                              self.facing(skeleton, match, match.normal))
        scatter = self.scattered(skeleton, match, density)
        return self.log(density @ scatter.shares, scatter, skeleton.length, skeleton.branch_count)

    def best(self, skeleton: Skeleton) -> float:
        """The score from where the points most likely saw the tree."""
        return max(self.seen_from(side).score(skeleton) for side in (None, *DIRECTIONS))
