"""Samples of branches as likely as the fitted one: axes and radii within the scan's uncertainty.

A scan's axis and the thickness of its branch are known to the points' noise, averaged over a length
of the branch. Errors of neighbouring positions are correlated, and where only one side was seen, an
axis too near goes with a radius too small. Drawing them together keeps these correlations. What a
radius's stated deviation has beyond the noise, the fits of a run share in part. The other part
varies along it, as where the radius steps at a fork and the fitted one tapers. Where the stated
deviation is less than the noise, the prior of wood knew the radius better than the points. The axis
goes with both. Twigs that may not exist are missing in as many of the shapes as their probability
implies.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse.linalg import splu

from limber.geometry.skeleton.confidence import probability_given_carrier
from limber.geometry.skeleton.radii.axis_fit import fitted_system, noise_covariance
from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.element_types import between_corners
from limber.geometry.tets.tet_mesh import TetMesh

POINT_LIMIT = 60_000
"""Most points used, as many as in the fit itself: more share their errors."""
_LEAST, _MOST = 0.5, 2.0
# Of 10 scans of branches with forks, true errors less their mean over the run had .19 (median) of
# that part's variance, .41 (mean) with one wrong branch; they decayed over 2 to 20, median 5 radii.
_VARYING, _DECAY = 0.25, 5.0
# Radius of a missing twig over the fitted one: a shape has the same tetrahedra. Results linear in
# the shape, such as estimates, lose 2 (1 - 0.5), all, of the twig's mass.
_MISSING = 0.5
_LEAST_VOLUME = 0.1  # fraction of a tetrahedron's volume below which its corners move half as far
_HALVINGS = 30


def sample_skeletons(skeleton: Skeleton, points: np.ndarray, count: int,
                     rng: np.random.Generator) -> list[Skeleton]:
    """Draw skeletons from the fit to points [m, 3] [m], its covariance and the twigs'
    probabilities. Nodes move only across their axis; a missing twig, and all on it, is made
    thin."""
    chosen = points[::max(1, -(-len(points) // POINT_LIMIT))]
    # Fewer points of the same noise hold the axis less firmly than those of the fit.
    system, noise = fitted_system(skeleton, chosen)
    factor = splu(system.matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                  options={"SymmetricMode": True})
    # With A = L D L^T, L sqrt(D) times white noise has the covariance A; solving instead gives its
    # inverse.
    pivots = np.sqrt(np.abs(factor.U.diagonal()))
    white = rng.standard_normal((len(pivots), count)) * pivots[:, None]
    coloured = (factor.L @ white)[factor.perm_r]
    moves = noise * factor.solve(coloured).T.reshape(count, -1, 4)
    moves += _beyond_noise(skeleton, noise_covariance(system, noise, skeleton.radius), moves,
                           rng)
    along = skeleton.axes()
    across = moves[..., :3] - np.einsum("snj,nj->sn", moves[..., :3], along)[..., None] * along
    radius = np.clip(skeleton.radius + moves[..., 3], _LEAST * skeleton.radius,
                     _MOST * skeleton.radius)
    # Drawn last: where all twigs are certain, shapes are the same as without them.
    radius = np.where(_existing(skeleton, count, rng), radius, _MISSING * skeleton.radius)
    return [replace(skeleton, nodes=skeleton.nodes + move, radius=thick)
            for move, thick in zip(across, radius, strict=True)]


def _beyond_noise(skeleton: Skeleton, covariance: np.ndarray, moves: np.ndarray,
                  rng: np.random.Generator) -> np.ndarray:
    """What turns draws ``moves`` [count, n, 4] [m] of noise with ``covariance`` [n, 4, 4] [m^2]
    into draws of the stated deviations. It is 0 where a deviation is 0, which means unknown."""
    own = np.sqrt(covariance[:, 3, 3])
    stated = np.where(skeleton.radius_sigma > 0, skeleton.radius_sigma, own)
    together = rng.standard_normal((len(moves), skeleton.branch_count))[:, skeleton.branch]
    together = np.sqrt(1 - _VARYING) * together + np.sqrt(_VARYING) * _along_runs(
        skeleton, len(moves), rng)
    more = (np.minimum(stated / own, 1.0) - 1) * moves[..., 3] + np.sqrt(
        np.maximum(stated**2 - own**2, 0.0)) * together
    return more[..., None] * covariance[:, :, 3] / own[:, None]**2


def _along_runs(skeleton: Skeleton, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws of deviation 1 with exponentially decaying correlation along runs, shape [count, n]."""
    drawn = rng.standard_normal((skeleton.node_count, count))
    for own in skeleton.own_runs():
        step = np.linalg.norm(np.diff(skeleton.nodes[own], axis=0), axis=1)
        kept = np.exp(-step / (_DECAY * skeleton.radius[own[1:]]))
        for before, node, share in zip(own[:-1], own[1:], kept, strict=True):
            drawn[node] = share * drawn[before] + np.sqrt(1 - share**2) * drawn[node]
    return drawn.T


def _existing(skeleton: Skeleton, count: int, rng: np.random.Generator) -> np.ndarray:
    """Whether each node's run exists in each draw, shape [count, n]."""
    chance, runs = probability_given_carrier(skeleton), skeleton.runs()
    exists = np.ones((count, len(runs)), bool)
    for run, members in enumerate(runs[1:], start=1):
        carrier = int(skeleton.branch[members[0]])
        exists[:, run] = exists[:, carrier] & (rng.uniform(size=count) < chance[run])
    return exists[:, skeleton.branch]


def reshaped(mesh: TetMesh, skeleton: Skeleton, other: Skeleton) -> TetMesh:
    """Return a skeleton's mesh moved to another skeleton of the same tree: with the axis, and away
    from it as the radius grows. Where a tetrahedron would turn inside out or nearly vanish (twigs
    side by side at a fork), its corners move less. Edges stay straight."""
    low, high, share, offset = on_cylinders(skeleton, mesh.nodes)
    moves, growth = other.nodes - skeleton.nodes, other.radius / skeleton.radius - 1

    def between(values: np.ndarray) -> np.ndarray:
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        return (1 - weight) * values[low] + weight * values[high]

    shift = between(moves) + between(growth)[:, None] * offset
    corners = mesh.tets[:, :4]
    going = np.ones(len(shift))
    for _ in range(_HALVINGS):
        nodes = mesh.nodes + going[:, None] * shift
        narrow = replace(mesh, nodes=nodes).volumes < _LEAST_VOLUME * mesh.volumes
        if not narrow.any():
            break
        going[np.unique(corners[narrow])] *= 0.5
    if mesh.element.parents:
        nodes[mesh.tets[:, 4:]] = between_corners(mesh.element, nodes[corners])
    return replace(mesh, nodes=nodes)

