"""Stage ``reconstruct``, and what a branch folder keeps of it."""

from __future__ import annotations

import hashlib
import itertools
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import FOUND_SKELETON
from limber.core.errors import (
    Cancelled,
    Command,
    InputError,
    LimberError,
    Option,
    PartlyFailedError,
)
from limber.core.files.atomic import file_digest, replacing, require_file
from limber.core.files.safe_names import same_named
from limber.core.json_values import stored_lengths
from limber.core.machine_errors import machine_error
from limber.core.progress import SILENT, Progress
from limber.geometry.io.clouds import CLOUDS, read_points, unit_of
from limber.geometry.io.formats import head_of, listed, suffixes_of
from limber.geometry.io.skeletons import SKELETONS, read_skeleton, read_swc, write_cylinders
from limber.geometry.settings import ReconstructSettings
from limber.stages.shape.mesh import Meshed
from limber.stages.stage import About, Repeatable, argument, given, required
from limber.store import Branch, OpenStage
from limber.store.manifest import MANIFEST

if TYPE_CHECKING:
    from collections.abc import Sequence

    from limber.geometry.cloud.cloud import Cloud
    from limber.geometry.reconstruction import MeshedBranch
    from limber.geometry.skeleton.edits import Edit
    from limber.geometry.skeleton.search_result import FoundSkeleton
    from limber.geometry.skeleton.skeleton import Skeleton

SEARCH = f"{FOUND_SKELETON}.npz"
"""Result of the skeleton search, kept until there is a mesh: a reconstruct that is stopped in
between continues from it."""
CLASSES = "_points.ply"
"""End of the file, beside the folder of a refused scan, that shows its points by class."""
CLASSES_COMMENT = "limber: points of a refused scan by class"
"""Comment that distinguishes such a file from a scan."""
EDITS = "edits.json"
"""The edits that a branch keeps, in the coordinates of the scan's file."""


class Reconstruct(ReconstructSettings, Repeatable):
    """Reconstruct a scan: skeleton, radii, surface and tetrahedra."""

    about = About(
        "reconstruct", 20, Meshed, key="reconstruct",
        writes=("cloud.ply", "skeleton.swc", "skeleton.csv", "surface.ply", "mesh.vtu",
                "point_masses.json", f"{FOUND_SKELETON}.swc", f"{FOUND_SKELETON}.csv", SEARCH,
                EDITS, "truth/"),
        found=("{length_m:m} of centreline in {branch_count:#branch/branches}, radius "
               "{radius_min_m:m} to {radius_max_m:m}.",
               "{tet_count:count} tetrahedra.", "Volume {mesh_volume_m3:cm3}.",
               "{done_count:#scan/scans} reconstructed."),
        then="{tet_count:if}limber skeleton {output}", step="skeleton", label="Reconstruct")

    cloud: Path = argument(
        f"A point cloud file ({' '.join(suffixes_of(CLOUDS.readers()))}), or a folder of them: "
        "then each becomes a branch folder in the output folder, and a bad one does not stop the "
        "others.")
    output: Path = required(
        "The branch folder to make. With a folder of scans: where to make the branch folders.",
        "{stem}.branch", group="output", short="-o")
    without: Path | None = given(
        "A point cloud file of the points to leave out, in the cloud's coordinates, such as those "
        "that were deleted in Blender.")
    skeleton: Path | None = given(
        f"Your own skeleton in the cloud's coordinates: {listed(SKELETONS.readers())}.")
    edits: Path | None = given(
        "Edits of the skeleton (JSON, see `limber skeleton`). They stay in the branch folder, and "
        "each reconstruct without --skeleton applies them again.")
    camera: Path | None = given(
        "camera.toml of the depth camera; CLOUD is then a depth image.", common=True)
    mask: Path | None = given("With --camera: a mask image, greater than 0 on the branch.")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Make a branch folder from a scan: skeleton, surface and tetrahedra.

        The skeleton is stored in the scan's own coordinates as soon as it is found
        (``scan_skeleton.swc`` and ``.csv``), even if a later step fails or the program is killed.
        The next run with the same scan and settings continues from it. A ``truth.json`` beside the
        scan (`limber generate`) is copied too. Edits in the folder apply if the skeleton is not the
        user's own.

        Returns:
            DESIGN's keys and more; of a folder of scans ``done``, name to result, and
            ``done_count``.

        Raises:
            InputError: the scan, the skeleton or the folder cannot be used; there is no scan in a
                folder, or two would have one branch folder.
            WorkError: the work failed; the folder is unchanged except for the stored skeleton.
            PartlyFailedError: some scans of a folder failed; ``result`` also has ``failed``, name
                to message.
        """
        if not self.cloud.is_dir():
            return _of_scan(self, progress)
        one = [name for name in ("without", "skeleton", "edits", "camera", "mask")
               if getattr(self, name)]
        if one:
            raise InputError(f"{self.cloud} is a folder, and --{one[0]} was given.",
                             "That option applies to a single scan.",
                             "Reconstruct that scan by itself.")
        return _each_of_folder(self, progress)


def _of_scan(asked: Reconstruct, progress: Progress) -> dict[str, Any]:
    from limber.core.constants import UNIT_METRES
    from limber.geometry.io.depth_images import read_depth
    from limber.geometry.reconstruction import reconstruct_cloud
    from limber.geometry.skeleton.edits import edits_text, read_edits

    raw = read_points(asked.cloud) if asked.camera is None else read_depth(
        asked.cloud, asked.camera, asked.mask)
    unit, unit_notes = unit_of(raw, asked.unit)
    if unit != asked.unit:
        asked = asked.model_copy(update={"unit": unit})
    digests = {"cloud": file_digest(asked.cloud)}
    for name in ("skeleton", "camera", "mask", "without"):
        if (path := getattr(asked, name)) is not None:
            digests[name] = file_digest(require_file(path, f"A {name} file"))
    if asked.without is not None:
        raw = _without(raw, asked.without)
    entered = None if asked.edits is None else read_edits(asked.edits)
    branch = Branch.create(asked.output)
    if entered is not None:
        edits = entered
    else:
        edits = [] if asked.skeleton is not None else load_edits(branch)
    digests |= edits_digest(edits)
    if asked.is_kept(branch, digests=digests):
        return branch.manifest.stages["reconstruct"].result
    warnings: list[str] = []
    for text in (*raw.notes, *unit_notes):
        progress.keeping(warnings).warn(text)
    if asked.edits is None and not edits and branch.has(EDITS):
        progress.keeping(warnings).warn(
            "The edits in edits.json were not applied, because a skeleton was given.")
    searched = {name: value for name, value in digests.items() if name != "edits"}
    known = None if asked.force else load_search(branch, asked, searched,
                                                 progress.keeping(warnings))
    is_kept = known is not None

    def keep(alignment: Alignment, skeleton: Skeleton, found: FoundSkeleton) -> None:
        nonlocal is_kept
        with branch.stage("skeleton", asked, digests=searched) as early:
            _keep_skeleton(early, alignment, skeleton, asked.unit)
            found.write(early.path(SEARCH))
        is_kept = True

    def show(classes: Cloud) -> None:
        place = _place_of_classes(branch.folder)
        with replacing(place) as file:
            classes.write_ply(file, CLASSES_COMMENT)
        progress.warn(f"The points are coloured by class in {place}, in metres: wood brown, leaves "
                      "green, points on no round axis red, a pot grey, stakes, posts "
                      "and wires blue, another plant violet.")
    with branch.dropped_if_empty(), branch.stage("reconstruct", asked, digests=digests) as stage:
        own = None if asked.skeleton is None else read_skeleton(
            asked.skeleton, scale=UNIT_METRES[asked.unit], near=asked.root,
            progress=progress.keeping(warnings))
        try:
            made = reconstruct_cloud(raw, asked, own=own, edits=edits, eye=_eye(asked.camera),
                                     known=known, keep=keep, show=show,
                                     progress=progress.keeping(warnings))
        except LimberError as error:
            if is_kept and not isinstance(error, Cancelled):
                progress.warn(f"The skeleton as found is in {branch.folder / FOUND_SKELETON}.swc, "
                              "in the scan's coordinates. Correct it and return it (",
                              Option("skeleton"), "), or edit it (", Option("edits"), ").")
            raise
        stage.manifest.alignment = made.alignment
        stage.manifest.source = {"file": asked.cloud.name, "unit": asked.unit,
                                 "sha256": digests["cloud"]}
        write_branch(stage, made.cloud, made.meshed)
        stage.remove(SEARCH)
        if edits:
            stage.write(EDITS, edits_text(edits))
        elif asked.edits is not None:
            stage.remove(EDITS)
        if _copy_truth(asked.cloud, stage, made.alignment):
            stage.manifest.source["truth"] = "truth/truth.json"
        stage.result.update(made.numbers | {"warnings": warnings})
        progress(1.0, "reconstructed")
    return branch.manifest.stages["reconstruct"].result


def _each_of_folder(asked: Reconstruct, progress: Progress) -> dict[str, Any]:
    """Reconstruct every cloud in a folder into ``NAME.branch`` in the output, past hidden files and
    other kinds; warnings and failures name their scan."""
    known = suffixes_of(CLOUDS.readers())
    paths = sorted(p for p in asked.cloud.iterdir() if p.suffix.lower() in known
                   and not p.name.startswith(".") and not _shows_classes(p))
    if not paths:
        raise InputError(f"{asked.cloud} has no point clouds.", f"Known are: {' '.join(known)}.",
                         "Name another folder.")
    if clashes := same_named([path.stem for path in paths]):
        named = "; ".join(" and ".join(paths[index].name for index in group) for group in clashes)
        raise InputError(f"Scans of {asked.cloud} would have one branch folder: {named}.",
                         "A branch folder has the scan's name without its suffix, and many "
                         "systems do not distinguish upper and lower case. One would replace the "
                         "other.", "Rename these scans, or move copies of a scan elsewhere.")
    done: dict[str, Any] = {}
    failed: dict[str, str] = {}
    for number, path in enumerate(paths):
        part = progress.part(number / len(paths), (number + 1) / len(paths)).named(path.name)
        target = asked.output / f"{path.stem}.branch"
        try:
            if not asked.force:
                _require_same_scan(path, target)
            done[path.name] = _of_scan(asked.model_copy(update={
                "cloud": path, "output": target}), part)
            continue
        except Cancelled:
            raise
        except LimberError as error:
            failed[path.name] = str(error)
        except Exception as error:  # a bug costs this scan, not the others
            failed[path.name] = str(machine_error(error, target) or (
                f"internal error: {error!r}; please report it ({Command('bug-report')})."))
        part.warn(failed[path.name])
    result: dict[str, Any] = {"done": done, "done_count": len(done)}
    if failed:
        raise PartlyFailedError(
            f"{len(failed)} of {len(paths)} scans could not be reconstructed: "
            f"{', '.join(failed)}.", next(iter(failed.values())) if len(failed) == 1 else "",
            "The warnings state the reason for each; the others are done." if done
            else "The warnings state the reason for each.",
            result=result | {"failed": failed, "failed_count": len(failed)})
    return result


def _require_same_scan(scan: Path, target: Path) -> None:
    """Refuse to replace another scan's branch: equal names may be those of two plants."""
    if not (target / MANIFEST).is_file():
        return
    source = Branch.read(target, unfinished=True).manifest.source
    if source and source.get("sha256") != file_digest(scan):
        before = source.get("file", "another scan")
        raise InputError(
            f"{target} was made from {before}" + (
                ", and that file was not the same as this one." if before == scan.name
                else f", not from {scan.name}."),
            "It was kept: it may be another plant's.",
            "Choose another folder with -o. If it is the same plant, replace it with: limber "
            f"reconstruct {shlex.quote(str(scan))} -o {shlex.quote(str(target))}")


def _place_of_classes(folder: Path) -> Path:
    """Return where to show a refused scan's points by class: over no file of the user's."""
    name = folder.name.removesuffix(".branch")
    for number in itertools.count(1):
        place = folder.with_name(f"{name}{'' if number == 1 else f'-{number}'}{CLASSES}")
        if not place.exists() or _shows_classes(place):
            break
    return place


def _shows_classes(path: Path) -> bool:
    return path.name.endswith(CLASSES) and CLASSES_COMMENT.encode() in head_of(path, 1000)


def _without(cloud: Cloud, path: Path) -> Cloud:
    """Return a cloud without the points of a file; InputError if it has none of them, or all. Each
    leaves out the nearest point that single precision cannot distinguish from it, and all at that
    very place: no others, as map coordinates are so large that it cannot distinguish a whole
    plant's."""
    from scipy.spatial import cKDTree

    gone = read_points(path).points
    same = float(np.spacing(np.float32(np.abs(cloud.points).max())))
    far, nearest = cKDTree(cloud.points).query(gone, distance_upper_bound=2.0 * same)
    found = np.unique(nearest[np.isfinite(far)])
    keep = np.ones(len(cloud), bool)
    if len(found):
        keep = cKDTree(cloud.points[found]).query(cloud.points)[0] > 0
    if keep.all():
        raise InputError(f"None of the {len(gone)} points of {path} is in the cloud.",
                         "Points to leave out are given in the cloud's coordinates and unit.",
                         "Take them from that cloud file, or omit ", Option("without"), ".")
    if not keep.any():
        raise InputError(f"All {len(cloud)} points of the cloud are in {path}.", "Nothing would be "
                         "left.", "Leave out fewer points, or omit ", Option("without"), ".")
    return cloud.subset(keep)


def _keep_skeleton(stage: OpenStage, alignment: Alignment, skeleton: Skeleton, unit: str) -> None:
    """Write a skeleton in the coordinates and the unit of the scan's file."""
    in_file = skeleton.in_file(alignment)
    in_file.write_swc(stage.path(f"{FOUND_SKELETON}.swc"), unit=unit)
    write_cylinders(in_file, stage.path(f"{FOUND_SKELETON}.csv"))
    stage.result.update(node_count=skeleton.node_count, length_m=skeleton.length,
                        alignment=alignment)


def load_search(branch: Branch, settings: ReconstructSettings, digests: dict[str, str],
                progress: Progress = SILENT) -> FoundSkeleton | None:
    """Return the skeleton that an earlier run of this version found in a scan, if no mesh followed;
    a file that cannot be used counts as none, with a warning."""
    from limber.geometry.skeleton.search_result import FoundSkeleton
    from limber.store import program_versions

    entry = branch.manifest.stages.get("skeleton")
    if entry is None or not branch.has(SEARCH) or not branch.is_current(
            "skeleton", settings, digests=digests):
        return None
    if program_versions().items() - entry.programs.items():
        return None
    try:
        return FoundSkeleton.read(branch.path(SEARCH))
    except InputError as error:
        progress.warn(f"{error.seen} {error.why} The skeleton is searched for again.")
        return None


def write_branch(stage: OpenStage, cloud: Cloud, meshed: MeshedBranch) -> None:
    """Write the files of a branch that has been meshed."""
    cloud.with_points(stored_lengths(cloud.points)).write_ply(stage.path("cloud.ply"))
    meshed.skeleton.write_swc(stage.path("skeleton.swc"))
    write_cylinders(meshed.skeleton, stage.path("skeleton.csv"))
    meshed.surface.write_ply(stage.path("surface.ply"))
    meshed.mesh.write(stage.path("mesh.vtu"))
    if meshed.masses:
        stage.write("point_masses.json", meshed.masses)
    else:
        stage.remove("point_masses.json")  # from an earlier run: its twigs are in the mesh now


def load_edits(branch: Branch) -> list[Edit]:
    """Return the edits of its skeleton that a branch keeps; InputError if the file was changed by
    hand and is no longer valid."""
    from limber.geometry.skeleton.edits import read_edits

    return read_edits(branch.path(EDITS)) if branch.has(EDITS) else []


def edits_digest(edits: Sequence[Edit]) -> dict[str, str]:
    """Return the manifest's record of edits; empty if there are none."""
    from limber.geometry.skeleton.edits import edits_text

    return {"edits": hashlib.sha256(edits_text(edits).encode()).hexdigest()} if edits else {}


def _eye(camera_path: Path | None) -> np.ndarray | None:
    """Position of the depth image's camera [m], shape [3]."""
    if camera_path is None:
        return None
    from limber.geometry.cloud.camera import read_camera

    return read_camera(camera_path).origin


def _copy_truth(cloud_path: Path, stage: Any, alignment: Alignment) -> bool:
    """Copy the truth that `limber generate` wrote beside the cloud, in the branch's frame."""
    from limber.geometry.generated import read_truth
    from limber.geometry.surface.surface import Surface

    source = cloud_path.parent / "truth.json"
    skeleton_path = cloud_path.parent / "truth_skeleton.swc"
    if not (source.is_file() and skeleton_path.is_file()):
        return False
    truth = read_truth(source)
    if truth.get("cloud_sha256") != file_digest(cloud_path):
        return False
    skeleton = read_swc(skeleton_path)
    skeleton.moved(alignment.apply(skeleton.nodes)).write_swc(stage.path("truth/skeleton.swc"))
    truth["control_points_m"] = alignment.apply(np.array(truth["control_points_m"])).tolist()
    stage.write("truth/truth.json", truth)
    surface_path = cloud_path.parent / "truth_surface.ply"
    if surface_path.is_file():
        surface = Surface.read(surface_path)
        Surface(alignment.apply(surface.vertices), surface.faces).write_ply(
            stage.path("truth/surface.ply"))
    else:
        stage.remove("truth/surface.ply")
    return True
