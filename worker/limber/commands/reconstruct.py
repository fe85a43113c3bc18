"""``limber reconstruct``: a scan to a branch folder."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.geometry.reconstruct import ReconstructSettings
from limber.stages.reconstruct import reconstruct, reconstruct_folder


@stage_command("reconstruct")
@click.argument("cloud", type=click.Path(path_type=Path))
@click.option("-o", "--output", "folder", required=True, type=click.Path(path_type=Path),
              help="The branch folder to make; with a folder of scans, where to make them.")
@click.option("--skeleton", "skeleton_path", type=click.Path(path_type=Path),
              help="Your own skeleton (SWC or cylinder CSV) in the cloud's coordinates.")
@click.option("--camera", "camera_path", type=click.Path(path_type=Path),
              help="camera.toml: then CLOUD is a depth image.")
@click.option("--mask", "mask_path", type=click.Path(path_type=Path),
              help="With --camera: an image that is over 0 on the branch.")
@click.option("--force", is_flag=True, help="Run again even if nothing has changed.")
@settings_options(ReconstructSettings)
def command(run: Run, cloud: Path, folder: Path, skeleton_path: Path | None,
            camera_path: Path | None, mask_path: Path | None, force: bool,
            settings: ReconstructSettings) -> dict[str, Any]:
    """Scan to tetrahedra: skeleton, radii, surface, mesh.

    CLOUD is a point cloud file, or a folder of them: then each becomes a branch folder in the
    output folder, and a bad one does not stop the others.
    """
    if cloud.is_dir():
        return reconstruct_folder(cloud, folder, settings, force=force, progress=run.progress)
    return reconstruct(cloud, folder, settings, skeleton_path=skeleton_path,
                       camera_path=camera_path, mask_path=mask_path, force=force,
                       progress=run.progress)
