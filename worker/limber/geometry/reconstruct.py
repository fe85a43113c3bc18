"""The stage `reconstruct`: a scan becomes a branch folder with skeleton, surface and mesh."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from limber.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.depth_files import read_depth
from limber.geometry.cloud.files import read_points
from limber.geometry.cloud.preparation import PreparationSettings, Prepared, prepare
from limber.geometry.skeleton.axis_fit import nearest_cylinders
from limber.geometry.skeleton.control_points import FRACTIONS
from limber.geometry.skeleton.files import UNIT_METRES, read_skeleton, write_cylinders
from limber.geometry.skeleton.silhouette import within_silhouette, without_hidden_twigs
from limber.geometry.skeleton.skeleton import CLAMPED, INTERPOLATED, Skeleton
from limber.geometry.skeleton.skeletonise import SkeletonResult, SkeletonSettings, skeletonise
from limber.geometry.skeleton.upright import upright_rotation
from limber.geometry.surface.forks import smooth_forks
from limber.geometry.surface.surface import Surface
from limber.geometry.surface.tubes import branch_surface
from limber.geometry.tets.marks import GRASP_FRACTION, mark
from limber.geometry.tets.quality import measure_quality
from limber.geometry.tets.tetrahedra import MeshResult, MeshSettings, mesh_branch
from limber.progress import SILENT, Progress
from limber.store import Alignment, Branch, file_digest

GRAVITY = 9.80665  # [m/s^2]


class ReconstructSettings(PreparationSettings, SkeletonSettings, MeshSettings):
    """Everything that decides what a scan becomes."""

    unit: Literal["m", "cm", "mm", "in"] = Field("m", description="Unit of the file.")
    up: tuple[float, float, float] = Field(
        (0.0, 0.0, 1.0), description="Which way is up in the file's axes.")
    root: tuple[float, float, float] | None = Field(
        None, description="A point near the root, in the file's coordinates; else the thick end.")
    upright: bool = Field(
        True, description="Turn the branch so that it grows along z; gravity is turned with it.")
    twig_radius: float = Field(
        0.0, ge=0, description="Leave out twigs thinner than that [m], keep their mass.")
    twig_order: int = Field(
        9, ge=0, le=9, description="Leave out twigs of a higher branching order, keep their mass.")
    young: float = Field(1e8, gt=0, description="Young's modulus to start from [Pa].")
    poisson: float = Field(0.35, ge=0, lt=0.5, description="Poisson's ratio.")
    density: float = Field(900.0, gt=0, description="Density of the living wood [kg/m^3].")
    grasp_fraction: float = Field(
        GRASP_FRACTION, gt=0, le=1, description="Where the branch is held, along its main path.")


def reconstruct(cloud_path: Path, folder: Path, settings: ReconstructSettings | None = None, *,
                skeleton_path: Path | None = None, camera_path: Path | None = None,
                mask_path: Path | None = None, force: bool = False,
                progress: Progress = SILENT, warn: Callable[[str], None] = lambda text: None,
                ) -> dict[str, Any]:
    """Make a branch folder of a scan: skeleton, surface and tetrahedra.

    Args:
        cloud_path: The scan. A ``truth.json`` beside it (`limber generate`) is taken along.
        folder: The branch folder to make or renew.
        settings: How.
        camera_path: ``camera.toml``, if ``cloud_path`` is a depth image.
        mask_path: The depth image's mask of the branch.
        skeleton_path: The user's own skeleton in the scan's coordinates and unit (SWC or
            cylinder CSV), instead of ours.
        force: Run even if nothing has changed.
        progress: Called as it goes.
        warn: Gets each thing that the user should know.

    Returns:
        The stage's result (DESIGN's keys and more).

    Raises:
        InputError: the scan, the skeleton or the folder cannot be used.
        WorkError: the work failed; the folder is as it was.
    """
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

    def tell(text: str) -> None:
        warnings.append(text)
        warn(text)

    with branch.stage("reconstruct", settings, digests=digests) as stage:
        prepared = prepare(raw, UNIT_METRES[settings.unit], settings, eye=_eye(camera_path))
        for text in prepared.warnings:
            tell(text)
        found = _skeleton(prepared, settings, skeleton_path, progress.part(0.02, 0.55))
        if prepared.view is not None and skeleton_path is None:
            found, text = seen_skeleton(found, prepared, settings.silhouette_reach)
            if text:
                tell(text)
        alignment, cloud, found = _aligned(prepared, found, settings)
        skeleton = found.skeleton
        for text in found.warnings:
            tell(text)
        stage.manifest.alignment = alignment
        stage.manifest.source = {"file": Path(cloud_path).name, "unit": settings.unit,
                                 "sha256": digests["cloud"]}
        up = np.array(settings.up) / np.linalg.norm(settings.up)
        gravity = -GRAVITY * np.array(alignment.rotation) @ up
        result = write_geometry(stage, skeleton, settings, tell, progress.part(0.55, 0.98))
        cloud.write_ply(stage.path("cloud.ply"))
        if _copy_truth(Path(cloud_path), stage, alignment):
            stage.manifest.source["truth"] = "truth/truth.json"
        stage.result.update(result | found.report() | {
            "point_count": len(cloud), "dropped_points": prepared.counts,
            "gravity_m_s2": gravity, "warnings": warnings})
        progress(1.0, "reconstructed")
    return branch.manifest.stages["reconstruct"].result


def write_geometry(stage: Any, skeleton: Skeleton, settings: ReconstructSettings,
                   warn: Callable[[str], None], progress: Progress) -> dict[str, Any]:
    """Write skeleton, surface and mesh of an aligned skeleton; return their numbers."""
    kept, masses = leave_out_twigs(skeleton, settings)
    surface, check, sharp = smooth_forks(branch_surface(kept), kept)
    check.require()
    for text in sharp:
        warn(text)
    progress(0.1, "surface", faces=len(surface.faces))
    meshed = mesh_branch(kept, settings, progress=progress.part(0.1, 0.9))
    for text in meshed.warnings:
        warn(text)
    masses += [twig_mass(kept, run, settings.density) for run in meshed.left_out]
    mesh = mark(meshed.mesh, kept, young=settings.young, poisson=settings.poisson,
                density=settings.density, fractions=FRACTIONS,
                grasp_fraction=settings.grasp_fraction)
    skeleton.write_swc(stage.path("skeleton.swc"))
    write_cylinders(skeleton, stage.path("skeleton.csv"))
    surface.write_ply(stage.path("surface.ply"))
    mesh.write(stage.path("mesh.vtu"))
    if masses:
        stage.path("point_masses.json").write_text(json.dumps(masses, indent=1) + "\n")
    else:
        stage.remove("point_masses.json")  # of an earlier run: its twigs are in the mesh now
    progress(1.0, "mesh", tets=mesh.tet_count)
    return _numbers(skeleton, surface, check.as_dict(), meshed, kept) | {
        "left_out_mass_kg": sum(m["mass_kg"] for m in masses), "left_out_twigs": len(masses)}


def _numbers(skeleton: Skeleton, surface: Surface, check: dict[str, Any], meshed: MeshResult,
             kept: Skeleton) -> dict[str, Any]:
    quality = measure_quality(meshed.mesh, surface.volume, kept, surface)
    return {
        "node_count": skeleton.node_count, "branch_count": skeleton.branch_count,
        "length_m": skeleton.length, "main_length_m": float(
            skeleton.arc_length[skeleton.main_path()[-1]]),
        "radius_min_m": float(skeleton.radius.min()), "radius_max_m": float(skeleton.radius.max()),
        "radius_sigma_median_m": float(np.median(skeleton.radius_sigma)),
        "clamped_radius_count": int((skeleton.radius_state == CLAMPED).sum()),
        "interpolated_radius_count": int((skeleton.radius_state == INTERPOLATED).sum()),
        "surface_volume_m3": surface.volume, "mesh_volume_m3": quality.volume_m3,
        "tet_count": meshed.mesh.tet_count, "mesh_node_count": meshed.mesh.node_count,
        "mesher": meshed.mesher, "watertight": check["watertight"], "surface_check": check,
        "mesh_quality": quality.as_dict(), "peak_memory_mb": peak_memory_mb()}


def leave_out_twigs(skeleton: Skeleton, settings: ReconstructSettings,
                    ) -> tuple[Skeleton, list[dict[str, Any]]]:
    """Cut off thin or high-order side twigs; their mass stays, at their place.

    Returns:
        The skeleton to mesh, and for each twig cut off ``mass_kg``, its ``centre_m`` and
        ``attached_m``, the point on the kept axis that carries it.
    """
    keep = np.ones(skeleton.node_count, bool)
    masses: list[dict[str, Any]] = []
    for run, members in enumerate(skeleton.runs()[1:], start=1):
        own = members[1:]
        carried = not keep[members[0]]
        thin = float(np.median(skeleton.radius[own])) < settings.twig_radius
        if not (carried or thin or skeleton.order[own[0]] > settings.twig_order):
            continue
        keep[own] = False
        masses.append(twig_mass(skeleton, run, settings.density, keep))
    return (skeleton, []) if keep.all() else (skeleton.subset(keep), masses)


def twig_mass(skeleton: Skeleton, run: int, density: float, keep: np.ndarray | None = None,
              ) -> dict[str, Any]:
    """Return mass [kg], centre and place of attachment [m] of a run that is not meshed."""
    members = skeleton.runs()[run]
    own, base = members[1:], members[0]
    while keep is not None and not keep[base]:
        base = skeleton.parent[base]
    up = skeleton.parent[own]
    length = np.linalg.norm(skeleton.nodes[own] - skeleton.nodes[up], axis=1)
    volume = np.pi * skeleton.radius[own]**2 * length
    centre = np.average((skeleton.nodes[own] + skeleton.nodes[up]) / 2, axis=0,
                        weights=np.maximum(volume, 1e-300))
    return {"mass_kg": float(density * volume.sum()), "centre_m": centre.tolist(),
            "attached_m": skeleton.nodes[base].tolist(), "branch": run}


def peak_memory_mb() -> float:
    """Most memory that this process has held [MB]."""
    try:
        import resource
    except ImportError:  # Windows
        import psutil

        return psutil.Process().memory_info().peak_wset / 1e6
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def seen_skeleton(found: SkeletonResult, prepared: Prepared, reach: float,
                  ) -> tuple[SkeletonResult, str]:
    """Hold a skeleton against the depth camera's image: twigs and radii; and what to tell.

    Args:
        found: The skeleton of the cloud.
        prepared: The cloud, and where it was seen from.
        reach: ``silhouette_reach`` of the settings.
    """
    skeleton, dropped = without_hidden_twigs(found.skeleton, prepared.view, reach)
    skeleton, clamped = within_silhouette(skeleton, prepared.cloud.points, prepared.view)
    if not (dropped or clamped):
        return found, ""
    node, residual = nearest_cylinders(skeleton, prepared.cloud.points)
    text = ""
    if dropped:
        longest = max(twig["length"] for twig in dropped)
        text = (f"{len(dropped)} twigs (up to {1000 * longest:.0f} mm) were dropped: in the depth "
                "camera's image they do not leave their carrier, so they may be noise of its "
                "depth (--silhouette-reach).")
    return replace(found, skeleton=skeleton, node_of_point=node, residual=residual,
                   pruned=found.pruned + len(dropped)), text


def _eye(camera_path: Path | None) -> np.ndarray | None:
    """Where the depth image's camera stood [m], shape [3]."""
    if camera_path is None:
        return None
    from limber.perception.camera import read_camera

    return read_camera(camera_path).origin


def _skeleton(prepared: Prepared, settings: ReconstructSettings, skeleton_path: Path | None,
              progress: Progress) -> SkeletonResult:
    scale = UNIT_METRES[settings.unit]
    if skeleton_path is not None:
        from limber.geometry.skeleton.skeletonise import given_skeleton

        own = read_skeleton(skeleton_path, scale=scale)
        if (own.radius <= 0).any():
            raise InputError(
                f"{int((own.radius <= 0).sum())} of {own.node_count} nodes of {skeleton_path} have "
                "radius 0.", "A branch has a thickness.",
                "Give each node its radius, or reconstruct from the cloud instead.")
        size = np.linalg.norm(np.ptp(own.nodes, axis=0))
        extent = np.linalg.norm(np.ptp(prepared.cloud.points, axis=0))
        if size > 10 * extent:
            raise InputError(
                f"The skeleton is {size:.3g} m wide, the cloud {extent:.3g} m.",
                "They do not belong together, or are in different units.",
                "Give the skeleton in the cloud's coordinates and unit (--unit is for both).")
        return given_skeleton(own.moved(own.nodes - prepared.origin), prepared.cloud.points)
    root = None if settings.root is None else np.array(settings.root) * scale - prepared.origin
    return skeletonise(prepared.cloud.points, settings, root=root, up=np.array(settings.up),
                       progress=progress)


def _aligned(prepared: Prepared, found: SkeletonResult, settings: ReconstructSettings,
             ) -> tuple[Alignment, Cloud, SkeletonResult]:
    """Move the root to the origin and turn the branch upright."""
    root = found.skeleton.nodes[0]
    rotation = upright_rotation(found.skeleton, np.array(settings.up), settings.upright)
    attributes = dict(prepared.cloud.attributes)
    if "normal" in attributes:
        attributes["normal"] = (attributes["normal"] @ rotation.T).astype(np.float32)
    attributes["skeleton_node"] = found.node_of_point.astype(np.int32)
    attributes["residual"] = found.residual.astype(np.float32)
    cloud = Cloud((prepared.cloud.points - root) @ rotation.T, attributes)
    alignment = Alignment(scale=UNIT_METRES[settings.unit],
                          origin=tuple((prepared.origin + root).tolist()),
                          rotation=tuple(map(tuple, rotation.tolist())))
    return alignment, cloud, found.moved(lambda points: (points - root) @ rotation.T)


def _copy_truth(cloud_path: Path, stage: Any, alignment: Alignment) -> bool:
    """Take along the truth that `limber generate` wrote beside the cloud, in the branch's frame."""
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


def require_file(path: Path, what: str) -> Path:
    """Return ``path`` if it is a file.

    Raises:
        InputError: it is not.
    """
    if not Path(path).is_file():
        raise InputError(f"There is no file {path}.", f"{what} was expected.", "Check the path.")
    return Path(path)
