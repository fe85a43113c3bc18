"""Scan to tetrahedra: skeleton, radii, surface, mesh."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from limber.alignment import Alignment
from limber.errors import Cancelled, InputError, LimberError, WorkError
from limber.files import file_digest, require_file
from limber.geometry.settings import ReconstructSettings
from limber.progress import SILENT, Progress
from limber.settings import Groups, Settings
from limber.stages.inputs import RunOptions, argument
from limber.stages.registry import StageDescription
from limber.store import Branch, Stage

if TYPE_CHECKING:
    from limber.geometry.reconstruct import Reconstruction


class ReconstructInputs(Settings):
    """A scan, what is known of it, and the branch folder to make."""

    groups: ClassVar[Groups] = {"input": ("cloud", "skeleton", "camera", "mask"),
                               "output": ("output",)}

    cloud: Path = argument("A point cloud file, or a folder of them: then each becomes a branch "
                           "folder in the output folder, and a bad one does not stop the others.")
    output: Path = Field(
        description="The branch folder to make; with a folder of scans, where to make them.",
        json_schema_extra={"short": "-o"})
    skeleton: Path | None = Field(
        None, description="Your own skeleton (SWC or cylinder CSV) in the cloud's coordinates.")
    camera: Path | None = Field(
        None, description="camera.toml: then CLOUD is a depth image.")
    mask: Path | None = Field(
        None, description="With --camera: an image that is over 0 on the branch.")


def reconstruct(cloud_path: Path, folder: Path, settings: ReconstructSettings | None = None, *,
                skeleton_path: Path | None = None, camera_path: Path | None = None,
                mask_path: Path | None = None, force: bool = False,
                progress: Progress = SILENT) -> dict[str, Any]:
    """Make a branch folder of a scan: skeleton, surface and tetrahedra.

    Args:
        cloud_path: The scan. A ``truth.json`` beside it (`limber generate`) is taken along.
        folder: The branch folder to make or renew.
        settings: How.
        skeleton_path: The user's own skeleton in the scan's coordinates and unit (SWC or
            cylinder CSV), instead of ours.
        camera_path: ``camera.toml``, if ``cloud_path`` is a depth image.
        mask_path: The depth image's mask of the branch.
        force: Run even if nothing has changed.
        progress: Called as it goes; gets what the user should know.

    Returns:
        The stage's result (DESIGN's keys and more).

    Raises:
        InputError: the scan, the skeleton or the folder cannot be used.
        WorkError: the work failed; the folder is as it was.
    """
    from limber.constants import UNIT_METRES
    from limber.geometry.cloud.depth_files import read_depth
    from limber.geometry.cloud.files import read_points
    from limber.geometry.reconstruct import reconstruct_cloud
    from limber.geometry.skeleton.files import read_skeleton

    settings = settings or ReconstructSettings()
    raw = read_points(cloud_path) if camera_path is None else read_depth(
        cloud_path, camera_path, mask_path)
    branch = Branch.create(folder)
    digests = {"cloud": file_digest(cloud_path)}
    for name, path in (("skeleton", skeleton_path), ("camera", camera_path), ("mask", mask_path)):
        if path is not None:
            digests[name] = file_digest(require_file(path, f"A {name} file"))
    if not force and branch.is_current("reconstruct", settings, digests=digests):
        return branch.manifest.stages["reconstruct"].result
    warnings: list[str] = []
    with branch.stage("reconstruct", settings, digests=digests) as stage:
        own = None if skeleton_path is None else read_skeleton(
            skeleton_path, scale=UNIT_METRES[settings.unit])
        made = reconstruct_cloud(raw, settings, own=own, eye=_eye(camera_path),
                                 progress=progress.keeping(warnings))
        stage.manifest.alignment = made.alignment
        stage.manifest.source = {"file": Path(cloud_path).name, "unit": settings.unit,
                                 "sha256": digests["cloud"]}
        _write(stage, made)
        if _copy_truth(Path(cloud_path), stage, made.alignment):
            stage.manifest.source["truth"] = "truth/truth.json"
        stage.result.update(made.numbers | {"warnings": warnings})
        progress(1.0, "reconstructed")
    return branch.manifest.stages["reconstruct"].result


def reconstruct_folder(clouds: Path, folder: Path, settings: ReconstructSettings | None = None, *,
                       force: bool = False, progress: Progress = SILENT) -> dict[str, Any]:
    """Reconstruct every cloud in a folder into ``folder/NAME.branch``.

    Args:
        clouds: The folder of scans; files of other kinds in it are passed over.
        folder: Where the branch folders go.
        settings: For all of them.
        force: Run even where nothing has changed.
        progress: Called as it goes; gets each scan's warnings, with its name, and each failure.

    Returns:
        ``done`` and ``failed``: name to result, name to message.

    Raises:
        InputError: there is no scan.
        WorkError: all of them failed.
    """
    from limber.geometry.cloud.files import READERS

    paths = sorted(p for p in Path(clouds).iterdir() if p.suffix.lower() in READERS)
    if not paths:
        raise InputError(f"{clouds} has no point clouds.",
                         f"Known are: {' '.join(sorted(READERS))}.", "Name another folder.")
    done: dict[str, Any] = {}
    failed: dict[str, str] = {}
    for number, path in enumerate(paths):
        part = progress.part(number / len(paths), (number + 1) / len(paths)).named(path.name)
        try:
            done[path.name] = reconstruct(path, Path(folder) / f"{path.stem}.branch", settings,
                                          force=force, progress=part)
        except Cancelled:
            raise
        except LimberError as error:
            failed[path.name] = str(error)
            part.warn(str(error))
    if not done:
        raise WorkError(f"None of the {len(paths)} scans could be reconstructed.",
                        next(iter(failed.values())), "See the warnings for each.")
    return {"done": done, "failed": failed, "done_count": len(done), "failed_count": len(failed)}


def _write(stage: Stage, made: Reconstruction) -> None:
    from limber.geometry.skeleton.files import write_cylinders

    meshed = made.meshed
    made.cloud.write_ply(stage.path("cloud.ply"))
    meshed.skeleton.write_swc(stage.path("skeleton.swc"))
    write_cylinders(meshed.skeleton, stage.path("skeleton.csv"))
    meshed.surface.write_ply(stage.path("surface.ply"))
    meshed.mesh.write(stage.path("mesh.vtu"))
    if meshed.masses:
        stage.path("point_masses.json").write_text(json.dumps(meshed.masses, indent=1) + "\n")
    else:
        stage.remove("point_masses.json")  # of an earlier run: its twigs are in the mesh now


def _eye(camera_path: Path | None) -> np.ndarray | None:
    """Where the depth image's camera stood [m], shape [3]."""
    if camera_path is None:
        return None
    from limber.geometry.cloud.camera import read_camera

    return read_camera(camera_path).origin


def _copy_truth(cloud_path: Path, stage: Any, alignment: Alignment) -> bool:
    """Take along the truth that `limber generate` wrote beside the cloud, in the branch's frame."""
    from limber.geometry.skeleton.skeleton import Skeleton
    from limber.geometry.surface.surface import Surface

    source = cloud_path.parent / "truth.json"
    skeleton_path = cloud_path.parent / "truth_skeleton.swc"
    if not (source.is_file() and skeleton_path.is_file()):
        return False
    truth = json.loads(source.read_text(encoding="utf-8"))
    if truth.get("cloud_sha256") != file_digest(cloud_path):
        return False
    skeleton = Skeleton.read_swc(skeleton_path)
    skeleton.moved(alignment.apply(skeleton.nodes)).write_swc(stage.path("truth/skeleton.swc"))
    truth["control_points_m"] = alignment.apply(np.array(truth["control_points_m"])).tolist()
    stage.path("truth/truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    surface_path = cloud_path.parent / "truth_surface.ply"
    if surface_path.is_file():
        surface = Surface.read(surface_path)
        Surface(alignment.apply(surface.vertices), surface.faces).write_ply(
            stage.path("truth/surface.ply"))
    else:
        stage.remove("truth/surface.ply")
    return True


def run(inputs: ReconstructInputs, settings: ReconstructSettings, options: RunOptions,
        progress: Progress) -> dict[str, Any]:
    """Run the stage."""
    if inputs.cloud.is_dir():
        return reconstruct_folder(inputs.cloud, inputs.output, settings, force=options.force,
                                  progress=progress)
    return reconstruct(inputs.cloud, inputs.output, settings, skeleton_path=inputs.skeleton,
                       camera_path=inputs.camera, mask_path=inputs.mask, force=options.force,
                       progress=progress)


STAGE = StageDescription(
    "reconstruct", 20, run, ReconstructInputs, ReconstructSettings, RunOptions, key="reconstruct",
    writes=("cloud.ply", "skeleton.swc", "skeleton.csv", "surface.ply", "mesh.vtu",
            "point_masses.json", "truth/"))
