"""The prior of wood: how axes bend and radii change along runs and at forks.

In logarithms of radii. Along a run they change slowly and fall towards its tip. At a fork the
carrier becomes thinner in a step, by the wood that its side branches take (pipe model: Shinozaki et
al. 1964; da Vinci's rule, Murray's law): the sum of r^p of all children is that of their parent.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse

from limber.geometry.skeleton.radii.smoothness import DISTINCT, FORK, second_differences
from limber.geometry.skeleton.skeleton import Skeleton

# In logarithms of radii: a side branch against its carrier and the fall along a whole run (mean and
# deviation each); deviation of a root from any radius.
_SIDE, _SIDE_SIGMA = -1.0, 0.8
_TAPER, _TAPER_SIGMA, _ROOT = -0.5, 0.7, 3.0
_GOES_ON = -0.15  # mean at forks, where a run goes on
WANDER = 5e-3
"""Variance of a radius's logarithm per radius of length."""
# Power of the pipe model, and deviations from it as logarithms of a radius: of all forks of a plant
# together, and of each. Over 1,350 forks of seven sources, whose powers are 1.9 to 3.0 and two of
# which have no steps, they are 0.07 and 0.03; with each source left out in turn 0.06 to 0.07, and
# 0.02 to 0.03.
_POWER, _PIPE_SIGMA, _FORK_SIGMA = 2.7, 0.08, 0.04
# An axis: variance of the direction per radius of length [rad^2], deviation at a fork [rad].
_BEND, _KINK = 1e-3, 0.25
FREEDOM = 4.0
"""Of Student's distribution of what fits and forks are off: some fail."""


@dataclass(frozen=True)
class Wood:
    """The prior of the logarithms of n radii and of k trends: the taper of each run, and what the
    forks of the plant are off the pipe model together.

    Attributes:
        changes: As a matrix over nodes, [m, n]: the root's radius, each node's change from its
            parent, then at each fork that from the parent to the wood of all children.
        trends: How they go with the trends, shape [m, k].
        start: Their means without trends, shape [m].
        weight: Their inverse variances, shape [m].
        known: Inverse variances of the trends, shape [k].
        mean: Means of the trends, shape [k].
    """

    changes: sparse.csr_matrix
    trends: sparse.csr_matrix
    start: np.ndarray
    weight: np.ndarray
    known: np.ndarray
    mean: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, radius: np.ndarray) -> "Wood":
        """Its lengths are counted, and its forks linearised, in current radii [m], shape [n]."""
        count, runs, run, step = (len(radius), skeleton.branch_count, skeleton.branch,
                                  skeleton.steps)
        node, parent = np.arange(1, count), skeleton.parent[1:]
        side = run[1:] != run[parent]
        at_fork = ~side & (skeleton.child_counts()[parent] > 1)
        one_by_one = sparse.identity(count) - sparse.coo_matrix(
            (np.ones(count - 1), (node, parent)), (count, count))
        variance = WANDER * step[1:] / radius[parent] + np.where(at_fork, FORK**2, 0.0)
        pipes, start, off = _pipes(skeleton.parent, radius, parent[at_fork])
        length = np.bincount(run[1:], step[1:], runs)
        fall = np.where(side, 0.0, step[1:] / np.maximum(length[run[1:]], 1e-300))
        trends = sparse.block_diag([
            sparse.coo_matrix((fall, (node, run[1:])), (count, runs)), np.ones((len(start), 1))])
        return cls(
            sparse.vstack([one_by_one, pipes]).tocsr(), trends.tocsr(),
            np.concatenate([[np.log(radius[0])], np.where(
                side, _SIDE, np.where(at_fork, _GOES_ON, 0.0)), start]),
            1 / np.concatenate([[_ROOT**2], np.where(
                side, _SIDE_SIGMA**2, np.maximum(variance, 1e-12)), off]),
            np.append(np.full(runs, _TAPER_SIGMA**-2), _PIPE_SIGMA**-2),
            np.append(np.full(runs, _TAPER), 0.0))

    @property
    def precision(self) -> sparse.csr_matrix:
        """Of nodes and trends, shape [n + k, n + k]."""
        both = sparse.hstack([self.changes, -self.trends])
        return (both.T @ sparse.diags(self.weight) @ both + sparse.diags(np.concatenate(
            [np.zeros(self.changes.shape[1]), self.known]))).tocsr()

    @property
    def pull(self) -> np.ndarray:
        """Precision times mean of nodes and trends, shape [n + k]."""
        start = self.weight * self.start
        return np.concatenate([self.changes.T @ start,
                               self.known * self.mean - self.trends.T @ start])


def _pipes(parent: np.ndarray, radius: np.ndarray, forks: np.ndarray,
           ) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray]:
    """Changes from forks to the wood of their children as a matrix over nodes, [f, n], and their
    means and variances, shape [f].

    Args:
        parent: Of each node, shape [n].
        radius: Current radii [m], shape [n].
        forks: Nodes at which runs go on and others start, shape [f].
    """
    count, child = len(radius), np.flatnonzero(np.isin(parent, forks))
    row, log, wood = np.full(count, -1), np.log(radius), radius[child]**_POWER
    row[forks] = np.arange(len(forks))
    own = row[parent[child]]
    total = np.bincount(own, wood, len(forks))
    part, pipe = wood / total[own], np.log(total) / _POWER
    pipes = sparse.coo_matrix((
        np.concatenate([part, np.full(len(forks), -1.0)]),
        (np.concatenate([own, row[forks]]), np.concatenate([child, forks]))),
        (len(forks), count)).tocsr()
    miss = pipe - log[forks]
    if len(forks):
        miss -= np.clip(np.median(miss), -_PIPE_SIGMA, _PIPE_SIGMA)
    # Some forks swell, and at some a branch was cut off.
    return (pipes, np.bincount(own, part * log[child], len(forks)) - pipe,
            (FREEDOM * _FORK_SIGMA**2 + miss**2) / (FREEDOM + 1))


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
