"""How likely a scan's points are, given a tree: the score by which two trees are compared.

A point lies on the skin of a round axis, anywhere along the tree and around it, displaced by noise
across; or it is background, anywhere in the scan. Its density across an axis of radius r with noise
s is Rice's: (2 pi s^2)^-1 exp(-(d^2 + r^2) / 2 s^2) I0(d r / s^2) at the distance d. So a skin
needs points around its section and none inside, and a cylinder that is too thick, or goes through
several twigs, is not flattered. On the tree's skin, or along its axes, points are evenly spread:
more axes must show more points. The noise differs from point to point by Student's distribution. A
sensor at one place sees points evenly spread across its sight, from edge to edge of a branch, and
they err along it more than across. Twigs cost what their numbers do, and bends what they do by the
prior of wood.
"""

from dataclasses import dataclass, replace

import numpy as np

from limber.geometry.skeleton.likelihood_kernels import densities
from limber.geometry.skeleton.radii.fit_kernels import Match, match_cylinders
from limber.geometry.skeleton.radii.wood import Bends
from limber.geometry.skeleton.skeleton import Skeleton

_DIRECTIONS = [way / np.linalg.norm(way) for way in np.argwhere(np.ones((3, 3, 3))) - 1.0
               if way.any()]  # to the faces, edges and corners of a cube
_SHARP = 0.5  # noise across a sensor's sight over that along it, while its direction is sought
_TURNS = (0.3, 0.1)  # steps of the search for the sensor [rad; 1 / size], and factors of that ratio
_SHARPER = (0.5, 0.7, 1.4, 2.0)
_NOISES = np.geomspace(2e-4, 0.03, 24)  # fractions of the scan's diagonal
_FREEDOM = 4.0  # of Student's distribution of the noise
_BACKGROUND, _ROUNDS = 0.05, 4  # first share of the background; rounds that find it
_MARGIN = 0.02  # [m] around the scan where background may be
_OPEN = 0.2  # sine of the angle between axis and sight under which an axis has no side
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
        sharp: Noise across the sight over that along it.
        sensor: Direction [3] and nearness, as in :meth:`seen_from`; None: seen from all around.
        power: Of the radius, by which axes show points: 1 by their skin's area, 0 by their length.
        twig_numbers: What a twig costs, in halves of the logarithm of the number of points.
    """

    points: np.ndarray
    noises: np.ndarray
    volume: float
    sight: np.ndarray | None = None
    sharp: float = 1.0
    sensor: tuple[np.ndarray, float] | None = None
    power: float = 1.0
    twig_numbers: float = _TWIG_NUMBERS

    @classmethod
    def of(cls, points: np.ndarray) -> "PointLikelihood":
        """That of points [m], shape [m, 3]."""
        size = np.ptp(points, axis=0)
        return cls(points, _NOISES * float(np.linalg.norm(size)), float(np.prod(size + _MARGIN)))

    def seen_from(self, direction: np.ndarray, near: float = 0.0, sharp: float = 1.0,
                  ) -> "PointLikelihood":
        """The same for a sensor in a ``direction`` [3] from the middle of the points, by their size
        over ``near`` away, whose noise across its sight is ``sharp`` times that along it."""
        direction = direction / np.linalg.norm(direction)
        size = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        way = direction - near / size * (self.points - self.points.mean(axis=0))
        return replace(self, sight=way / np.linalg.norm(way, axis=1)[:, None], sharp=sharp,
                       sensor=(direction, near))

    def match(self, skeleton: Skeleton, near: np.ndarray | None = None,
              some: np.ndarray | slice = slice(None)) -> Match:
        """The cylinder of each or ``some`` of the points, of those of the upper nodes ``near``."""
        return match_cylinders(skeleton, self.points[some], near)

    def axes(self, skeleton: Skeleton, match: Match) -> np.ndarray:
        """Unit vector along the axis of each point's cylinder, shape [m, 3]."""
        axis = skeleton.nodes[match.segment] - skeleton.nodes[skeleton.parent[match.segment]]
        return axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]

    def across(self, axes: np.ndarray, some: np.ndarray | slice = slice(None),
               ) -> tuple[np.ndarray, np.ndarray]:
        """Unit vectors across the ``axes`` towards the sensor at ``some`` of the points [m, 3], NaN
        where it looks along them or around; and the sines between axes and sight [m]."""
        if self.sight is None:
            return np.full(axes.shape, np.nan), np.zeros(len(axes))
        sight = self.sight[some]
        sight = sight - np.einsum("mj,mj->m", axes, sight)[:, None] * axes
        size = np.linalg.norm(sight, axis=1)
        return np.where(size > _OPEN, 1 / np.maximum(size, _OPEN), np.nan)[:, None] * sight, size

    def densities(self, skeleton: Skeleton, match: Match, some: np.ndarray | slice = slice(None),
                  ) -> np.ndarray:
        """Density across the axes at ``some`` of the points, times a power of their radii, for
        each noise, shape [m, k]."""
        towards, open_ = self.across(self.axes(skeleton, match), some)
        return densities(np.maximum(match.residual + match.thick, 0.0), match.thick,
                         np.einsum("mj,mj->m", match.normal, towards), open_, self.noises,
                         self.power, self.sharp)

    def scattered(self, skeleton: Skeleton, density: np.ndarray) -> Scatter:
        """The likeliest scatter for densities [m, k] across the axes of a tree."""
        ratio = (self.noises / self.noises[:, None])**2  # [noises, scales]
        shares = ratio**(_FREEDOM / 2) * np.exp(-0.5 * _FREEDOM * ratio)
        shares /= shares.sum(axis=0)
        wood, elsewhere = density / self.skin(skeleton).sum() @ shares, 1 / self.volume
        background = np.full(len(self.noises), _BACKGROUND)
        for _ in range(_ROUNDS):
            off = background * elsewhere
            background = np.mean(off / ((1 - background) * wood + off), axis=0)
        log = np.log((1 - background) * wood + background * elsewhere).sum(axis=0)
        best = int(np.argmax(log))
        return Scatter(float(self.noises[best]), (1 - background[best]) * shares[:, best],
                       float(background[best]))

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
        something; with a ``match`` those between sensors of one tree, as its bends are left out."""
        density = self.densities(skeleton, match or self.match(skeleton))
        scatter = self.scattered(skeleton, density)
        bends = 0.0 if match else float(Bends.of(skeleton).costs(skeleton.nodes).sum())
        return self.log(density @ scatter.shares, scatter, float(self.skin(skeleton).sum()),
                        skeleton.branch_count) - bends

    def roughly(self, skeleton: Skeleton, match: Match) -> float:
        """The score with a third of the noises: sensors differ by far more than that changes it."""
        return replace(self, noises=self.noises[::3]).score(skeleton, match)

    def where_seen(self, skeleton: Skeleton) -> "PointLikelihood":
        """The same for the sensor of those all around with which a tree scores most."""
        match = self.match(skeleton)
        return max((self.seen_from(way, sharp=_SHARP) for way in _DIRECTIONS),
                   key=lambda one: one.roughly(skeleton, match))

    def turned(self, skeleton: Skeleton) -> "PointLikelihood":
        """The same for a sensor beside, with which a tree scores most; itself if none scores more.
        """
        if self.sensor is None:
            return self
        match, (direction, near), still = self.match(skeleton), self.sensor, np.zeros(3)
        changes = [(turn * step, 0.0, 1.0) for turn in (*np.eye(3), *-np.eye(3)) for step in _TURNS]
        changes += [(still, closer, 1.0) for closer in (_TURNS[0], -_TURNS[0])]
        changes += [(still, 0.0, sharper) for sharper in _SHARPER]
        return max([self, *(self.seen_from(direction + turn, max(near + closer, 0.0), min(
            self.sharp * sharper, 1.0)) for turn, closer, sharper in changes)],
                   key=lambda one: one.roughly(skeleton, match))
