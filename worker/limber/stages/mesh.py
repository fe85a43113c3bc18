"""Closed surface (STL, PLY, OBJ) to tetrahedra."""

from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from limber.files import file_digest, require_file
from limber.geometry.settings import MeshSurfaceSettings
from limber.progress import SILENT, Progress
from limber.settings import Groups, Settings
from limber.stages.inputs import RunOptions, argument
from limber.stages.registry import StageDescription
from limber.store import Branch


class MeshInputs(Settings):
    """A closed surface, and the branch folder to make."""

    groups: ClassVar[Groups] = {"input": ("surface",), "output": ("output",)}

    surface: Path = argument("STL, PLY, OBJ or OFF.")
    output: Path = Field(description="The branch folder to make.",
                         json_schema_extra={"short": "-o"})


def mesh_surface(path: Path, folder: Path, settings: MeshSurfaceSettings | None = None, *,
                 force: bool = False, progress: Progress = SILENT) -> dict[str, Any]:
    """Fill a closed surface with tetrahedra and mark base, control points and grasp.

    Args:
        path: STL, PLY, OBJ or OFF.
        folder: The branch folder to make or renew.
        settings: How.
        force: Run even if nothing has changed.
        progress: Called as it goes; gets what the user should know.

    Raises:
        InputError: the surface cannot be read or is not that of one solid:
            :func:`limber.geometry.surface.input.usable_surface`.
        MeshingError: fTetWild failed.
    """
    from limber.constants import UNIT_METRES
    from limber.geometry.mesh_surface import mesh_body
    from limber.geometry.surface.input import usable_surface
    from limber.geometry.surface.surface import Surface

    settings = settings or MeshSurfaceSettings()
    surface, warnings = usable_surface(Surface.read(
        require_file(path, "A surface"), scale=UNIT_METRES[settings.unit]), path)
    branch = Branch.create(folder)
    digests = {"surface": file_digest(path)}
    if not force and branch.is_current("mesh", settings, digests=digests):
        return branch.manifest.stages["mesh"].result
    for text in warnings:
        progress.warn(text)
    with branch.stage("mesh", settings, digests=digests) as stage:
        made = mesh_body(surface, settings, progress)
        stage.manifest.alignment = made.alignment
        stage.manifest.source = {"file": Path(path).name, "unit": settings.unit,
                                 "sha256": digests["surface"]}
        made.skeleton.write_swc(stage.path("skeleton.swc"))
        made.surface.write_ply(stage.path("surface.ply"))
        made.mesh.write(stage.path("mesh.vtu"))
        for name in ("point_masses.json", "skeleton.csv"):
            stage.remove(name)  # of an earlier scan in this folder
        stage.result.update(made.numbers | {"warnings": warnings})
        progress(1.0, "meshed", tets=made.mesh.tet_count)
    return branch.manifest.stages["mesh"].result


def run(inputs: MeshInputs, settings: MeshSurfaceSettings, options: RunOptions,
        progress: Progress) -> dict[str, Any]:
    """Run the stage."""
    return mesh_surface(inputs.surface, inputs.output, settings, force=options.force,
                        progress=progress)


STAGE = StageDescription(
    "mesh", 30, run, MeshInputs, MeshSurfaceSettings, RunOptions, key="mesh",
    writes=("skeleton.swc", "surface.ply", "mesh.vtu"))
