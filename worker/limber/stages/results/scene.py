"""Stage ``scene``."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from limber.core.errors import Command, InputError, Option, Text, WorkError
from limber.core.files.atomic import write_atomically
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.stages.result import Written, drawn
from limber.stages.stage import About, BranchStage, given
from limber.store import Branch

if TYPE_CHECKING:
    from limber.results.scene.colours import SceneData

_MOVING = (".webp", ".gif", ".png")
_TURN_SECONDS = 6.0


class MakeScene(BranchStage):
    """Write a Blender scene with the branch, its motion and paths."""

    about = About(
        "scene", 120, Written, reads=("mesh.vtu",),
        found=("{object_count} objects and {frame_count} frames, made by Blender {blender}.",
               "{mesh_count} objects as glTF, without Blender.",
               "Data of {vertex_count:count} vertices.", "Picture {picture}.",
               "Turntable {turntable}."))
    groups: ClassVar[Groups] = {
        "picture": ("width", "sides", "color", "plan", "motion", "strength")}
    common = ("color", "plan", "motion")

    cell: Path | None = given(
        "The robot's cell file. Its arm, gripper, camera, obstacles and workspace are shown as "
        "well.")
    output: Path | None = given("The .blend to write, or a .glb (glTF), which takes no Blender.",
                                group="output", common=True, short="-o")
    render: Path | None = given(
        "Also render a picture (PNG) of the end of the path.", group="output", common=True)
    turntable: Path | None = given(
        "Also render an animation of all sides (.webp, .gif or .png). It takes seconds per view.",
        group="output")
    data: Path | None = given(
        "Write only the scene's data as arrays (.npz), which the add-on opens.", group="output")
    width: int = Field(1120, ge=160, le=8192, description=(
        "Width of the picture [pixels]; the height is three quarters of it."))
    sides: int = Field(48, ge=2, le=720, description="Number of frames of the turntable.")
    color: Literal["young", "strain_energy", "strain", "stress", "stress_over_strength", "det_f",
                   "residual"] = Field(
        "young", description="Quantity that the colours show. All but young and residual "
        "(measured to simulated) show the worst of all frames.")
    plan: str | None = Field(None, description="Path to show. Default: the newest.")
    motion: str | None = Field(
        None, description="Frames to play. Default: the path's, else the newest.")
    strength: float | None = Field(
        None, gt=0, description=(
            "Strength of the wood (modulus of rupture) [Pa], to which stress is compared. "
            "Default: 0.6 % of Young's modulus, as of green wood (0.5 to 0.7 %)."))

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Make a Blender scene of a branch, or only its content as arrays. Where there is no
        Blender, a warning says so and the scene is written as glTF.

        Raises:
            InputError: not exactly one of output and data is given, or there is nothing to show.
            WorkError: Blender failed.
        """
        from limber.cell.cell_file import read_cell
        from limber.cell.obstacles import cell_obstacles
        from limber.core.errors import MissingDependencyError
        from limber.results.scene.animation import scene_data
        from limber.results.scene.still_objects import add_cell
        from limber.store.loading import load_targets

        if (self.output is None) == (self.data is None):
            raise InputError(Text("Exactly one of ", Option("output"), " and ", Option("data"),
                                  " must be given."),
                             "It states what to write.", "Give -o scene.blend.")
        progress(0.0, "reading the branch folder")
        branch = Branch.read(self.branch_folder)
        data = scene_data(branch, self.plan, self.motion, load_targets(branch), self.strength)
        if self.cell is not None:
            cell = read_cell(self.cell)
            add_cell(data, cell, cell_obstacles(cell, self.cell.parent))
        if self.color not in data.info["scalars"]:
            raise InputError(f"The branch has no {self.color} to show.",
                             f"It has: {', '.join(data.info['scalars'])}.",
                             "Run ", Command("plan"), " or ", Command("simulate"), " first.")
        if self.data is not None:
            data.write(_writable(self.data))
            return {"data": self.data, "vertex_count": len(data.arrays["vertices"])}
        turntable, output = self.turntable, present(self.output, "file for the scene")
        if turntable is not None and turntable.suffix.lower() not in _MOVING:
            raise InputError(f"{turntable.name} has no suffix of an animation.", "",
                             f"Name it {' or '.join(_MOVING)}.")
        if output.suffix.lower() == ".glb":
            return self._as_gltf(branch, data, output)
        try:
            result = _made(data, output, self, progress.part(0.1, 1.0))
        except MissingDependencyError as error:
            if turntable is not None:
                raise
            output = output.with_suffix(".glb")
            progress.warn(f"{error} Without, {output.name} (glTF) is written, and as picture the "
                          "report's of the mesh.")
            return self._as_gltf(branch, data, output)
        if not output.is_file():
            raise WorkError(f"Blender ended without an error but did not write {output}.", "",
                            Command("doctor"), " states which Blender was used.")
        return result | {"scene": output, "picture": self.render, "turntable": turntable}

    def _as_gltf(self, branch: Branch, data: SceneData, output: Path) -> dict[str, Any]:
        from limber.results.report.figures import mesh_by_modulus

        if self.render is not None:
            drawn(lambda: mesh_by_modulus(branch)).savefig(_writable(self.render), format="png")
        count = data.write_gltf(_writable(output), self.color)
        return {"scene": output, "picture": self.render, "mesh_count": count}


def _made(data: SceneData, output: Path, asked: MakeScene, progress: Progress) -> dict[str, Any]:
    """Have Blender make the scene and its renders; return its report."""
    from limber.results.scene.blender_process import make_scene

    with tempfile.TemporaryDirectory(prefix="limber-scene-") as temporary:
        prepared, frames = Path(temporary) / "scene.npz", Path(temporary) / "round"
        data.write(prepared)
        arguments = ["--data", prepared, "--scene", _writable(output), "--color", asked.color,
                     "--width", asked.width]
        if asked.render is not None:
            arguments += ["--picture", _writable(asked.render)]
        if asked.turntable is not None:
            _writable(asked.turntable)
            frames.mkdir()
            arguments += ["--round", frames, "--sides", asked.sides]
        result = make_scene(arguments, progress)
        if asked.turntable is not None:
            _write_moving(asked.turntable, sorted(frames.glob("*.png")))
    return result


def _write_moving(path: Path, pictures: list[Path]) -> None:
    """Write pictures as one animation that loops."""
    from PIL import Image

    if not pictures:
        raise WorkError("Blender ended without an error but rendered nothing.", "",
                        Command("doctor"), " states which Blender was used.")
    images = [Image.open(picture).convert("RGB") for picture in pictures]
    content = io.BytesIO()
    images[0].save(content, format="PNG" if path.suffix.lower() == ".png" else path.suffix[1:],
                   save_all=True, append_images=images[1:], loop=0,
                   duration=round(1000 * _TURN_SECONDS / len(images)))
    write_atomically(path, content.getvalue())


def _writable(path: Path) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            return path.resolve()
    except OSError as error:
        raise InputError(f"{path.parent} cannot be written to ({error.strerror}).",
                         "The result goes there.", "Choose another location.") from error
