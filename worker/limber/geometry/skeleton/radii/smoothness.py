"""Smoothness of axes and radii: second differences along each run, by their bandwidth."""

import numpy as np
import scipy.sparse as sparse

from limber.geometry.skeleton.skeleton import Skeleton

FORK = 0.3
"""Deviation of a radius's logarithm from that before a fork."""
DISTINCT = 1e-3
"""Radii between nodes at different places."""
_SLOPE = 1.0  # smoothing length of the radius against slopes, in local radii
_NEAREST = 0.5  # least distance of nodes over that at the start of a fit
_BAND, _BAND_LIMIT = 1.2, 3.5  # smoothing length in local radii, without noise and at most


def smoothness(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, per_node: np.ndarray,
               noise: float, stepped: bool = False) -> sparse.csc_matrix:
    """Second differences along each run, weighted as a smoothing spline of a given bandwidth.

    A spline with penalty lambda on the squared second derivative and rho data per length averages
    over (lambda / rho)^(1/4). That length grows with the noise, in local radii.

    Args:
        skeleton: At the start of the fit.
        nodes: Current positions [m], shape [n, 3].
        radius: Current radii [m], shape [n].
        per_node: Weight of the points at each node, shape [n].
        noise: Standard deviation of the points [m].
        stepped: Let the radius of a run that goes on from a fork fall in a step there.
    """
    size = len(nodes)
    chains = [own for own in skeleton.own_runs() if len(own) > 2]
    if not chains:
        return sparse.csc_matrix((4 * size, 4 * size))
    density = float(per_node.sum()) / max(skeleton.length, 1e-300)
    forks = skeleton.child_counts() > 1
    # The nearer two nodes, the more smoothness would draw them together, until they coincide.
    least = np.maximum(_NEAREST * skeleton.steps, DISTINCT * skeleton.radius)
    steps = [np.maximum(np.linalg.norm(np.diff(nodes[chain], axis=0), axis=1), least[chain[1:]])
             for chain in chains]
    mean = np.concatenate([(step[:-1] + step[1:]) / 2 for step in steps])
    band = np.concatenate([_bandwidth(skeleton, chain, forks, noise) for chain in chains])
    second = second_differences(chains, steps, size)
    along = second.T @ sparse.diags(0.5 * density * band**4 * mean) @ second
    jumps = [np.where(forks[chain[:-1]] & stepped, FORK * radius[chain[:-1]], 0.0) / step
             for chain, step in zip(chains, steps, strict=True)]
    bends = np.concatenate([jump[:-1]**2 + jump[1:]**2 for jump in jumps]) / mean**2
    firm = _despite(bends, density * (2.0 * band)**4 * mean, noise)
    thick = (second.T @ sparse.diags(firm) @ second
             + _slope_terms(chains, steps, radius, density, np.concatenate(jumps)**2, noise))
    return (sparse.kron(along, sparse.diags([1.0, 1, 1, 0]))
            + sparse.kron(thick, sparse.diags([0.0, 0, 0, 1]))).tocsc()


def _despite(jumps: np.ndarray, weight: np.ndarray, noise: float) -> np.ndarray:
    """Weights of terms to which steps at forks add variances ``jumps``, all of one shape."""
    return weight / (1 + weight * jumps / max(noise, 1e-12)**2)


def _bandwidth(skeleton: Skeleton, chain: np.ndarray, forks: np.ndarray, noise: float,
               ) -> np.ndarray:
    """Smoothing length [m] at the inner nodes of a chain, shape [k - 2]."""
    # The first radii are used, since a radius that grows by mistake must not blur its own axis.
    thick = skeleton.radius[chain[1:-1]]
    # A branch thinner than the noise bends no finer than one as thick as the noise. Otherwise its
    # axis would follow single points until its radius vanished.
    band = np.clip(_BAND * thick + 8.0 * noise, _BAND * thick,
                   _BAND_LIMIT * np.maximum(thick, noise))
    # Axes kink at forks, where a branch's leader deflects at a strong twig.
    return band * (np.where(forks[chain[1:-1]], 0.6, 1.0) * _straightness(skeleton.nodes[chain]))


def second_differences(chains: list[np.ndarray], steps: list[np.ndarray], size: int,
                        ) -> sparse.csr_matrix:
    """Second differences at the inner nodes of all chains, shape [inner nodes, size]."""
    rows, columns, values, count = [], [], [], 0
    for chain, step in zip(chains, steps, strict=True):
        before, after = step[:-1], step[1:]
        mean = (before + after) / 2
        rows += 3 * [count + np.arange(len(chain) - 2)]
        columns += [chain[:-2], chain[1:-1], chain[2:]]
        values += [1 / before / mean, -(1 / before + 1 / after) / mean, 1 / after / mean]
        count += len(chain) - 2
    return sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (count, size)).tocsr()


def _straightness(nodes: np.ndarray) -> np.ndarray:
    """1 where the contracted axis is straight, down to 0.3 at its kinks, shape [n - 2]."""
    index = np.arange(1, len(nodes) - 1)
    before = nodes[index] - nodes[np.maximum(index - 2, 0)]
    after = nodes[np.minimum(index + 2, len(nodes) - 1)] - nodes[index]
    cosine = np.einsum("ij,ij->i", before, after) / np.maximum(
        np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-300)
    return np.clip(1.3 - np.arccos(np.clip(cosine, -1, 1)), 0.3, 1.0)


def _slope_terms(chains: list[np.ndarray], steps: list[np.ndarray], radius: np.ndarray,
                 density: float, jumps: np.ndarray, noise: float) -> sparse.csr_matrix:
    """Weak penalty on a radius's slope: branches are not cones, whatever stray points suggest."""
    low = np.concatenate([chain[:-1] for chain in chains])
    high = np.concatenate([chain[1:] for chain in chains])
    step = np.concatenate(steps)
    index = np.arange(len(step))
    first = sparse.coo_matrix(
        (np.concatenate([-1 / step, 1 / step]), (np.tile(index, 2), np.concatenate([low, high]))),
        (len(step), len(radius))).tocsr()
    thick = (radius[high] + radius[low]) / 2
    firm = _despite(jumps, density * (_SLOPE * thick)**2 * step, noise)
    return first.T @ sparse.diags(firm) @ first
