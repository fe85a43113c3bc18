"""Tetrahedra for a branch: our own sweep along its axes, or fTetWild on its surface."""

import contextlib
import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from limber.core.errors import InputError, MeshingError, MissingDependencyError, Option
from limber.core.files.caches import TETRAHEDRA_BYTES, cache_folder, trim
from limber.core.files.reading import read_arrays, require_shapes
from limber.core.progress import SILENT, Progress
from limber.geometry.settings import MeshSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.surface.surface import Surface
from limber.geometry.tets.tet_mesh import TetMesh
from limber.geometry.tets.tetwild_process import run_tetwild

_CACHE_VERSION = 1
_SECONDS = 60.0  # of processor time for fTetWild
_SIDES = 8  # of the sections that fTetWild fills; more only cost time, as its tetrahedra are larger
_LEFT_OUT_LIMIT = 0.02  # fraction of the volume; thinner twigs are not worth fTetWild's time


@dataclass(frozen=True)
class MeshResult:
    """Quadratic tetrahedra without data, from the ``mesher`` ``ftetwild``, ``ftetwild (cached)`` or
    ``sweep``; ``warnings`` say why not from the first. Runs ``left_out`` are not in the mesh."""

    mesh: TetMesh
    mesher: str
    warnings: list[str] = field(default_factory=list)
    left_out: list[int] = field(default_factory=list)


def mesh_branch(skeleton: Skeleton, settings: MeshSettings | None = None, *,
                progress: Progress = SILENT) -> MeshResult:
    """Mesh the generalised cylinders of a skeleton with quadratic tetrahedra.

    The sweep is tried first. On our scans it takes half a second where fTetWild takes 6 to 60,
    gives the same result each time, keeps the volume within a percent and has no flatter angles.
    fTetWild is used where the sweep cannot join a twig, and the sweep again if fTetWild fails.

    Args:
        skeleton: Axes and radii.
        settings: Choice of mesher and resolution.
        progress: Called during the work.

    Raises:
        MeshingError: no mesher succeeded.
    """
    settings = settings or MeshSettings()
    swept, warnings = None, []
    if settings.mesher != "ftetwild":
        try:
            swept = _swept(skeleton, settings)
        except MeshingError as error:
            if settings.mesher == "sweep":
                raise
            warnings.append(f"{error.seen} fTetWild was used instead.")
        if swept is not None and (settings.mesher == "sweep"
                                  or _share(skeleton, swept.left_out) < _LEFT_OUT_LIMIT):
            return swept
    try:
        return MeshResult(*_wild(skeleton, settings, progress), warnings)
    except (MeshingError, MissingDependencyError) as error:
        if swept is None and settings.mesher == "auto":
            raise
        warnings.append(f"{error.seen} The sweep mesher was used instead.")
    swept = swept or _swept(skeleton, settings)
    return MeshResult(swept.mesh, "sweep", warnings + swept.warnings, swept.left_out)


def _share(skeleton: Skeleton, runs: list[int]) -> float:
    """Fraction of the skeleton's volume in the given runs."""
    volume = skeleton.radius**2 * skeleton.steps
    return float(volume[np.isin(skeleton.branch, runs)].sum() / volume.sum())


def _swept(skeleton: Skeleton, settings: MeshSettings) -> MeshResult:
    from limber.geometry.tets.tree_sweep import sweep_tree

    swept = sweep_tree(skeleton, spacing=settings.mesh_spacing)
    warnings = []
    if swept.left_out:
        warnings.append(f"{len(swept.left_out)} twig(s) could not be joined to the mesh. Their "
                        "mass is kept.")
    return MeshResult(swept.mesh.quadratic(), "sweep", warnings, swept.left_out)


def _wild(skeleton: Skeleton, settings: MeshSettings, progress: Progress,
          ) -> tuple[TetMesh, str]:
    from limber.geometry.surface.tubes import branch_surface

    surface = branch_surface(skeleton, sides=_SIDES, spacing=settings.mesh_spacing)
    radii = np.sort(skeleton.radius)
    mesh, cached = tetrahedralise(
        surface, edge_length=4 * float(np.median(radii)),
        epsilon=0.25 * float(radii[len(radii) // 10]), time_limit=_SECONDS,
        progress=progress)
    return mesh, "ftetwild (cached)" if cached else "ftetwild"


def tetrahedralise(surface: Surface, *, edge_length: float, epsilon: float,
                   time_limit: float = _SECONDS, stop_energy: float = 30.0,
                   coarsen: bool = False, progress: Progress = SILENT) -> tuple[TetMesh, bool]:
    """Fill a closed surface by :func:`run_tetwild`; also whether it came from the cache.
    ``epsilon`` is absolute [m]: fTetWild's own, a thousandth of the box, removes 7 % of a thin
    branch's volume. MeshingError without a mesh, or if it lost over 5 % of the volume."""
    path = _cache_path(surface, edge_length, epsilon, stop_energy, coarsen)
    cached = _from_cache(path)
    if cached is None:
        nodes, tets = run_tetwild(
            surface.vertices, surface.faces, edge_length=edge_length, epsilon=epsilon,
            stop_energy=stop_energy, coarsen=coarsen, time_limit=time_limit,
            progress=progress)
        _to_cache(path, nodes, tets)
    else:
        nodes, tets = cached
    return _checked(nodes, tets, surface), cached is not None


def _checked(nodes: np.ndarray, tets: np.ndarray, surface: Surface) -> TetMesh:
    if len(tets) == 0:
        raise MeshingError("fTetWild returned no tetrahedra.", "The surface may be open.",
                           "Check the surface.")
    mesh = _largest_piece(TetMesh(nodes, tets.astype(np.int64)).oriented())
    ratio = float(mesh.volumes.sum()) / surface.volume
    if not 0.95 < ratio < 1.05:
        raise MeshingError(f"fTetWild's mesh has {100 * ratio:.1f} % of the surface's volume.",
                           "The bending stiffness changes with the square of this ratio.",
                           "Use a smaller tolerance, or choose ", Option("mesher", "sweep"), ".")
    if mesh.volumes.min() <= 1e-7 * np.median(mesh.volumes):
        raise MeshingError("fTetWild's mesh has flat tetrahedra.", "A solver cannot use flat "
                           "tetrahedra.", "Choose ", Option("mesher", "sweep"), ".")
    return mesh.quadratic()


def _largest_piece(mesh: TetMesh) -> TetMesh:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    tets = mesh.tets[:, :4]
    rows, columns = tets[:, [0, 1, 2]].ravel(), tets[:, [1, 2, 3]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), (mesh.node_count,) * 2)
    _, label = connected_components(graph, directed=False)
    size = np.bincount(label[tets[:, 0]])
    keep = label[tets[:, 0]] == int(np.argmax(size))
    used, inverse = np.unique(tets[keep], return_inverse=True)
    return TetMesh(mesh.nodes[used], inverse.reshape(-1, 4))


def _cache_path(surface: Surface, *numbers: float) -> Path:
    digest = hashlib.sha256()
    for array in (surface.vertices, surface.faces.astype(np.int64),
                  np.array([_CACHE_VERSION, *map(float, numbers)])):
        digest.update(np.ascontiguousarray(array).tobytes())
    return cache_folder() / "tetrahedra" / f"{digest.hexdigest()}.npz"


def _from_cache(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        stored = read_arrays(path, "tetrahedra")
        require_shapes(path, stored, {"nodes": ("n", 3), "tets": ("t", 4)}, "tetrahedra")
    except InputError:
        return None  # missing or truncated: the mesh is made again
    return stored["nodes"], stored["tets"]


def _to_cache(path: Path, nodes: np.ndarray, tets: np.ndarray) -> None:
    part = path.with_name(f".{os.getpid()}-{path.name}")
    # A cache that cannot be written costs time, not results.
    with contextlib.suppress(OSError):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(part, nodes=nodes, tets=tets)
            os.replace(part, path)
            trim(path.parent, TETRAHEDRA_BYTES)
        finally:
            part.unlink(missing_ok=True)
