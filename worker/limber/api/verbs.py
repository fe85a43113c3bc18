"""The verbs of the Python interface: a branch and its operations.

All verbs work alike. Required arguments come first, without names; all others are the inputs,
settings and options of its command by name (``--mesh-spacing 4`` is ``mesh_spacing=4``), which
:func:`limber.settings` lists. ``quiet=True`` shows no progress. A verb runs its stage in this
process, writes the same files as the command, and returns a frozen result. Unchanged results are
not computed again. Errors are those of :mod:`limber.core.errors`; warnings are Python warnings.
"""

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.api.branch import Branch, PathLike
from limber.api.running import run_stage
from limber.api.settings_table import known_stage
from limber.core.errors import InputError
from limber.stages.result import Result

if TYPE_CHECKING:
    from limber.stages.shape.generate import Generated


def generate(folder: PathLike, *, quiet: bool = False, **settings: Any) -> "Generated":
    """Make a branch with known truth, and scan it as a scanner would.

    Args:
        folder: Folder for the scan and its truth.
        quiet: Show no progress.
        settings: ``length`` [m], ``fork_count``, ``noise`` [m], ``seed`` and those that
            ``limber.settings("generate")`` lists.

    >>> scan = limber.generate("scan", length=0.3, fork_count=0, seed=1)
    >>> scan.cloud.name, scan.young.shape
    ('cloud.ply', (4,))
    """
    from limber.stages.shape.generate import Generated

    _, values = run_stage("generate", {**settings, "folder": folder}, quiet=quiet)
    return Generated.read(None, "generate", values)


def reconstruct(cloud: "PathLike | np.ndarray | Mapping[str, Any]", folder: PathLike, *,
                quiet: bool = False, **settings: Any) -> "Branch":
    """Make a branch folder from a scan: skeleton, surface and tetrahedra.

    Args:
        cloud: A point cloud's file; or points, shape [n, 3]; or columns ``x``, ``y``, ``z`` and
            others by name, as a structured array or a table of pandas has them. Numbers are in
            ``unit``.
        folder: The branch folder to make or replace.
        quiet: Show no progress.
        settings: ``unit`` ("m", "cm", "mm", "in", "um"), ``root`` [3], ``mesh_spacing`` in radii,
            ``young`` [Pa], ``skeleton`` (a file of your own) and those that
            ``limber.settings("reconstruct")`` lists.

    Raises:
        InputError: the scan or a setting cannot be used. WorkError: no branch was found.

    >>> branch = limber.reconstruct("scan/cloud.ply", "new.branch", mesh_spacing=4)
    >>> branch.mesh.cell_data["young"].max() / 1e6
    100.0
    """
    if isinstance(cloud, str | os.PathLike):
        if Path(cloud).is_dir():
            raise InputError(f"{cloud} is a folder.", "One scan becomes one branch.",
                             "Call limber.reconstruct for each of its files.")
        return _made("reconstruct", folder, quiet, {**settings, "cloud": cloud})
    with tempfile.TemporaryDirectory(prefix="limber-cloud-") as temporary:
        path = Path(temporary) / "array.ply"
        _write_cloud(cloud, path)
        return _made("reconstruct", folder, quiet, {**settings, "cloud": path})


def mesh(surface: PathLike, folder: PathLike, *, quiet: bool = False, **settings: Any) -> "Branch":
    """Make a branch folder from a closed surface, a table of sections or a cylinder model.

    Args:
        surface: The file: STL, PLY, OBJ, a CSV of sections, or a cylinder model.
        folder: The branch folder to make or replace.
        quiet: Show no progress.
        settings: ``unit``, ``root`` [3], ``young`` [Pa] and those that
            ``limber.settings("mesh")`` lists.

    Raises:
        InputError: the surface or a setting cannot be used. MeshingError: meshing failed.

    >>> sections = ["x_mm,y_mm,z_mm,width_mm,height_mm", "0,0,0,10,10", "0,0,200,10,10"]
    >>> _ = Path("beam.csv").write_text("\\n".join(sections))
    >>> limber.mesh("beam.csv", "beam.branch").mesh.nodes[:, 2].max().round(3)
    0.2
    """
    return _made("mesh", folder, quiet, {**settings, "surface": surface})


def open(folder: PathLike) -> "Branch":
    """Return the branch of a folder that :func:`limber.reconstruct` or a command has made.

    Raises:
        BranchFolderError: there is no such folder, or it is damaged or of a newer format.

    >>> limber.open("a.branch").mesh.is_quadratic
    True
    """
    return Branch(folder)


def run(command: str, *, quiet: bool = False, **settings: Any) -> Result:
    """Run a command that has no verb, such as ``robot draw``, ``robot check`` or ``doctor``.

    Args:
        command: Its name.
        quiet: Show no progress.
        settings: Its inputs, settings and options, as ``limber.settings(command)`` lists them.

    Raises:
        InputError: there is no such command, or a setting is refused.

    >>> limber.run("verify", branch_folder="a.branch").values["file_count"] > 5
    True
    """
    return Result.read(None, command, run_stage(known_stage(command), settings, quiet=quiet)[1])


def _made(stage: str, folder: PathLike, quiet: bool, arguments: dict[str, Any]) -> Branch:
    run_stage(stage, {**arguments, "output": folder}, quiet=quiet)
    return Branch(folder)


def _write_cloud(cloud: "np.ndarray | Mapping[str, Any]", path: Path) -> None:
    """Write points or columns as a PLY file.

    Raises:
        InputError: they are not points.
    """
    from limber.geometry.cloud.cloud import Cloud

    names = getattr(getattr(cloud, "dtype", None), "names", None) or (
        list(cloud) if hasattr(cloud, "keys") else None)
    if names is None:
        points = np.asarray(cloud)
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
            raise InputError(f"The cloud is an array of shape {points.shape} and type "
                             f"{points.dtype}.",
                             "Points have shape [n, 3].",
                             "Give other columns by name: {\"x\": ..., \"red\": ...}.")
        columns = dict(zip("xyz", points.T, strict=True))
    else:
        columns = {str(name): np.asarray(cloud[name]) for name in names}
    Cloud.from_columns(columns).write_ply(path)
