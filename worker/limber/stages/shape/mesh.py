"""Stage ``mesh``, and the result of a branch that has been meshed."""

from pathlib import Path
from typing import Any, ClassVar

from limber.core.files.atomic import file_digest, require_file
from limber.core.progress import SILENT, Progress
from limber.geometry.io.formats import listed
from limber.geometry.io.skeletons import SKELETONS, write_cylinders
from limber.geometry.io.surfaces import SURFACES, usable_surface
from limber.geometry.settings import MeshSurfaceSettings
from limber.stages.result import Interval, Result, kept, shown
from limber.stages.stage import About, Repeatable, argument, required
from limber.store import Branch


class Shape(Result):
    """Axes, radii and size of a branch."""

    keys: ClassVar = {"length_interval_m": "expected_length_interval",
                      "volume_interval_m3": "expected_volume_interval"}
    point_count: int | None = shown("points used", ",")
    branch_count: int | None = shown("branches")
    length: float | None = shown("centreline, all branches", ".3f m")
    radius_min: float | None = shown("smallest radius", ".5f m")
    radius_max: float | None = shown("largest radius", ".5f m")
    tet_count: int | None = shown("tetrahedra", ",")
    expected_length: float | None = shown(
        "length of wood, uncertain twigs weighted by their probability", ".4g m")
    expected_length_interval: Interval | None = kept("its 95 % interval [m]")
    expected_volume: float | None = shown(
        "volume of wood, uncertain twigs weighted by their probability", ".4g cm3")
    expected_volume_interval: Interval | None = kept("its 95 % interval [m3]")


class MeshQuality(Result):
    """Quality of a mesh, and its distance from the surface."""

    keys: ClassVar = {"min_dihedral_deg": "min_dihedral"}
    volume_ratio: float | None = shown("volume of the mesh over volume of the surface", ".4g")
    min_dihedral: float | None = shown("smallest angle between faces", ".4g degrees")
    min_radius_ratio: float | None = shown("worst shape of a tetrahedron (1 regular, 0 flat)",
                                           ".4g")
    mean_radius_ratio: float | None = shown("mean shape of the tetrahedra", ".4g")
    elements_across: float | None = shown("elements across the branch", ".4g")
    surface_distance_mean: float | None = shown(
        "mean distance between mesh and surface", ".4g local radii",
        meaning="mean distance between mesh and surface, in local radii")
    surface_distance_max: float | None = shown("largest distance between mesh and surface", ".4g m")
    fork_distance_mean: float | None = shown("mean distance at forks", ".4g local radii",
                                             meaning="the same at forks")
    fork_distance_max: float | None = shown("largest distance at forks", ".4g local radii",
                                            meaning="largest distance at forks, in local radii")


class MeshNumbers(Result):
    """Volumes and quality of a branch's mesh."""

    surface_volume: float | None = shown("surface volume", ".4g cm3")
    mesh_volume: float | None = shown("mesh volume", ".4g cm3")
    mesh_quality: MeshQuality | None = kept("quality of the mesh")


class Meshed(MeshNumbers, Shape):
    """A branch that has been meshed."""


class Mesh(MeshSurfaceSettings, Repeatable):
    """Mesh a closed surface, a table of sections or a cylinder model."""

    about = About(
        "mesh", 30, Meshed, key="mesh",
        writes=("skeleton.swc", "skeleton.csv", "surface.ply", "mesh.vtu", "point_masses.json"),
        found=("{length_m:m} of centreline in {branch_count:#branch/branches}, radius "
               "{radius_min_m:m} to {radius_max_m:m}.",
               "{tet_count:count} tetrahedra, {mesh_volume_m3:cm3}."),
        then="limber suggest-pull {output}", step="mesh", label="Mesh a Closed Surface")

    surface: Path = argument(
        f"A closed surface: {listed(SURFACES.readers())}; a .csv of sections along an axis from "
        "the end that is held: x, y, z, width, height, and perhaps mass_kg, what hangs there; or "
        f"a cylinder model: {listed(SKELETONS.readers())}.")
    output: Path = required("The branch folder to make.", "{stem}.branch", group="output",
                            short="-o")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Fill a closed surface with tetrahedra and mark base, control points and grasp.

        Raises:
            InputError: the surface cannot be read or is not that of one solid
                (:func:`limber.geometry.io.surfaces.usable_surface`), or the table is not one of
                sections (:func:`limber.geometry.bodies.read_sections`), or the cylinder model
                cannot be used (:func:`limber.geometry.bodies.mesh_model`).
            MeshingError: fTetWild failed.
        """
        from limber.core.constants import UNIT_METRES
        from limber.geometry.bodies import (
            SECTIONS,
            body_format,
            mesh_body,
            mesh_model,
            mesh_sections,
            read_sections,
        )
        from limber.geometry.cloud.preparation import size_doubts

        path, drawn = require_file(self.surface, "A surface"), None
        warnings: list[str] = []
        chosen, is_stated = body_format(path), "unit" in self.model_fields_set
        has_cylinders = chosen in SKELETONS.readers()
        if has_cylinders:
            progress = progress.keeping(warnings)
        elif chosen is SECTIONS:
            drawn = read_sections(path, self.unit)
            warnings += size_doubts(drawn.axis, "axis of the sections", self.unit,
                                    is_stated=is_stated)
        else:
            surface, warnings = usable_surface(
                SURFACES.read_as(chosen, path, scale=UNIT_METRES[self.unit]), path)
            warnings += size_doubts(surface.vertices, "surface", self.unit, is_stated=is_stated)
        branch = Branch.create(self.output)
        digests = {"surface": file_digest(path)}
        if self.is_kept(branch, digests=digests):
            return branch.manifest.stages["mesh"].result
        for text in list(warnings):
            progress.warn(text)
        with branch.dropped_if_empty(), branch.stage("mesh", self, digests=digests) as stage:
            if has_cylinders:
                made, masses = mesh_model(path, self, progress)
            elif drawn is not None:
                made, masses = mesh_sections(drawn, self)
            else:
                made, masses = mesh_body(surface, self, progress), []
            stage.manifest.alignment = made.alignment
            stage.manifest.source = {"file": path.name, "unit": self.unit,
                                     "sha256": digests["surface"]}
            made.skeleton.write_swc(stage.path("skeleton.swc"))
            made.surface.write_ply(stage.path("surface.ply"))
            made.mesh.write(stage.path("mesh.vtu"))
            for name in ("point_masses.json", "skeleton.csv"):
                stage.remove(name)  # from an earlier scan in this folder
            if has_cylinders:
                write_cylinders(made.skeleton, stage.path("skeleton.csv"))
            if masses:
                stage.write("point_masses.json", masses)
            stage.result.update(made.numbers | {"warnings": warnings})
            progress(1.0, "meshed", tets=made.mesh.tet_count)
        return branch.manifest.stages["mesh"].result
