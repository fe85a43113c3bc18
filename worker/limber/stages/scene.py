"""A Blender scene with the branch, its motion and paths."""

import tempfile
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from limber.errors import InputError, WorkError
from limber.progress import SILENT, Progress
from limber.settings import Groups, Settings
from limber.stages.inputs import BranchInputs, NoOptions
from limber.stages.registry import StageDescription
from limber.store import Branch


class SceneInputs(BranchInputs):
    """A branch folder, and the files to make of it."""

    groups: ClassVar[Groups] = {"output": ("output", "render", "data")}

    output: Path | None = Field(None, description="The .blend to write.",
                                json_schema_extra={"short": "-o"})
    render: Path | None = Field(
        None, description="Also render a picture (PNG) of the end of the path.")
    data: Path | None = Field(
        None, description="Write only what a scene shows, as arrays (.npz): what the add-on opens.")


class SceneSettings(Settings):
    """What a scene shows."""

    groups: ClassVar[Groups] = {"picture": ("width", "color", "plan", "motion")}

    width: int = Field(1120, ge=160, le=8192, description=(
        "Of the picture [pixels]; its height is three quarters of it."))
    color: Literal["young", "strain_energy", "strain", "stress", "det_f"] = Field(
        "young", description="What the branch's colours mean; all but young: the worst of all "
        "frames.")
    plan: str | None = Field(None, description="Which path to show; without it the newest.")
    motion: str | None = Field(
        None, description="Which frames to play; without it the path's, else the newest.")


def scene(branch_folder: Path, *, output: Path | None = None, picture: Path | None = None,
          width: int = 1120, color: str = "young", plan: str | None = None,
          motion: str | None = None, data_path: Path | None = None,
          progress: Progress = SILENT) -> dict[str, Any]:
    """Make a Blender scene of a branch, or only what it shows, as arrays.

    Args:
        branch_folder: With a mesh.
        output: The .blend to write.
        picture: A PNG to render of the end of the path, or None.
        width: Of the picture [pixels].
        color: What the branch's colours mean: ``young``, or the worst of all frames:
            ``strain_energy``, ``strain``, ``stress``, ``det_f``.
        plan: Which path to show; default the newest.
        motion: Which frames to play; default the plan's, else the newest.
        data_path: The .npz to write instead of ``output``.

    Raises:
        InputError: not one of output and data, or nothing to show.
        WorkError: Blender failed.
    """
    from limber.scene.blender import make_scene
    from limber.scene.data import scene_data
    from limber.stages.loading import load_targets

    if (output is None) == (data_path is None):
        raise InputError("Neither or both of --output and --data were given.",
                         "One says what to make.", "Give -o scene.blend.")
    progress(0.0, "reading the branch folder")
    branch = Branch.open(branch_folder)
    data = scene_data(branch, plan, motion, load_targets(branch))
    if color not in data.info["scalars"]:
        raise InputError(f"The branch has no {color} to show.",
                         f"It has: {', '.join(data.info['scalars'])}.",
                         "Run `limber plan` or `limber simulate` first.")
    if data_path is not None:
        data.write(_writable(data_path))
        return {"data": data_path, "vertex_count": len(data.arrays["vertices"])}
    with tempfile.TemporaryDirectory(prefix="limber-scene-") as temporary:
        prepared = Path(temporary) / "scene.npz"
        data.write(prepared)
        arguments = ["--data", prepared, "--scene", _writable(output), "--color", color]
        if picture is not None:
            arguments += ["--picture", _writable(picture), "--width", width]
        result = make_scene(arguments, progress.part(0.1, 1.0))
    if not output.is_file():
        raise WorkError(f"Blender ended well but wrote no {output}.", "",
                        "`limber doctor` says which Blender was used.")
    return result | {"scene": output, "picture": picture}


def _writable(path: Path) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            return path.resolve()
    except OSError as error:
        raise InputError(f"{path.parent} cannot be written to ({error.strerror}).",
                         "The result goes there.", "Choose another place.") from error


def run(inputs: SceneInputs, settings: SceneSettings, _options: NoOptions,
        progress: Progress) -> dict[str, Any]:
    """Run the stage."""
    return scene(inputs.branch_folder, output=inputs.output, picture=inputs.render,
                 data_path=inputs.data, width=settings.width, color=settings.color,
                 plan=settings.plan, motion=settings.motion, progress=progress)


STAGE = StageDescription("scene", 120, run, SceneInputs, SceneSettings, NoOptions,
                         reads=("mesh.vtu",))
