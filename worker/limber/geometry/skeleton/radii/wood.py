"""The prior of wood: how axes bend and radii change along runs and at forks.

In logarithms of radii. Along a run they change slowly and fall towards its tip. At a fork the
carrier becomes thinner in a step, by the wood that its side branches take (pipe model: Shinozaki et
al. 1964; da Vinci's rule, Murray's law): the sum of r^p of all children is that of their parent.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from limber.geometry.skeleton.radii.smoothness import second_differences
from limber.geometry.skeleton.skeleton import Skeleton

# In logarithms of radii: a side branch against its carrier and the fall along a whole run (mean and
# deviation each); deviation of a root from any radius.
_SIDE, _SIDE_SIGMA = -1.0, 0.8
_TAPER, _TAPER_SIGMA, _ROOT = -0.5, 0.7, 3.0
WANDER = 5e-3
"""Variance of a radius's logarithm per radius of length."""
# Power of the pipe model, and deviations from it as logarithms of a radius: of all forks of a plant
# together, and of each. Over 1,350 forks of seven sources, whose powers are 1.9 to 3.0 and two of
# which have no steps, they are 0.07 and 0.03; with each source left out in turn 0.06 to 0.07, and
# 0.02 to 0.03.
_POWER, _PIPE_SIGMA, _FORK_SIGMA = 2.7, 0.08, 0.04
# An axis: variance of the direction per radius of length [rad^2], deviation at a fork [rad].
_BEND, _KINK = 1e-3, 0.25
DISTINCT = 1e-3
"""Radii between nodes at different places."""
FREEDOM = 4.0
"""Of Student's distribution of what fits and forks are off: some fail."""


@dataclass(frozen=True)
class Wood:
    """The prior of the logarithms of n radii and of k trends: the taper of each run, and what the
    forks of the plant are off the pipe model together.

    Attributes:
        steps: Changes from each node's parent to it, as a matrix over nodes, [n, n]; the root's
            own. Where a run goes on from a fork, the change to the wood of all children.
        trends: How they go with the trends, shape [n, k].
        start: Their means without trends, shape [n].
        weight: Their inverse variances, shape [n].
        known: Inverse variances of the trends, shape [k].
        mean: Means of the trends, shape [k].
        scale: Half the logarithm of the determinant of the precision.
    """

    steps: sparse.csr_matrix
    trends: sparse.csr_matrix
    start: np.ndarray
    weight: np.ndarray
    known: np.ndarray
    mean: np.ndarray
    scale: float

    @classmethod
    def of(cls, skeleton: Skeleton, radius: np.ndarray) -> "Wood":
        """Its lengths are counted, and its forks linearised, in current radii [m], shape [n]."""
        count, runs, parent = len(radius), skeleton.branch_count, skeleton.parent.copy()
        parent[0] = 0
        node, run, step = np.arange(count), skeleton.branch, skeleton.steps
        side = run != run[parent]
        at_fork = ~side & (skeleton.child_counts()[parent] > 1) & (node > 0)
        steps, part, start, variance = _changes(parent, radius, side, at_fork)
        variance = np.where(side, _SIDE_SIGMA**2, np.maximum(
            variance + WANDER * step / radius[parent], 1e-12))
        start = np.where(side, _SIDE, start)
        start[0], variance[0] = np.log(radius[0]), _ROOT**2
        length = np.bincount(run[1:], step[1:], runs)
        fall = np.where(side | (node == 0), 0.0, step / np.maximum(length[run], 1e-300))
        trends = sparse.coo_matrix((np.concatenate([fall, at_fork]), (
            np.tile(node, 2), np.concatenate([run, np.full(count, runs)]))),
            (count, runs + 1)).tocsr()
        known = np.append(np.full(runs, _TAPER_SIGMA**-2), _PIPE_SIGMA**-2)
        return cls(steps, trends, start, 1 / variance, known, np.append(np.full(runs, _TAPER), 0.0),
                   float(np.log(part[at_fork]).sum()
                         + (np.log(known).sum() - np.log(variance).sum()) / 2))

    @property
    def precision(self) -> sparse.csr_matrix:
        """Of nodes and trends, shape [n + k, n + k]."""
        both = sparse.hstack([self.steps, -self.trends])
        return (both.T @ sparse.diags(self.weight) @ both + sparse.diags(
            np.concatenate([np.zeros(len(self.start)), self.known]))).tocsr()

    @property
    def pull(self) -> np.ndarray:
        """Precision times mean of nodes and trends, shape [n + k]."""
        start = self.weight * self.start
        return np.concatenate([self.steps.T @ start,
                               self.known * self.mean - self.trends.T @ start])

    def log_density(self, log_radius: np.ndarray, trends: np.ndarray) -> float:
        """Of logarithms of radii, shape [n], and trends, shape [k]; without powers of 2 pi."""
        off = self.steps @ log_radius - self.trends @ trends - self.start
        return self.scale - float(self.weight @ off**2 + self.known @ (trends - self.mean)**2) / 2


def _changes(parent: np.ndarray, radius: np.ndarray, side: np.ndarray, at_fork: np.ndarray,
             ) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray, np.ndarray]:
    """Changes of radii as a matrix over nodes, [n, n], the part of each child in the wood of its
    parent's, and the means and variances of what forks add, shape [n] each.

    Args:
        parent: The root's is itself, shape [n].
        radius: Current radii [m], shape [n].
        side: Whether a run starts there, shape [n].
        at_fork: Whether a run goes on from a fork there, shape [n].
    """
    count, node, log, wood = len(radius), np.arange(len(radius)), np.log(radius), radius**_POWER
    wood[0] = 0.0
    total = np.bincount(parent, wood, count)
    part = wood / np.maximum(total[parent], 1e-300)
    goes_on = np.zeros(count, np.int64)
    goes_on[parent[at_fork]] = node[at_fork]
    joined = side & (goes_on[parent] > 0)
    steps = sparse.coo_matrix((
        np.concatenate([np.where(at_fork, part, 1.0), np.full(count - 1, -1.0), part[joined]]),
        (np.concatenate([node, node[1:], goes_on[parent[joined]]]),
         np.concatenate([node, parent[1:], node[joined]]))), (count, count)).tocsr()
    pipe = np.log(np.maximum(total, 1e-300)) / _POWER
    start = np.bincount(parent, part * log, count)[parent] - pipe[parent]
    miss, own = (pipe - log)[parent], _FORK_SIGMA**2
    if at_fork.any():
        miss -= np.clip(np.median(miss[at_fork]), -_PIPE_SIGMA, _PIPE_SIGMA)
    # Some forks swell, and at some a branch was cut off.
    variance = own * (FREEDOM + miss**2 / own) / (FREEDOM + 1)
    return (steps, part, np.where(at_fork, start, 0.0), np.where(at_fork, variance, 0.0))


@dataclass(frozen=True)
class Bends:
    """The prior of the axes: directions change slowly along a run, with a few sharp bends.

    Attributes:
        turns: Change of direction at the inner nodes of runs, as a matrix over nodes, [k, n].
        variance: Its variance in each component [rad^2], shape [k].
        trust: Weight of each, by Student's distribution, shape [k].
    """

    turns: sparse.csr_matrix
    variance: np.ndarray
    trust: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton) -> "Bends":
        # Between nodes at one place there is no direction.
        long = skeleton.steps
        apart = long > DISTINCT * skeleton.radius
        chains = [np.append(own[:1], own[1:][apart[own[1:]]]) for own in skeleton.own_runs()]
        chains = [chain for chain in chains if len(chain) > 2]
        steps = [long[chain[1:]] for chain in chains]
        length = np.concatenate([np.empty(0), *((step[:-1] + step[1:]) / 2 for step in steps)])
        inner = np.concatenate([np.empty(0, np.int64), *(chain[1:-1] for chain in chains)])
        second = second_differences(chains, steps, skeleton.node_count) if chains else (
            sparse.csr_matrix((0, skeleton.node_count)))
        variance = _BEND * length / skeleton.radius[inner] + np.where(
            skeleton.child_counts()[inner] > 1, _KINK**2, 0.0)
        return cls(sparse.diags(length) @ second, variance, np.ones(len(inner)))

    def after(self, nodes: np.ndarray) -> "Bends":
        """The same with the weights that axes [m], shape [n, 3], give."""
        square = np.sum((self.turns @ nodes)**2, axis=1) / self.variance
        return replace(self, trust=(FREEDOM + 2) / (FREEDOM + square))

    def precision(self) -> sparse.csr_matrix:
        """Of nodes (x, y, z [m], logarithm of the radius), shape [4 n, 4 n]."""
        bend = self.turns.T @ sparse.diags(self.trust / self.variance) @ self.turns
        return sparse.kron(bend, sparse.diags([1.0, 1.0, 1.0, 0.0])).tocsr()
