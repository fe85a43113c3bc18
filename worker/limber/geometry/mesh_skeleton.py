"""From a cylinder model alone, without its scan, to a closed surface and tetrahedra."""

from pathlib import Path
from typing import Any

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.geometry.io.formats import Format, known_format
from limber.geometry.io.skeletons import SKELETONS, read_skeleton
from limber.geometry.io.surfaces import SURFACES
from limber.geometry.mesh_surface import MeshedBody
from limber.geometry.plausible_size import size_doubts
from limber.geometry.reconstruction import gravity_after, mesh_skeleton
from limber.geometry.sections import SECTIONS
from limber.geometry.settings import MeshSurfaceSettings, ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.upright import upright_rotation


def body_format(path: Path) -> Format:
    """Return the kind of a file given to `limber mesh`: a cylinder model, sections or a surface.

    Raises:
        InputError: the kind is not known.
    """
    return known_format(path, "body", [*SKELETONS.readers(), SECTIONS, *SURFACES.readers()])


def mesh_model(path: Path, settings: MeshSurfaceSettings, progress: Progress = SILENT,
               ) -> tuple[MeshedBody, list[dict[str, Any]]]:
    """Return the branch of a cylinder model, and the masses of the pruned twigs.

    Args:
        path: File in a format of :data:`~limber.geometry.io.skeletons.SKELETONS`.
        settings: ``unit``, ``up``, ``upright`` and settings of the wood; the model has its own
        root.
        progress: Called during the work; receives warnings for the user.

    Raises:
        InputError: it cannot be read, a radius is 0, its size is not a branch's, or a root is
        given.
        MeshingError: it cannot be meshed.
    """
    if settings.root is not None:
        raise InputError("A root (--root) was given for a cylinder model.",
                         "The model defines its own root.", "Omit --root.")
    scale = UNIT_METRES[settings.unit]
    read = read_skeleton(path, scale=scale)
    if (read.radius <= 0).any():
        raise InputError(f"{int((read.radius <= 0).sum())} of {read.node_count} nodes of {path} "
                         "have radius 0.", "A branch has a thickness.",
                         "Give each node its radius.")
    for text in size_doubts(read.nodes, "cylinder model", settings.unit,
                            is_stated="unit" in settings.model_fields_set):
        progress.warn(text)
    alignment, skeleton = _aligned(read, scale, settings)
    meshed = mesh_skeleton(skeleton, ReconstructSettings(
        young=settings.young, poisson=settings.poisson, density=settings.density,
        grasp_fraction=settings.grasp_fraction, mesh_time_limit=settings.mesh_time_limit,
        mesh_memory_limit_mb=settings.mesh_memory_limit_mb, leave_out=True), progress)
    return MeshedBody(alignment, skeleton, meshed.surface, meshed.mesh, meshed.numbers | {
        "point_count": len(meshed.surface.vertices),
        "gravity_m_s2": gravity_after(alignment, settings.up)}), meshed.masses


def _aligned(skeleton: Skeleton, scale: float, settings: MeshSurfaceSettings,
             ) -> tuple[Alignment, Skeleton]:
    root = skeleton.nodes[0]
    turn = upright_rotation(skeleton, np.array(settings.up), settings.upright)
    return (Alignment(scale=scale, origin=tuple(root.tolist()),
                      rotation=tuple(map(tuple, turn.tolist()))),
            skeleton.moved((skeleton.nodes - root) @ turn.T))
