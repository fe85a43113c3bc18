"""Shifts between the stations of a merged scan, found from its points and taken out of them.

Stations that are registered a little apart make one shell each around the same branch. All points
of a station are off by one shift, so that all radii are off together, and no number of points
averages it out. A station sees the side of each section that faces it, as evenly as its rays are
spaced, and each side bends as the section does, wherever it was shifted to. So directions, shifts
and the error that all radii share are those of the likeliest mixture (Dempster, Laird, Rubin 1977).
"""

from dataclasses import dataclass, replace

import numpy as np

from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.kernels import Kernel

_MOST, _TURNS = 4, 4  # stations; directions to begin at
_INWARD = (0.0, 2.0)  # noises by which all are shifted away from their side at first
_SAMPLES, _ROUNDS = (400, 1_500, 2_000), (12, 20, 15)  # points and rounds of starts, counts, end
_LEAST, _CLEAR = 300, 0.02  # points that tell; noise over radius that leaves no room for a shift
_FAR, _STOUT = 4.0, 2.0  # noises within which points count, around radii of so many noises
_SHIFTS, _WIDER = 2.0, 0.3  # deviations: of a shift in noises, of the shared error in median radii
_SHARP = 0.1  # least noise of the mixture, in noises of the fit
_ALIKE = 2.0  # points whose errors are correlated, so that they count as one
_NUMBERS = 5  # of a station: direction (2), shift; each costs half the logarithm of the points
_FACING = -0.5  # cosine between the directions of two stations, below which they face each other
_ROUND = 0.1  # fraction of the shifts that sections which are not round leave in all radii
# Places on a section beside the sight, as even as rays are, and how far they rise towards it.
_BESIDE = np.arange(-15, 16, 2) / 16
_RISE = np.sqrt(1 - _BESIDE**2)

_sums = Kernel(
    "station_sums", "offset float64[points, 3]", "radius float64[points]",
    "axis float64[points, 3]", "towards float64[stations, 3]", "shift float64[stations, 3]",
    "share float64[stations]", "noise float64[2]", "beside float64[places]",
    "rise float64[places]", "out chance float64[points, stations]", "out number float64[stations]",
    "out precision float64[unknowns, unknowns]", "out pull float64[unknowns]",
    "out facing float64[stations, 3]", "out square float64[2]", "wider float", "fit float",
    returns="float")


@dataclass(frozen=True)
class _Sections:
    """Vectors from the axes to points [m, 3] [m], radii there [m] and unit axes [m, 3]."""

    offset: np.ndarray
    radius: np.ndarray
    axis: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, points: np.ndarray) -> "_Sections":
        low, high, share, offset = on_cylinders(skeleton, points)
        axis = skeleton.nodes[high] - skeleton.nodes[low]
        return cls(offset, share * skeleton.radius[high] + (1 - share) * skeleton.radius[low],
                   axis / np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None])

    def some(self, chosen: np.ndarray, most: int) -> "_Sections":
        """Those of about ``most`` of the ``chosen`` points."""
        few = chosen[::-(-len(chosen) // most)]
        return _Sections(self.offset[few], self.radius[few], self.axis[few])


@dataclass(frozen=True)
class _Stations:
    """Directions ``towards`` k stations [k, 3], their ``shift`` [k, 3] [m] and ``share`` of the
    points [k]; the radii's shared error ``wider`` [m], known to ``sigma`` [m]; the noise [m] beside
    the rays and along those that meet a face [2], and that of the ``fit``; the log-likelihood."""

    towards: np.ndarray
    shift: np.ndarray
    share: np.ndarray
    noise: np.ndarray
    fit: float
    wider: float = 0.0
    sigma: float = 0.0
    log: float = -np.inf

    @classmethod
    def around(cls, plane: np.ndarray, count: int, turn: float, fit: float, inward: float,
               ) -> "_Stations":
        """``count`` stations all around in a ``plane`` [3, 2], their sides drawn in [m]."""
        angle = 2 * np.pi * (np.arange(count) + turn) / count
        towards = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ plane.T
        return cls(towards, -inward * towards, np.full(count, 1 / count),
                   np.array([fit / 2, fit]), fit, wider=inward)

    @property
    def opposed(self) -> bool:
        """Whether they are two that face each other."""
        return len(self.share) == 2 and float(self.towards[0] @ self.towards[1]) < _FACING

    def shows(self, sections: _Sections) -> bool:
        """Whether the points are by far likelier than without the shifts; of two that face each
        other, twice as far: noise in all directions looks a little like them."""
        still = replace(self, shift=0 * self.shift, wider=0.0).improved(
            sections, _ROUNDS[1], free=False)
        least = (1 + self.opposed) * self.shift.size * np.log(len(sections.radius)) / 2
        return bool((self.log - still.log) / _ALIKE > least)

    def sums(self, sections: _Sections) -> tuple:
        """:func:`station_sums` of what the points show."""
        return station_sums(sections.offset, sections.radius, sections.axis, self.towards,
                            self.shift, self.share, self.noise, self.wider, self.fit)

    def improved(self, sections: _Sections, rounds: int, free: bool = True) -> "_Stations":
        """The stations after ``rounds`` of expectation and maximisation; not ``free``: unshifted.
        """
        now, numbers = self, 3 * len(self.shift)
        known = np.append(np.full(numbers, (_SHIFTS * self.fit)**-2),
                          (_WIDER * np.median(sections.radius))**-2)
        for _ in range(rounds):
            _, count, log, matrix, pull, towards, square = now.sums(sections)
            covariance = np.linalg.inv(np.diag(known) + matrix)
            step = covariance @ (pull - known * np.append(now.shift, now.wider)) * free
            count += 1e-12
            now = replace(
                now, shift=now.shift + step[:-1].reshape(-1, 3), wider=now.wider + float(step[-1]),
                sigma=float(np.sqrt(covariance[-1, -1])), log=log, share=count / count.sum(),
                noise=np.maximum(np.sqrt(square / count.sum()), _SHARP * now.fit),
                towards=towards / np.maximum(np.linalg.norm(towards, axis=1), 1e-300)[:, None])
        return now


def station_sums(offset: np.ndarray, radius: np.ndarray, axis: np.ndarray, towards: np.ndarray,
                 shift: np.ndarray, share: np.ndarray, noise: np.ndarray, wider: float, fit: float,
                 ) -> tuple:
    """The probability that each point is of each of k stations [m, k] and their sums [k]; the
    log-likelihood; precision [3 k + 1, 3 k + 1] and pull [3 k + 1] of the shifts and the radii's
    shared error; sums of the sights [k, 3], and of misses beside and along them [2] [m^2]."""
    count = len(share)
    chance, number, *sums = (np.empty((len(radius), count)), np.empty(count),
                             np.empty((3 * count + 1, 3 * count + 1)), np.empty(3 * count + 1),
                             np.empty((count, 3)), np.empty(2))
    log = _sums.of(offset, radius, axis, towards, shift, share, noise, _BESIDE, _RISE, chance,
                   number, *sums, wider, fit)
    return chance, number, log, *sums


def registered(skeleton: Skeleton, points: np.ndarray, noise: float,
               ) -> tuple[np.ndarray, float] | None:
    """Return the points [m, 3] [m] without the shifts of their stations, and the deviation of what
    all radii are off together still [m]; None if they show no shift. ``noise`` is theirs [m]."""
    every = _Sections.of(skeleton, points)
    off = np.linalg.norm(every.offset, axis=1) - every.radius
    good = np.flatnonzero((np.abs(off) < _FAR * noise) & (every.radius > _STOUT * noise))
    if len(good) < _LEAST or noise < _CLEAR * np.median(every.radius[good]):
        return None
    few, some, many = (every.some(good, most) for most in _SAMPLES)
    plane = np.linalg.eigh(some.axis.T @ some.axis)[1][:, :2]
    found = [max((_Stations.around(plane, count, turn / _TURNS, noise, inward * noise).improved(
        few, _ROUNDS[0]) for turn in range(_TURNS) for inward in _INWARD),
                 key=lambda one: one.log).improved(some, _ROUNDS[1])
             for count in range(1, _MOST + 1)]
    cost = np.log(len(some.radius)) / 2
    scores = np.array([one.log / _ALIKE - _NUMBERS * cost * len(one.share) for one in found])
    # Two that face each other, both shifted inwards, look like one oval section: none can tell.
    opposed = np.array([one.opposed for one in found])
    scores[[facing and not one.shows(some) for one, facing in zip(found, opposed, strict=True)]
           ] = -np.inf
    first = found[int(np.argmax(np.where(opposed, -np.inf, scores)))]
    best = first.improved(many, _ROUNDS[2])
    shows = len(best.share) > 1 and best.shows(many)
    if not shows and not opposed[np.argmax(scores)]:
        return None
    shift = (best.shift - best.share @ best.shift) * shows
    odds = np.exp(scores - scores.max())
    other = odds @ np.array([one.wider - first.wider * shows for one in found])**2 / odds.sum()
    square = best.share @ np.sum(shift**2, axis=1)
    return points - best.sums(every)[0] @ shift, float(
        np.sqrt(best.sigma**2 + _ROUND**2 * square + other))
