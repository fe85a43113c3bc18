"""Write the branch for other programs: robot simulators, finite elements, cylinder models.

What is written goes by OUTPUT's suffix:

\b
  .xml    MuJoCo (MJCF): rigid links on springs, at rest as scanned
  .urdf   the same links; springs as Gazebo reads them
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

from limber.errors import InputError
from limber.progress import SILENT, Progress
from limber.settings import Groups, Settings
from limber.stages.inputs import BranchInputs, NoOptions
from limber.stages.registry import StageDescription
from limber.store import Branch

if TYPE_CHECKING:
    from limber.mechanics.materials import RayleighDamping

_RODS, _ELEMENTS, _CYLINDERS = (".xml", ".urdf"), (".inp",), (".mat", ".csv", ".mtg", ".swc")


class ExportInputs(BranchInputs):
    """A branch folder, and the file to write."""

    groups: ClassVar[Groups] = {"output": ("output",)}

    output: Path = Field(description="File to write; its suffix says what.",
                         json_schema_extra={"short": "-o"})


class ExportSettings(Settings):
    """How the branch is taken apart."""

    groups: ClassVar[Groups] = {"output": ("links", "gravity", "load", "columns")}

    links: int = Field(30, ge=2, le=500, description="Links along the main path (.xml, .urdf).")
    gravity: bool = Field(True, description="The branch has weight, which the springs carry.")
    load: tuple[float, float, float] | None = Field(
        None, description="Force on the tip in the static step of an .inp file [N].")
    columns: Literal["rtwig", "simpleforest"] = Field(
        "rtwig", description="Whose names the columns of a .csv file have.")


def export(folder: Path, output: Path, settings: ExportSettings, *, progress: Progress = SILENT,
           ) -> dict[str, Any]:
    """Write a branch in another program's format; the folder stays as it is.

    Returns:
        ``output``, ``format``, and what it holds: ``link_count``, ``mass_kg`` and
        ``stiffness_factor``, by which the links' springs were scaled to bend as the mesh does; or
        ``tet_count``, ``node_count`` and ``tip_node``; or ``cylinder_count``.

    Raises:
        InputError: no such format, or it cannot be written. BranchFolderError: the folder lacks
            mesh or skeleton.
    """
    branch, suffix = Branch.open(folder), output.suffix.lower()
    if suffix in _RODS:
        text, told = _rods(branch, suffix, settings, progress)
    elif suffix in _ELEMENTS:
        text, told = _elements(branch, settings, progress)
    elif suffix in _CYLINDERS:
        text, told = _cylinders(branch, output, settings)
    else:
        known = " ".join((*_RODS, *_ELEMENTS, *_CYLINDERS))
        raise InputError(f"{output} has a suffix that is not known.", f"Known are: {known}.",
                         "Name the file so.")
    _written(output, text)
    return {"output": output, "format": suffix, **told}


def _rods(branch: Branch, suffix: str, settings: ExportSettings, progress: Progress,
          ) -> tuple[str, dict[str, Any]]:
    from limber.exports.mjcf import mjcf_text
    from limber.exports.urdf import urdf_text
    from limber.mechanics.rods import matched, rod_tree
    from limber.stages.loading import load_branch, load_skeleton, load_targets

    skeleton = load_skeleton(branch)
    loaded = load_branch(branch, gravity=settings.gravity, progress=progress)
    path = skeleton.main_path()
    spacing = float(skeleton.arc_length[path[-1]]) / settings.links
    tip = skeleton.nodes[path[-1]]
    node = int(np.linalg.norm(loaded.mesh.nodes - tip, axis=1).argmin())
    tree, factor = matched(rod_tree(loaded.model, skeleton, spacing), loaded.model, node)
    damping = _damping(branch, progress)
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


def _damping(branch: Branch, progress: Progress) -> RayleighDamping:
    """What the last swing told, else what simulations take."""
    from limber.mechanics.materials import RayleighDamping
    from limber.mechanics.model import DEFAULT_DAMPING

    swing = branch.manifest.stages.get("swing")
    known = swing.result if swing else {}
    values = [known.get(name) for name in ("damping_mass_per_s", "damping_stiffness_s")]
    if all(isinstance(value, int | float) and value >= 0 for value in values):
        return RayleighDamping(*map(float, values))
    progress.warn("No swing has told the damping; that of simulations is written.")
    return DEFAULT_DAMPING


def _elements(branch: Branch, settings: ExportSettings, progress: Progress,
              ) -> tuple[str, dict[str, Any]]:
    from limber.exports.abaqus import inp_text
    from limber.stages.loading import load_branch, load_skeleton

    model = load_branch(branch, gravity=False, progress=progress).model
    skeleton = load_skeleton(branch)
    end = skeleton.nodes[skeleton.main_path()[-1]]
    tip = int(np.linalg.norm(model.mesh.nodes - end, axis=1).argmin())
    if model.point_masses:
        progress.warn("What hangs on the branch (twigs, leaves, targets) is not in an .inp file.")
    load = None if settings.load is None else np.array(settings.load)
    text = inp_text(model, branch.name, tip, load)
    return text, {"tet_count": model.mesh.tet_count, "node_count": model.mesh.node_count,
                  "tip_node": tip + 1}


def _cylinders(branch: Branch, output: Path, settings: ExportSettings,
               ) -> tuple[str | None, dict[str, Any]]:
    from limber.geometry.skeleton import cylinder_models
    from limber.geometry.skeleton.mtg import mtg_text
    from limber.stages.loading import load_skeleton

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


def _written(output: Path, text: str | None) -> None:
    from limber.files import write_atomically

    if text is None:
        return
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(output, text)
    except OSError as error:
        raise _cannot_write(output, error) from error


def _cannot_write(output: Path, error: OSError) -> InputError:
    return InputError(f"{output} cannot be written ({error.strerror}).", "The export goes there.",
                      "Choose another place.")


def run(inputs: ExportInputs, settings: ExportSettings, _options: NoOptions,
        progress: Progress) -> dict[str, Any]:
    """Run the stage."""
    return export(inputs.branch_folder, inputs.output, settings, progress=progress)


STAGE = StageDescription(
    "export", 125, run, ExportInputs, ExportSettings, NoOptions,
    reads=("mesh.vtu", "skeleton.swc"))
