"""Stage ``export``, and the formats of other programs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.geometry.io.formats import Format, Registry, listed, unknown_suffix
from limber.geometry.io.skeletons import SKELETONS
from limber.stages.result import Written
from limber.stages.stage import About, BranchStage, required
from limber.store import Branch

if TYPE_CHECKING:
    from limber.geometry.skeleton.skeleton import Skeleton
    from limber.mechanics.model import BranchModel


def _format_of(output: Path, columns: str) -> Format:
    """The format of a suffix; if several share it, the one with the requested columns."""
    known = [*EXPORTS.writers(), *SKELETONS.writers()]
    named = [one for one in known if output.suffix.lower() in one.suffixes]
    if not named:
        raise unknown_suffix(output, known, "Use one of them.")
    return next((one for one in named if one.name == columns), named[0])


def _write_skeleton(branch: Branch, path: Path, chosen: Format) -> dict[str, Any]:
    from limber.store.loading import load_skeleton

    skeleton = load_skeleton(branch)
    SKELETONS.write_as(chosen, skeleton, path)
    return {"cylinder_count": skeleton.node_count - 1}


def _write_links(branch: Branch, path: Path, settings: Export, progress: Progress,
                 ) -> dict[str, Any]:
    from limber.results.exports.rigid_links import matched, mjcf_text, rod_tree, urdf_text
    from limber.store.loading import known_damping, load_branch, load_skeleton, load_targets

    skeleton = load_skeleton(branch)
    loaded = load_branch(branch, gravity=settings.gravity, progress=progress)
    end = skeleton.main_path()[-1]
    spacing = float(skeleton.arc_length[end]) / settings.links
    tree, factor = matched(rod_tree(loaded.model, skeleton, spacing), loaded.model,
                           _tip(loaded.model, skeleton))
    damping = known_damping(branch, progress)
    if path.suffix == ".urdf":
        text = urdf_text(tree, damping, branch.name)
    else:
        sites = {target.name: target.position for target in load_targets(branch)}
        if loaded.grasp_point is not None:
            sites = {"grasp": loaded.grasp_point, **sites}
        text = mjcf_text(tree, damping, branch.name, {"tip": tuple(skeleton.nodes[end]), **sites})
    path.write_bytes(text.encode())
    return {"link_count": tree.count, "mass_kg": float(tree.mass.sum()),
            "stiffness_factor": factor, "damping_stiffness_s": damping.stiffness}


def _write_elements(branch: Branch, path: Path, settings: Export, progress: Progress,
                    ) -> dict[str, Any]:
    from limber.results.exports.volumes import inp_text
    from limber.store.loading import load_branch, load_skeleton

    model = load_branch(branch, gravity=False, progress=progress).model
    tip = _tip(model, load_skeleton(branch))
    if model.point_masses:
        progress.warn("An .inp file does not contain what hangs on the branch (twigs, leaves, "
                      "targets).")
    load = None if settings.load is None else np.array(settings.load)
    path.write_bytes(inp_text(model, branch.name, tip, load).encode())
    return {"tet_count": model.mesh.tet_count, "node_count": model.mesh.node_count,
            "tip_node": tip + 1}


def _write_body(branch: Branch, path: Path, _settings: Export, progress: Progress,
                ) -> dict[str, Any]:
    from limber.core.optional import require_extra
    from limber.results.exports.volumes import as_deformable, write_usd
    from limber.store.loading import known_damping, load_branch, load_skeleton

    require_extra("usd", ("pxr",), "USD")
    model = load_branch(branch, gravity=False, progress=progress).model
    if model.point_masses:
        progress.warn("A USD file does not contain what hangs on the branch (twigs, leaves, "
                      "targets).")
    tip = _tip(model, load_skeleton(branch))
    made = as_deformable(model, tip)
    write_usd(made, known_damping(branch, progress), branch.name, path)
    mesh = made.model.mesh
    return {"tet_count": mesh.tet_count, "node_count": mesh.node_count, "tip_node": tip,
            "young_pa": made.young}


def _tip(model: BranchModel, skeleton: Skeleton) -> int:
    """The node at the end of the main path."""
    end = skeleton.nodes[skeleton.main_path()[-1]]
    return int(np.linalg.norm(model.mesh.nodes - end, axis=1).argmin())


EXPORTS = Registry("export", "limber.exports", [
    Format("MuJoCo", (".xml",), write=_write_links,
           about="MJCF of MuJoCo: rigid links on springs, at rest as scanned"),
    Format("URDF", (".urdf",), write=_write_links,
           about="the same links; springs as Gazebo reads them"),
    Format("USD", (".usd", ".usda", ".usdc"), write=_write_body,
           about="USD: a deformable body of linear tetrahedra with one modulus"),
    Format("Abaqus", (".inp",), write=_write_elements, about="Abaqus, CalculiX: the quadratic "
           "tetrahedra, held base, a static and a frequency step")])
"""``write`` is called with the open branch folder, the path, the settings and progress; it returns
the content of the file. All formats of :data:`~limber.geometry.io.skeletons.SKELETONS` are
available too."""


class Export(BranchStage):
    """Export the branch for robot simulators, finite element programs and others.

    The format is determined by OUTPUT's suffix. Links and cylinders are in the branch's frame, in
    metres. Modulus and damping are those in the folder, from the last estimate or swing.
    """

    about = About(
        "export", 125, Written, reads=("mesh.vtu", "skeleton.swc"),
        found=("{link_count} links on springs, {mass_kg:kg}.",
               "{tet_count:count} tetrahedra, {node_count:count} nodes.",
               "{cylinder_count:count} cylinders."),
        step="report", label="Export for Other Programs")
    groups: ClassVar[Groups] = {"output": ("links", "gravity", "load", "columns")}
    common = ("links", "columns")

    output: Path = required(
        "File to write; its suffix says what: "
        f"{listed([*EXPORTS.writers(), *SKELETONS.writers()])}.", "{stem}.urdf", group="output",
        short="-o")
    links: int = Field(30, ge=2, le=500, description="Links along the main path (.xml, .urdf).")
    gravity: bool = Field(True, description="Include the branch's weight, which the springs "
                                            "carry.")
    load: tuple[float, float, float] | None = Field(
        None, description="Force on the tip in the static step of an .inp file [N].")
    columns: Literal["rtwig", "simpleforest"] = Field(
        "rtwig", description="Column names of a .csv file.")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Write a branch in another program's format; the folder stays as it is.

        Returns:
            ``output``, ``format``, and its content: ``link_count``, ``mass_kg`` and
            ``stiffness_factor``, the scale of the links' springs with which they bend like the
            mesh; or ``tet_count``, ``node_count`` and ``tip_node``; or those and ``young_pa``, the
            one modulus that makes the tip as compliant as our mesh; or ``cylinder_count``.

        Raises:
            InputError: there is no such format, or the file cannot be written.
            BranchFolderError: the folder lacks mesh or skeleton.
            MissingDependencyError: USD is not installed.
        """
        from limber.core.files.atomic import write_atomically

        branch, chosen = Branch.read(self.branch_folder), _format_of(self.output, self.columns)
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch, f"branch{self.output.suffix.lower()}")
            if chosen in SKELETONS.writers():
                written = _write_skeleton(branch, path, chosen)
            else:
                written = EXPORTS.write_as(chosen, branch, path, self, progress)
            content = path.read_bytes()
        try:
            self.output.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self.output, content)
        except OSError as error:
            raise InputError(f"{self.output} cannot be written ({error.strerror}).",
                             "The export goes there.", "Choose another location.") from error
        return {"output": self.output, "format": self.output.suffix.lower(), **written}
