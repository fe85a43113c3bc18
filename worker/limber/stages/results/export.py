"""Write the branch for other programs: robot simulators, finite elements, cylinder models.

What is written goes by OUTPUT's suffix:

\b
  .xml    MuJoCo (MJCF): rigid links on springs, at rest as scanned
  .urdf   the same links; springs as Gazebo reads them
  .usd    USD (.usda: as text): a deformable body of linear tetrahedra with one modulus
  .inp    Abaqus, CalculiX: the quadratic tetrahedra, held base, a static and a frequency step
  .mat    cylinder model of TreeQSM, which SmartQSM shares
  .csv    cylinder model: --columns rtwig or simpleforest
  .mtg    multiscale tree graph of the axes
  .swc    the axes with their radii

Links and cylinders are in the branch's frame, in metres. Modulus and damping are those that the
folder knows: of the last estimate or swing.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups, Settings
from limber.stages.inputs import BranchInputs, NoOptions
from limber.stages.registry import StageDescription
from limber.store import Branch

if TYPE_CHECKING:
    from limber.geometry.skeleton.skeleton import Skeleton
    from limber.mechanics.model import BranchModel

_RODS, _ELEMENTS, _CYLINDERS = (".xml", ".urdf"), (".inp",), (".mat", ".csv", ".mtg", ".swc")
_SCENES = (".usd", ".usda", ".usdc")


class ExportInputs(BranchInputs):
    """A branch folder, and the file to write."""

    groups: ClassVar[Groups] = {"output": ("output",)}

    output: Path = Field(description="File to write. Its suffix states the format.",
                         json_schema_extra={"short": "-o", "example": "{stem}.urdf"})


class ExportSettings(Settings):
    """How the branch is taken apart."""

    groups: ClassVar[Groups] = {"output": ("links", "gravity", "load", "columns")}

    links: int = Field(30, ge=2, le=500, description="Links along the main path (.xml, .urdf).")
    gravity: bool = Field(True, description="Include the branch's weight, which the springs "
                                            "carry.")
    load: tuple[float, float, float] | None = Field(
        None, description="Force on the tip in the static step of an .inp file [N].")
    columns: Literal["rtwig", "simpleforest"] = Field(
        "rtwig", description="Column names of a .csv file.")


def export(folder: Path, output: Path, settings: ExportSettings, *, progress: Progress = SILENT,
           ) -> dict[str, Any]:
    """Write a branch in another program's format; the folder stays as it is.

    Returns:
        ``output``, ``format``, and what it holds: ``link_count``, ``mass_kg`` and
        ``stiffness_factor``, by which the links' springs were scaled to bend as the mesh does; or
        ``tet_count``, ``node_count`` and ``tip_node``; or those and ``young_pa``, the one modulus
        that makes the tip as compliant as our mesh; or ``cylinder_count``.

    Raises:
        InputError: no such format, or it cannot be written. BranchFolderError: the folder lacks
            mesh or skeleton. MissingDependencyError: USD is not installed.
    """
    branch, suffix = Branch.read(folder), output.suffix.lower()
    branch, suffix = Branch.open(folder), output.suffix.lower()
    text: str | bytes | None
    if suffix in _RODS:
        text, told = _rods(branch, suffix, settings, progress)
    elif suffix in _ELEMENTS:
        text, told = _elements(branch, settings, progress)
    elif suffix in _SCENES:
        text, told = _scene(branch, output, progress)
    elif suffix in _CYLINDERS:
        text, told = _cylinders(branch, output, settings)
    else:
        known = " ".join((*_RODS, *_SCENES, *_ELEMENTS, *_CYLINDERS))
        raise InputError(f"{output} has an unknown suffix.", f"Known suffixes: {known}.",
                         "Use one of them.")
    _written(output, text)
    return {"output": output, "format": suffix, **told}


def _rods(branch: Branch, suffix: str, settings: ExportSettings, progress: Progress,
          ) -> tuple[str, dict[str, Any]]:
    from limber.results.exports.mjcf import mjcf_text
    from limber.results.exports.rigid_links import matched, rod_tree
    from limber.results.exports.urdf import urdf_text
    from limber.store.loading import known_damping, load_branch, load_skeleton, load_targets

    skeleton = load_skeleton(branch)
    loaded = load_branch(branch, gravity=settings.gravity, progress=progress)
    path = skeleton.main_path()
    spacing = float(skeleton.arc_length[path[-1]]) / settings.links
    tip = skeleton.nodes[path[-1]]
    tree, factor = matched(rod_tree(loaded.model, skeleton, spacing), loaded.model,
                           _tip(loaded.model, skeleton))
    damping = known_damping(branch, progress)
    if suffix == ".urdf":
        text = urdf_text(tree, damping, branch.name)
    else:
        sites = {target.name: target.position for target in load_targets(branch)}
        if loaded.grasp_point is not None:
            sites = {"grasp": loaded.grasp_point, **sites}
        text = mjcf_text(tree, damping, branch.name,
                         {"tip": tuple(tip), **sites})
    return text, {"link_count": tree.count, "mass_kg": float(tree.mass.sum()),
                  "stiffness_factor": factor,
                  "damping_stiffness_s": damping.stiffness}


def _elements(branch: Branch, settings: ExportSettings, progress: Progress,
              ) -> tuple[str, dict[str, Any]]:
    from limber.results.exports.abaqus import inp_text
    from limber.store.loading import load_branch, load_skeleton

    model = load_branch(branch, gravity=False, progress=progress).model
    tip = _tip(model, load_skeleton(branch))
    if model.point_masses:
        progress.warn("An .inp file does not contain what hangs on the branch (twigs, leaves, "
                      "targets).")
    load = None if settings.load is None else np.array(settings.load)
    text = inp_text(model, branch.name, tip, load)
    return text, {"tet_count": model.mesh.tet_count, "node_count": model.mesh.node_count,
                  "tip_node": tip + 1}


def _scene(branch: Branch, output: Path, progress: Progress) -> tuple[bytes, dict[str, Any]]:
    import tempfile

    from limber.core.optional import require_extra
    from limber.results.exports.usd import as_deformable, write_usd
    from limber.store.loading import known_damping, load_branch, load_skeleton

    require_extra("usd", ("pxr",), "USD")
    model = load_branch(branch, gravity=False, progress=progress).model
    if model.point_masses:
        progress.warn("A USD file does not contain what hangs on the branch (twigs, leaves, "
                      "targets).")
    tip = _tip(model, load_skeleton(branch))
    made = as_deformable(model, tip)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place, f"branch{output.suffix.lower()}")
        write_usd(made, known_damping(branch, progress), branch.name, path)
        content = path.read_bytes()
    mesh = made.model.mesh
    return content, {"tet_count": mesh.tet_count, "node_count": mesh.node_count, "tip_node": tip,
                     "young_pa": made.young}


def _tip(model: BranchModel, skeleton: Skeleton) -> int:
    """The node at the end of the main path."""
    end = skeleton.nodes[skeleton.main_path()[-1]]
    return int(np.linalg.norm(model.mesh.nodes - end, axis=1).argmin())


def _cylinders(branch: Branch, output: Path, settings: ExportSettings,
               ) -> tuple[str | None, dict[str, Any]]:
    from limber.geometry.io import cylinder_models
    from limber.geometry.io.mtg import mtg_text
    from limber.store.loading import load_skeleton

    skeleton = load_skeleton(branch)
    told = {"cylinder_count": skeleton.node_count - 1}
    suffix = output.suffix.lower()
    if suffix == ".csv":
        write = {"rtwig": cylinder_models.rtwig_text,
                 "simpleforest": cylinder_models.simpleforest_text}[settings.columns]
        return write(skeleton), told
    if suffix == ".mtg":
        return mtg_text(skeleton), told
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        if suffix == ".swc":
            skeleton.write_swc(output)
        else:
            cylinder_models.write_treeqsm(skeleton, output)
    except OSError as error:
        raise _cannot_write(output, error) from error
    return None, told


def _written(output: Path, text: str | bytes | None) -> None:
    from limber.core.files.atomic import write_atomically

    if text is None:
        return
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(output, text)
    except OSError as error:
        raise _cannot_write(output, error) from error


def _cannot_write(output: Path, error: OSError) -> InputError:
    return InputError(f"{output} cannot be written ({error.strerror}).", "The export goes there.",
                      "Choose another location.")


def run(inputs: ExportInputs, settings: ExportSettings, _options: NoOptions,
        progress: Progress) -> dict[str, Any]:
    """Run the stage."""
    return export(inputs.branch_folder, inputs.output, settings, progress=progress)


STAGE = StageDescription(
    "export", 125, run, ExportInputs, ExportSettings, NoOptions,
    reads=("mesh.vtu", "skeleton.swc"), step="report", label="Export for Other Programs")
