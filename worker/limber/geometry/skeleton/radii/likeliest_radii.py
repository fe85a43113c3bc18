"""The likeliest radii of all branches together, given their fits and how wood is shaped.

One Gaussian posterior of the logarithms of all radii. Each fitted radius is one observation, with
its own error and with errors that it shares: what a sensor smooths or widens at the scale of its
points (the whole scan), the effect of noise and of sections that are not round (a run). The prior
is how wood grows: a radius changes slowly along a run and falls towards its tip, falls at a fork,
and a side branch starts thinner than its carrier. Where points determine a radius, it is theirs.
Where they hardly do, it follows from the carrier and the resolved part, with a wide interval.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import MEASURED, UNRESOLVED, Skeleton

SPACINGS = 1.0
"""Diameter in point spacings, under which a radius is not resolved: too few points around it."""
_BESIDE = 4  # nodes on each side whose points show the spacing
_NOISES = 1.0  # radius in standard deviations of the noise, under which it is not resolved
# Wood, all in logarithms of radii: a side branch against its carrier (mean, deviation), fall along
# a whole run, variance per radius of length, deviation at a fork, and of a root from any radius.
_SIDE, _SIDE_SIGMA = -1.0, 0.8
_TAPER, _WANDER, _FORK, _ROOT = -0.5, 5e-3, 0.3, 3.0
_APART = 8.0  # radii along a run from which fits are independent
# Fraction of the radius by which fits scatter about the steady radius of wood: least, most, first.
_LOCAL = (0.01, 0.1, 0.05)
# Pixels by which a sensor may widen each side of all branches: half a one where any part of a pixel
# on the branch gives a reading, less than none where mixed ones are dropped. The scan does not show
# it: a front widened so is that of a thicker branch, to a tenth of a pixel.
_EDGE = 0.25
# Fraction of the points' spacing by which a sensor may widen or thin all branches of a scan; and by
# which the radius of a run may be off besides.
_RESOLUTION, _COARSE = 0.1, 0.05
# Fraction of the radius, over (noise / radius)^2: the noise itself is known to 4 %, and the radius
# of one side changes by 3.7 times that (of half a circle, the scatter is twice the square of the
# noise and 0.54 of the radius's).
_BIAS = 0.15
# Fraction of the radius by which a section that is not round differs: seen from all around, and
# from one side, which shows one of its diameters.
_OVAL, _OVAL_SIDE = 0.012, 0.04
_FREEDOM = 4.0  # of Student's distribution of a fit's error: some fits fail
_ROUNDS = 5
_AT_ONCE = 256  # columns of an inverse


@dataclass(frozen=True)
class RadiusEvidence:
    """What a scan shows of its branches' radii besides their fits.

    Attributes:
        spacing: Spacing of the points around each node [m], shape [n].
        noise: Standard deviation of the points across the branches [m].
        shared: Standard deviation of what all points around a branch are off together [m].
        one_sided: Whether one side was seen.
        pixel: Distance of neighbouring rays at each node [m], shape [n], if the edges of branches
            determine the radii, as in one sensor's scan; None: they do not.
    """

    spacing: np.ndarray
    noise: float
    shared: float = 0.0
    one_sided: bool = False
    pixel: np.ndarray | None = None


def likeliest_radii(skeleton: Skeleton, evidence: RadiusEvidence) -> Skeleton:
    """Return the skeleton with the likeliest radii, their standard deviations and states.

    Args:
        skeleton: Fitted. Radii whose state is not measured count for nothing.
        evidence: Its nodes' evidence.
    """
    first = radius = skeleton.radius
    fitted = np.log(radius)
    resolution = _RESOLUTION * evidence.spacing if evidence.pixel is None else (
        _EDGE * evidence.pixel)
    independent = np.minimum(skeleton.steps / (_APART * skeleton.radius), 1.0)
    independent *= skeleton.radius_state == MEASURED
    trust, local = np.ones(len(radius)), _LOCAL[2]
    for _ in range(_ROUNDS):
        # A fit that came out too thin or too thick is as unsure as the thinner one.
        thin = np.minimum(radius, first)
        together = _of_runs(skeleton, evidence, thin)
        known = independent / ((skeleton.radius_sigma / skeleton.radius)**2 + local**2)
        posterior = _Posterior.of(_wood(skeleton, radius), known * trust, fitted, together)
        radius = np.exp(posterior.mean)
        miss = np.abs(fitted - posterior.mean - together @ posterior.errors)
        trust = (_FREEDOM + 1) / (_FREEDOM + known * miss**2)
        if independent.any():
            local = float(np.clip(1.4826 * np.median(miss[independent > 0]), *_LOCAL[:2]))
    # A fit that collapsed resolves nothing; one that does not count is no evidence of thin wood.
    thick = np.where(skeleton.radius_state == MEASURED, first, radius)
    coarse = (2 * thick < SPACINGS * evidence.spacing) | (thick < _NOISES * evidence.noise)
    scan = np.minimum(resolution / thin, 1.0)
    sigma = np.hypot(posterior.deviations(), posterior.moved_by(scan))
    return replace(skeleton, radius=radius, radius_sigma=radius * sigma,
                   radius_state=np.where(coarse, UNRESOLVED, skeleton.radius_state))


def point_spacing(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray, noise: float,
                  ) -> np.ndarray:
    """Mean distance of neighbouring points around each node, corrected for noise [m], shape [n]."""
    distance = cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:].mean(axis=1)
    total = np.bincount(segment, distance, skeleton.node_count)
    count = np.bincount(segment, minlength=skeleton.node_count).astype(float)
    near = np.full(skeleton.node_count, float(np.median(distance)))
    for own in skeleton.own_runs():
        # A node without points has the point spacing of its neighbours.
        around = np.ones(min(2 * _BESIDE + 1, len(own)))
        points_near = np.convolve(count[own], around, "same")
        known = points_near > 0
        near[own[known]] = np.convolve(total[own], around, "same")[known] / points_near[known]
    return np.sqrt(np.maximum(near**2 - noise**2, (0.5 * near)**2))


@dataclass(frozen=True)
class _Wood:
    """The prior: precision of the logarithms, shape [n, n], and precision times mean, shape [n]."""

    precision: sparse.csc_matrix
    pull: np.ndarray


def _wood(skeleton: Skeleton, radius: np.ndarray) -> _Wood:
    """The prior, with its steps counted in current radii [m], shape [n]."""
    node = np.arange(1, len(radius))
    parent, step = skeleton.parent[1:], skeleton.steps[1:]
    length = np.zeros(skeleton.branch_count)
    np.add.at(length, skeleton.branch[1:], step)
    side = skeleton.branch[1:] != skeleton.branch[parent]
    variance = _WANDER * step / radius[parent] + np.where(
        skeleton.child_counts()[parent] > 1, _FORK**2, 0.0)
    change = _TAPER * step / np.maximum(length[skeleton.branch[1:]], 1e-300)
    weight = 1 / np.where(side, _SIDE_SIGMA**2, np.maximum(variance, 1e-12))
    change = np.where(side, _SIDE, change)
    row = np.arange(len(node))
    steps = sparse.coo_matrix((np.repeat([1.0, -1.0], len(node)), (
        np.tile(row, 2), np.concatenate([node, parent]))), (len(node), len(radius))).tocsr()
    root = np.zeros(len(radius))
    root[0] = _ROOT**-2
    return _Wood((steps.T @ sparse.diags(weight) @ steps + sparse.diags(root)).tocsc(),
                 steps.T @ (weight * change) + root * np.log(radius[0]))


def _of_runs(skeleton: Skeleton, evidence: RadiusEvidence, radius: np.ndarray,
             ) -> sparse.csr_matrix:
    """Effect on the logarithms of what each run's fits are off together, shape [n, runs].

    Each has a standard deviation of 1.
    """
    # Their sum must not depend on single fits, or it would level their scatter.
    radius = _typical(skeleton, radius)
    oval = _OVAL_SIDE if evidence.one_sided else _OVAL
    noise = _BIAS * np.minimum(evidence.noise / radius, 1.0)**2
    coarse = np.minimum(_COARSE * evidence.spacing / radius, 1.0)
    off = np.sqrt(oval**2 + noise**2 + coarse**2 + (evidence.shared / radius)**2)
    return sparse.coo_matrix((off, (np.arange(len(off)), skeleton.branch)),
                             (len(off), skeleton.branch_count)).tocsr()


def _typical(skeleton: Skeleton, radius: np.ndarray) -> np.ndarray:
    """Radii [m] that change by one rate along each run, shape [n]."""
    typical = np.log(radius)
    for own in skeleton.own_runs():
        along = skeleton.arc_length[own] - skeleton.arc_length[own].mean()
        rate = float(along @ typical[own]) / max(float(along @ along), 1e-300)
        typical[own] = typical[own].mean() + rate * along
    return np.exp(typical)


@dataclass(frozen=True)
class _Posterior:
    """Means of the logarithms, shape [n], and of the shared errors, shape [k]; the factorised
    precision of both."""

    mean: np.ndarray
    errors: np.ndarray
    factor: SuperLU
    known: np.ndarray
    together: sparse.csr_matrix

    @classmethod
    def of(cls, wood: _Wood, known: np.ndarray, fitted: np.ndarray, together: sparse.csr_matrix,
           ) -> "_Posterior":
        seen = sparse.diags(known)
        cross = seen @ together
        matrix = sparse.bmat([
            [wood.precision + seen, cross],
            [cross.T, sparse.identity(together.shape[1]) + together.T @ cross]]).tocsc()
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        both = factor.solve(np.concatenate([wood.pull + known * fitted, cross.T @ fitted]))
        return cls(both[:len(known)], both[len(known):], factor, known, together)

    def moved_by(self, error: np.ndarray) -> np.ndarray:
        """How far an error of all fits, which the prior must not decide, moves each mean."""
        pull = self.known * error
        return self.factor.solve(np.concatenate([pull, self.together.T @ pull]))[:len(error)]

    def deviations(self) -> np.ndarray:
        """Standard deviation of each logarithm, shape [n]."""
        count, size = len(self.mean), len(self.mean) + len(self.errors)
        variance = np.empty(count)
        for start in range(0, count, _AT_ONCE):
            own = np.arange(start, min(start + _AT_ONCE, count))
            unit = np.zeros((size, len(own)))
            unit[own, own - start] = 1.0
            variance[own] = self.factor.solve(unit)[own, own - start]
        return np.sqrt(np.maximum(variance, 0.0))
