"""Laplacian-based contraction: the cloud is drawn together onto the axes of its branches.

Cao, Tagliasacchi, Olson, Zhang, Su: Point Cloud Skeletons via Laplacian-Based Contraction (2010),
following the paper: each iteration solves, in the least-squares sense,

    [W_L L]        [   0   ]
    [ W_H ]  P'  = [ W_H P ].

The Laplacian is computed once, on the scan. Recomputed on the contracted points, as is usual, it
follows every hole of the scan and takes several times as long (`scripts/bench geometry`).
"""

import time
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from limber.core.errors import WorkError
from limber.core.numerics.sparse import (
    CholmodFactor,
    NotPositiveDefiniteError,
    SuperLuFactor,
    general_factor,
)
from limber.core.progress import SILENT, Progress

NEIGHBOURS = 12
"""Neighbours that the point-cloud Laplacian triangulates; 12 is as good as 30 and faster."""

_LINE_NEIGHBOURS = 20
_SOLVES = 12  # at most
_LINEAR, _FEW_LEFT = 0.95, 0.03  # when a point is contracted; fraction of others at the end
_GROWTH = 3.0
_STILL_THICK = 0.6  # fraction of points not yet on a line down to which the weights grow


class ContractionStatus(StrEnum):
    """How a contraction ended; each value is its own text.

    contracted: nearly all points lie on lines.
    stalled: points no longer moved.
    iteration_limit: the maximum number of solves was reached.
    given: the skeleton was given, so there was no contraction.
    """

    contracted = "contracted"
    stalled = "stalled"
    iteration_limit = "iteration limit"
    given = "skeleton given"


@dataclass(frozen=True)
class Contraction:
    """Result of the contraction.

    Attributes:
        points: Contracted points [m], shape [n, 3], in the order of the input.
        linearity: Fraction of the variance around each point that lies along one line, 1/3 to 1,
            shape [n]; 1 where the cloud has become a curve.
        iterations: Number of linear solves.
        status: Status at the end.
        history: One dict an iteration: ``moved`` [m], ``active`` (fraction of points not yet on a
            curve), ``seconds``.
    """

    points: np.ndarray
    linearity: np.ndarray
    iterations: int
    status: ContractionStatus
    history: list[dict[str, float]] = field(default_factory=list)


def contract(points: np.ndarray, *, weight: float = 1.0, progress: Progress = SILENT,
             ) -> Contraction:
    """Contract points to the axes of their branches.

    The contraction weight of a point grows while the points around it do not lie on a line yet,
    and shrinks once they do, so that thin twigs are not shortened while thick ones still close.
    The attraction W_H is constant. On 4 generated branches the growing one of Cao et al. (section
    4) was as good where all sides were seen; from one side radii were 2.6 instead of 2.0 % off, and
    one fork of 12 was lost.

    Args:
        points: Positions [m], shape [n, 3].
        weight: Of W_L relative to W_H at the start.
        progress: Called each iteration.

    Raises:
        WorkError: the linear system could not be solved.
    """
    scale = float(np.linalg.norm(np.ptp(points, axis=0)))
    centre = points.mean(axis=0)
    positions = (points - centre) / scale
    progress(0.0, "laplacian")
    laplacian = cloud_laplacian(positions)
    solver = _NormalEquations(laplacian)
    weights = np.full(len(points), weight)
    history: list[dict[str, float]] = []
    status, linearity = ContractionStatus.iteration_limit, local_linearity(positions)
    for iteration in range(_SOLVES):
        started = time.perf_counter()
        drawn = solver.solve(weights, positions)
        moved = float(np.linalg.norm(drawn - positions, axis=1).mean())
        positions = drawn
        linearity = local_linearity(positions)
        active = linearity < _LINEAR
        # Beyond that fraction, only forks and noise remain, which never become lines. More weight
        # only pulls the rest off its axis.
        growth = _GROWTH if active.mean() > _STILL_THICK else 1.0
        weights *= np.where(active, growth, 0.1)
        history.append({"moved": moved * scale, "active": float(active.mean()),
                        "seconds": time.perf_counter() - started})
        progress((iteration + 1) / _SOLVES, "contracting", iteration=iteration + 1,
                 active=float(active.mean()), moved_m=moved * scale)
        if active.mean() < _FEW_LEFT:
            status = ContractionStatus.contracted
            break
        if iteration > 3 and moved * scale < 0.1 * max(done["moved"] for done in history):
            status = ContractionStatus.stalled
            break
    return Contraction(positions * scale + centre, linearity, len(history), status, history)


def cloud_laplacian(points: np.ndarray) -> sparse.csc_matrix:
    """Return the cotangent Laplacian of a cloud (rows sum to 0), shape [n, n].

    Uses ``robust_laplacian`` (Sharp and Crane 2020) if installed, else triangles of each point's
    neighbours in its tangent plane.
    """
    try:
        import robust_laplacian
    except ImportError:
        from limber.geometry.skeleton.contraction.tangent_laplacian import tangent_laplacian

        return tangent_laplacian(points, NEIGHBOURS)
    laplacian, _ = robust_laplacian.point_cloud_laplacian(points, n_neighbors=NEIGHBOURS)
    return laplacian.tocsc()


def local_linearity(points: np.ndarray) -> np.ndarray:
    """Fraction of the variance around each point along its main direction, shape [n]."""
    count = min(_LINE_NEIGHBOURS, len(points))
    _, near = cKDTree(points).query(points, k=count)
    offset = points[near] - points[near].mean(axis=1, keepdims=True)
    variance = offset.transpose(0, 2, 1) @ offset
    total = np.trace(variance, axis1=1, axis2=2)
    return _largest_eigenvalues(variance, total / 3) / np.maximum(total, 1e-300)


def _largest_eigenvalues(matrix: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Largest eigenvalues of symmetric matrices [n, 3, 3] with mean eigenvalues ``mean`` [n], by
    Smith's closed form (1961, doi:10.1145/355578.366316): a tenth of LAPACK's time.
    """
    rest = matrix - mean[:, None, None] * np.eye(3)
    spread = np.sqrt((rest**2).sum(axis=(1, 2)) / 6)
    unit = rest / np.maximum(spread, 1e-300)[:, None, None]
    half = np.einsum("ni,ni->n", unit[:, 0], np.cross(unit[:, 1], unit[:, 2])) / 2
    return mean + 2 * spread * np.cos(np.arccos(np.clip(half, -1.0, 1.0)) / 3)


class _NormalEquations:
    """(L' W_L^2 L + 1) P' = P by sparse Cholesky; the pattern stays the same."""

    def __init__(self, laplacian: sparse.csc_matrix):
        self._laplacian = laplacian
        self._factor: CholmodFactor | SuperLuFactor | None = None

    def solve(self, contraction: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Solve for the diagonal of W_L, shape [n]."""
        weighted = sparse.diags(contraction) @ self._laplacian
        matrix = (weighted.T @ weighted + sparse.identity(len(points))).tocsc()
        lower = sparse.tril(matrix, format="csc")
        lower.sort_indices()
        if self._factor is None:
            columns = np.repeat(np.arange(len(points)), np.diff(lower.indptr))
            self._factor = general_factor(lower.indices, columns, len(points), is_ordered=False)
        try:
            self._factor.factorise(lower.data)
        except NotPositiveDefiniteError as error:
            raise WorkError(f"The linear system of the contraction is singular ({error}).",
                            "Many points may coincide.", "Thin the cloud.") from error
        return _finite(self._factor.solve(points))


def _finite(points: np.ndarray) -> np.ndarray:
    if not np.isfinite(points).all():
        raise WorkError("The contraction produced numbers that are not finite.",
                        "The Laplacian of the cloud may be degenerate.",
                        "Thin the cloud.")
    return points
