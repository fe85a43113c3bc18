"""``limber mesh``: a closed surface to a branch folder."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.geometry.mesh_surface import MeshSurfaceSettings
from limber.stages.mesh import mesh_surface


@stage_command("mesh")
@click.argument("surface", type=click.Path(path_type=Path))
@click.option("-o", "--output", "folder", required=True, type=click.Path(path_type=Path),
              help="The branch folder to make.")
@click.option("--force", is_flag=True, help="Run again even if nothing has changed.")
@settings_options(MeshSurfaceSettings)
def command(run: Run, surface: Path, folder: Path, force: bool,
            settings: MeshSurfaceSettings) -> dict[str, Any]:
    """Closed surface (STL, PLY, OBJ) to tetrahedra."""
    return mesh_surface(surface, folder, settings, force=force, progress=run.progress)
