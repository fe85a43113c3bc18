"""From a scan to tetrahedra: skeleton, surface and mesh of a branch, in its own frame."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import GRAVITY, STANDARD_GRAVITY, UNIT_METRES
from limber.core.errors import InputError, Option, places_moved
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.leaves import Leaf
from limber.geometry.cloud.preparation import Prepared, prepare, size_doubts
from limber.geometry.cloud.surroundings import (
    Part,
    find_supports,
    named_if_refused,
    supports_text,
)
from limber.geometry.leaf_removal import (
    check_agreed,
    cut_off,
    leaf_mask,
    leaf_masses,
    leafy_spread,
    leaves_text,
    point_odds,
    show_leaves,
    without_leaves,
)
from limber.geometry.pruned_twigs import (
    leave_out_twigs,
    report_pruned_twigs,
    touching_runs,
    touching_texts,
    twig_mass,
)
from limber.geometry.settings import ESTIMATORS, OPEN, BodySettings, ReconstructSettings
from limber.geometry.skeleton.alternatives import alternatives, entries
from limber.geometry.skeleton.assumed_modulus import assumed_young
from limber.geometry.skeleton.edits import Edit, SetRoot, edited
from limber.geometry.skeleton.plausibility import (
    RESOLVED,
    check_explained,
    off_axes,
    root_question,
    surface_share,
    surface_text,
    unexplained_share,
    without_volumes,
)
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.radii.projected_widths import without_hidden_twigs
from limber.geometry.skeleton.search_result import FoundSkeleton, SkeletonResult, result_of_skeleton
from limber.geometry.skeleton.skeleton import (
    INTERPOLATED,
    LIMITED,
    Skeleton,
    upright_rotation,
)
from limber.geometry.skeleton.skeletonise import SEARCHED, Apart, skeletonise
from limber.geometry.surface.surface import Surface, check_surface
from limber.geometry.surface.tubes import branch_surface
from limber.geometry.tets.tet_mesh import TetMesh, mark, measure_quality
from limber.geometry.tets.tetrahedra import mesh_branch

# The classes of a refused scan's points, as a coloured cloud to look at.

COLOURS = {"wood": (139, 90, 43), "leaf": (60, 170, 60), "on no round axis": (220, 40, 40),
           "pot": (150, 150, 150), "stake": (60, 110, 230), "post": (30, 50, 140),
           "wire": (90, 200, 230), "another plant": (170, 90, 200)}
"""Red, green and blue of each class; its place is the value of the column ``class``."""

Show = Callable[[Cloud], None]
"""Receives the coloured cloud: metres, with the axes and the origin of the scan's file."""


@contextmanager
def shown_if_refused(show: Show | None, prepared: Prepared, leaves: list[Leaf],
                     supports: list[Part], off_axes: np.ndarray | None = None,
                     ) -> Iterator[None]:
    """Show the points by class if what is done meanwhile refuses the scan; None: nobody looks.
    ``off_axes`` [rest] says which points of no leaf or support are on no round axis."""
    try:
        yield
    except InputError:
        if show is not None:
            show(classified(prepared, leaves, supports, off_axes))
        raise


def classified(prepared: Prepared, leaves: list[Leaf], supports: list[Part],
               off_axes: np.ndarray | None = None, apart: np.ndarray | None = None) -> Cloud:
    """Return the points with columns ``class`` and ``color``, see :func:`shown_if_refused`.
    ``apart`` [n] says which of them belong to another plant."""
    kind = leaf_mask(leaves, len(prepared.cloud)).astype(np.uint8)
    if off_axes is not None:
        kind[np.flatnonzero(kind == 0)[off_axes]] = 2
    for support in supports:
        kind[support.points] = list(COLOURS).index(support.kind)
    if apart is not None:
        kind[apart] = list(COLOURS).index("another plant")
    colour = np.array(list(COLOURS.values()), np.uint8)
    return Cloud(prepared.cloud.points + prepared.origin, {"color": colour[kind], "class": kind})


Keep = Callable[[Alignment, Skeleton, FoundSkeleton], None]
"""Receives a skeleton as found, and the full result of the search for it."""

_OWN_COLUMNS = ("skeleton_node", "residual", "leaf")  # columns of cloud.ply that Limber writes
# A twig is kept if, as seen by a depth camera, it reaches this many radii beyond its parent's axis.
_SILHOUETTE_REACH = 1.5
_LEAVES_ASKED = 0.2  # fraction of points on no round axis above which leaves are searched for


@dataclass(frozen=True)
class MeshedBranch:
    """Surface and tetrahedra of an aligned skeleton, which has the pruned twigs too; ``masses`` are
    theirs, see :func:`leave_out_twigs`. ``mesh`` has material, base, control points and grasp."""

    skeleton: Skeleton
    surface: Surface
    mesh: TetMesh
    masses: list[dict[str, Any]]
    numbers: dict[str, Any]


@dataclass(frozen=True)
class Reconstruction:
    """Result of reconstructing a scan.

    Attributes:
        alignment: From the scan's coordinates to the branch's.
        cloud: The prepared scan in the branch's frame.
        meshed: Skeleton, surface and tetrahedra.
        gravity: Gravity [m/s^2] in the branch's frame, shape [3].
        numbers: The stage's result.
    """

    alignment: Alignment
    cloud: Cloud
    meshed: MeshedBranch
    gravity: np.ndarray
    numbers: dict[str, Any]


def reconstruct_cloud(raw: Cloud, settings: ReconstructSettings, *, own: Skeleton | None = None,
                      edits: Sequence[Edit] = (), eye: np.ndarray | None = None,
                      known: FoundSkeleton | None = None, keep: Keep | None = None,
                      show: Show | None = None, progress: Progress = SILENT) -> Reconstruction:
    """Make skeleton, surface and tetrahedra of a scan.

    Args:
        raw: The scan, in the file's unit.
        settings: Settings to use.
        own: The user's own skeleton in the scan's frame [m], instead of ours.
        edits: Changes of the user to the skeleton, in the file's coordinates; those that no longer
            fit are skipped and reported.
        eye: Position of the depth camera [m], shape [3], if the scan is its image.
        known: Result of an earlier run on this scan with these settings that was not used
            further; where it does not fit the scan, it counts as none.
        keep: Receives the alignment, the skeleton and the result of the search as soon as found,
            before later steps that may fail or refuse it; not called for ``known``.
        show: Receives the points by class if the scan is refused for some of them.
        progress: Called during the work; receives warnings for the user.

    Raises:
        InputError: the scan or the skeleton cannot be used. WorkError: the work failed.
    """
    raw = raw.with_valid_columns(_OWN_COLUMNS)
    prepared = prepare(raw, UNIT_METRES[settings.unit], settings, eye=eye,
                       up=np.array(settings.up, float))
    prepared.warnings[:0] = size_doubts(
        prepared.cloud.points, "scan", settings.unit,
        is_stated=raw.unit is not None or "unit" in settings.model_fields_set)
    for text in prepared.warnings:
        progress.warn(text)
    parts = [] if own is not None else find_supports(prepared.cloud.points,
                                                     np.array(settings.up, float))
    supports = [each for each in parts if each.probability >= OPEN]
    if known is not None and not known.fits(len(prepared.cloud)):
        progress.warn("The skeleton that an earlier run stored belongs to another number of "
                      "points. It is searched for again.")
        known = None
    named = "" if not parts else supports_text(
        parts, prepared.cloud.points).moved(prepared.outside)
    with named_if_refused(named), places_moved(prepared.outside):
        found, wood, leaves = (
            _searched(prepared, settings, own, supports, show, progress.part(0.02, 0.55))
            if known is None else _found_before(prepared, known, progress))
    whole = found
    # The search of a thin scan has asked of each twig whether the sensor shows it.
    if wood.view is not None and own is None and len(wood.cloud) > SEARCHED:
        found, text = seen_skeleton(found, wood)
        if text:
            progress.warn(text)
    alignment, cloud, found = _aligned(wood, found, settings)
    if own is None and settings.radii != "fit":
        estimate = ESTIMATORS.named(settings.radii)
        found = replace(found, skeleton=estimate(found.skeleton, cloud.points, settings))
        cloud = labelled(cloud, found.skeleton)
    # Nothing is written before the user has answered: an earlier result stays whole.
    is_open = found.root_probability < OPEN and settings.root is None and not any(
        isinstance(edit, SetRoot) for edit in edits)
    if keep is not None and known is None and not is_open:
        keep(alignment, found.skeleton, FoundSkeleton(whole, leaves))
    share = 1.0  # who gives a skeleton states its radii
    if own is None:
        with (named_if_refused(named), places_moved(prepared.outside),
              shown_if_refused(show, prepared, leaves, supports, off_axes(whole))):
            check_explained(whole, _most_off(whole, settings, supports), wood.cloud.points,
                            lambda off: bool(supports) or (
                                settings.leaves != "keep" and show_leaves(wood, off)))
            share = surface_share(whole.skeleton, whole.node_of_point, whole.residual)
        if is_open:
            raise root_question(found.moved(alignment.undo).root_ends)
    # Kept apart from the mesh's warnings, which are made again after edits of the skeleton.
    warnings = list(prepared.warnings)
    if named:
        warnings.append(named)
        progress.warn(named)
    texts = found.moved(alignment.undo).warnings
    if share < RESOLVED:
        texts.append(surface_text(share))
    for text in texts:
        warnings.append(text)
        progress.warn(text)
    if edits:
        found = _edited(found, [edit.aligned(alignment) for edit in edits], progress)
        cloud = labelled(cloud, found.skeleton)
    gravity = gravity_after(alignment, settings.up)
    meshed = mesh_skeleton(found.skeleton, settings, gravity, progress.part(0.55, 0.98))
    hung: list[dict[str, Any]] = []
    if leaves:
        cloud = _with_leaves(prepared, leaves, alignment, found.skeleton)
        hung = leaf_masses(leaves, cloud.points, found.skeleton)
        meshed = replace(meshed, masses=[*meshed.masses, *hung])
        warnings.append(leaves_text(hung, float(cloud.attributes["leaf"].mean())))
        progress.warn(warnings[-1])
    graphs = alternatives(found.skeleton, found.doubts)
    numbers = meshed.numbers | found.report() | {
        "alternatives": entries(graphs, lambda edit: edit.in_file(alignment)),
        "leaf_count": len(hung), "leaf_mass_kg": sum(leaf["mass_kg"] for leaf in hung),
        "leaf_area_m2": sum(leaf["area_m2"] for leaf in hung),
        "point_count": len(cloud), "dropped_points": prepared.counts, "gravity_m_s2": gravity,
        "skeleton_warnings": warnings} | without_volumes(share)
    return Reconstruction(alignment, cloud, meshed, gravity, numbers)


def _searched(prepared: Prepared, settings: ReconstructSettings, own: Skeleton | None,
              supports: list[Part], show: Show | None, progress: Progress,
              ) -> tuple[SkeletonResult, Prepared, list[Leaf]]:
    """The skeleton, the part of the scan in which it was found, and the leaves removed from it."""
    def show_apart(apart: np.ndarray) -> None:
        if show is not None:
            show(classified(prepared, [], supports, apart=apart))

    found = _skeleton(prepared, settings, own, progress, show_apart)
    # Of few points, trees of wood and of leaves were compared: that decides.
    if own is not None or settings.leaves == "keep" or found.length_spread is not None or not (
            _may_be_leafy(found, prepared, settings)):
        return found, prepared, []
    odds = point_odds(prepared.cloud.points)
    wood, leaves = without_leaves(prepared, found, supports, odds)
    if settings.leaves == "ask":
        with shown_if_refused(show, prepared, leaves, supports):
            check_agreed(prepared, leaves)
    if not leaves:
        return found, prepared, []
    bare = _skeleton(wood, settings, own, progress.part(0.55, 1.0))
    spread = float(np.hypot(leafy_spread(odds, leaves), bare.length_spread or 0.0))
    return replace(bare, length_spread=spread), wood, leaves


def _most_off(found: SkeletonResult, settings: ReconstructSettings, supports: list[Part],
              ) -> float:
    """Fraction of points off all axes up to which a scan is accepted."""
    # Who keeps the leaves has answered for the points beside axes that go through them.
    answered = settings.leaves == "keep" and found.leafy and not supports
    return 1.0 if answered else settings.unexplained


def _found_before(prepared: Prepared, known: FoundSkeleton, progress: Progress,
                  ) -> tuple[SkeletonResult, Prepared, list[Leaf]]:
    wood, leaves = cut_off(prepared, known.leaves)
    progress(0.55, "skeleton of an earlier run")
    return known.result, wood, leaves


def labelled(cloud: Cloud, skeleton: Skeleton) -> Cloud:
    """Return a cloud with the node of each point and the distance from its surface [m]."""
    node, residual = nearest_cylinders(skeleton, cloud.points)
    return replace(cloud, attributes=cloud.attributes | {
        "skeleton_node": node.astype(np.int32), "residual": residual.astype(np.float32)})


def _may_be_leafy(found: SkeletonResult, prepared: Prepared, settings: ReconstructSettings) -> bool:
    """Whether so many points are on no round axis that leaves are searched for, even in a scan that
    would be accepted: leaves thicken axes until half of the points count as wood. Scatter of a
    depth camera has this effect without a leaf; 3 mm of noise at 3 mm radius leaves 15 % off."""
    if found.leafy or (prepared.view is None and unexplained_share(found) > min(
            settings.unexplained, _LEAVES_ASKED)):
        return True
    return float(np.mean(off_axes(found))) > settings.unexplained


def _with_leaves(prepared: Prepared, leaves: list[Leaf], alignment: Alignment, skeleton: Skeleton,
                 ) -> Cloud:
    """The whole aligned scan, with ``leaf`` 1 where its points are on leaves."""
    turn = np.array(alignment.rotation)
    points = alignment.apply((prepared.cloud.points + prepared.origin) / alignment.scale)
    attributes = dict(prepared.cloud.attributes)
    if "normal" in attributes:
        attributes["normal"] = (attributes["normal"] @ turn.T).astype(np.float32)
    attributes["leaf"] = leaf_mask(leaves, len(points)).astype(np.uint8)
    return labelled(replace(prepared.cloud, points=points, attributes=attributes), skeleton)


def _edited(found: SkeletonResult, edits: Sequence[Edit], progress: Progress) -> SkeletonResult:
    misfits: list[str] = []
    skeleton = edited(found.skeleton, edits, misfits)
    for text in misfits:
        progress.warn(f"{text} The edit was skipped.")
    return replace(found, skeleton=skeleton)


def gravity_after(alignment: Alignment, up: tuple[float, float, float]) -> np.ndarray:
    """Return gravity [m/s^2] in the branch's frame; ``up`` is up in the file's axes."""
    unit = np.array(up) / np.linalg.norm(up)
    return -STANDARD_GRAVITY * np.array(alignment.rotation) @ unit


def marked(mesh: TetMesh, skeleton: Skeleton, settings: BodySettings,
           gravity: Sequence[float] | np.ndarray) -> TetMesh:
    """Return the mesh with the settings' material and grasp; Young's modulus is assumed if it is
    not stated, for ``gravity`` [m/s^2]."""
    return mark(mesh, skeleton, poisson=settings.poisson, density=settings.density,
                young=settings.young or assumed_young(skeleton, settings.density, gravity),
                grasp_fraction=settings.grasp_fraction)


def mesh_skeleton(skeleton: Skeleton, settings: ReconstructSettings,
                  gravity: Sequence[float] | np.ndarray = GRAVITY,
                  progress: Progress = SILENT) -> MeshedBranch:
    """Make surface and mesh of an aligned skeleton, under ``gravity`` [m/s^2]."""
    kept, masses = leave_out_twigs(skeleton, settings)
    surface = branch_surface(kept)
    check = check_surface(surface).require().as_dict()
    progress(0.1, "surface", faces=len(surface.faces))
    meshed = mesh_branch(kept, settings, progress=progress.part(0.1, 0.9))
    for text in meshed.warnings:
        progress.warn(text)
    masses += [twig_mass(kept, run, settings.density) for run in meshed.left_out]
    report_pruned_twigs(masses, float(meshed.mesh.volumes.sum()) * settings.density, settings,
                        progress)
    touching = touching_runs(kept)
    for text in touching_texts(surface.handle_count, touching):
        progress.warn(text)
    mesh = marked(meshed.mesh, kept, settings, gravity)
    progress(1.0, "mesh", tets=mesh.tet_count)
    numbers = numbers_of(skeleton, surface, meshed.mesh, meshed.mesher, kept) | {
        "watertight": check["watertight"], "surface_check": check,
        "radius_sigma_median_m": float(np.median(skeleton.radius_sigma)),
        "interpolated_radius_count": int((skeleton.radius_state == INTERPOLATED).sum()),
        "left_out_mass_kg": sum(m["mass_kg"] for m in masses), "left_out_twigs": len(masses),
        "surface_handles": surface.handle_count, "touching": touching}
    return MeshedBranch(skeleton, surface, mesh, masses, numbers)


def numbers_of(skeleton: Skeleton, surface: Surface, mesh: TetMesh, mesher: str,
               kept: Skeleton) -> dict[str, Any]:
    """Result of the stage for a mesh of the ``kept`` part of a skeleton."""
    quality = measure_quality(mesh, surface.volume, kept, surface)
    return {
        "node_count": skeleton.node_count, "branch_count": skeleton.branch_count,
        "length_m": skeleton.length, "main_length_m": float(
            skeleton.arc_length[skeleton.main_path()[-1]]),
        "radius_min_m": float(skeleton.radius.min()), "radius_max_m": float(skeleton.radius.max()),
        "clamped_radius_count": int((skeleton.radius_state == LIMITED).sum()),
        "surface_volume_m3": surface.volume, "mesh_volume_m3": quality.volume_m3,
        "tet_count": mesh.tet_count, "mesh_node_count": mesh.node_count, "mesher": mesher,
        "watertight": True, "mesh_quality": quality.as_dict(), "peak_memory_mb": peak_memory_mb()}


def peak_memory_mb() -> float:
    """Peak memory of this process [MB]."""
    try:
        import resource
    except ImportError:  # Windows
        import psutil

        return psutil.Process().memory_info().peak_wset / 1e6
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


def seen_skeleton(found: SkeletonResult, prepared: Prepared) -> tuple[SkeletonResult, str]:
    """Drop twigs that do not extend beyond their parent in the depth camera's image; also return a
    warning, empty if there are none."""
    view = present(prepared.view, "view")
    skeleton, dropped = without_hidden_twigs(found.skeleton, view, _SILHOUETTE_REACH)
    node, residual = nearest_cylinders(skeleton, prepared.cloud.points)
    text = ""
    if dropped:
        longest = max(twig["length"] for twig in dropped)
        text = (f"{len(dropped)} twigs (up to {1000 * longest:.0f} mm) were discarded. In the "
                "depth camera's image they do not extend beyond their parent, so they may be "
                "depth noise.")
    return replace(found, skeleton=skeleton, node_of_point=node, residual=residual,
                   pruned=found.pruned + len(dropped)), text


def _skeleton(prepared: Prepared, settings: ReconstructSettings, own: Skeleton | None,
              progress: Progress, show_apart: Apart | None = None) -> SkeletonResult:
    if own is not None:
        if (own.radius <= 0).any():
            raise InputError(
                f"{int((own.radius <= 0).sum())} of {own.node_count} nodes of the given skeleton "
                "have radius 0.", "A branch has a thickness.",
                "Give each node its radius, or reconstruct from the cloud instead.")
        size = np.linalg.norm(np.ptp(own.nodes, axis=0))
        extent = np.linalg.norm(np.ptp(prepared.cloud.points, axis=0))
        if size > 10 * extent:
            raise InputError(f"The skeleton is {size:.3g} m wide, but the cloud is {extent:.3g} m "
                             "wide.", "They do not belong together, or have different units.",
                             "Give the skeleton in the coordinates and the unit of the cloud (",
                             Option("unit"), " applies to both).")
        return result_of_skeleton(own.moved(own.nodes - prepared.origin), prepared.cloud.points)
    scale = UNIT_METRES[settings.unit]
    root = None if settings.root in (None, "auto") else (
        np.array(settings.root) * scale - prepared.origin)
    return skeletonise(prepared.cloud.points, settings, root=root, up=np.array(settings.up),
                       view=prepared.view, progress=progress, show_apart=show_apart)


def _aligned(prepared: Prepared, found: SkeletonResult, settings: ReconstructSettings,
             ) -> tuple[Alignment, Cloud, SkeletonResult]:
    """Move the root to the origin and rotate the branch upright."""
    root = found.skeleton.nodes[0]
    rotation = upright_rotation(found.skeleton, np.array(settings.up), settings.upright)
    attributes = dict(prepared.cloud.attributes)
    if "normal" in attributes:
        attributes["normal"] = (attributes["normal"] @ rotation.T).astype(np.float32)
    attributes["skeleton_node"] = found.node_of_point.astype(np.int32)
    attributes["residual"] = found.residual.astype(np.float32)
    cloud = replace(prepared.cloud, points=(prepared.cloud.points - root) @ rotation.T,
                    attributes=attributes)
    alignment = Alignment(scale=UNIT_METRES[settings.unit],
                          origin=tuple((prepared.origin + root).tolist()),
                          rotation=tuple(map(tuple, rotation.tolist())))
    return alignment, cloud, found.moved(lambda points: (points - root) @ rotation.T)
