"""A Blender scene with the branch, its motion and paths."""

import tempfile
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from limber.core.errors import InputError, WorkError
from limber.core.present import present
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups, Settings
from limber.stages.inputs import BranchInputs, NoOptions, by_name
from limber.stages.registry import StageDescription
from limber.store import Branch

_MOVING = (".webp", ".gif", ".png")
_TURN_SECONDS = 6.0


class SceneInputs(BranchInputs):
    """A branch folder, and the files to make of it."""

    groups: ClassVar[Groups] = {"output": ("output", "render", "turntable", "data")}
    common = ("output", "render")

    output: Path | None = Field(None, description="The .blend to write.",
                                json_schema_extra={"short": "-o"})
    render: Path | None = Field(
        None, description="Also render a picture (PNG) of the end of the path.")
    turntable: Path | None = Field(
        None, description="Also render an animation of all sides (.webp, .gif or .png). It takes "
        "seconds per view.")
    data: Path | None = Field(
        None, description="Write only the scene's data as arrays (.npz), which the add-on opens.")


class SceneSettings(Settings):
    """What a scene shows."""

    groups: ClassVar[Groups] = {
        "picture": ("width", "sides", "color", "plan", "motion", "strength")}

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


def scene(branch_folder: Path, *, output: Path | None = None, picture: Path | None = None,
          turntable: Path | None = None, width: int = 1120, sides: int = 48,
          color: str = "young", plan: str | None = None, motion: str | None = None,
          strength: float | None = None, data_path: Path | None = None,
          progress: Progress = SILENT) -> dict[str, Any]:
    """Make a Blender scene of a branch, or only what it shows, as arrays.

    Args:
        branch_folder: With a mesh.
        output: The .blend to write.
        picture: A PNG to render of the end of the path, or None.
        turntable: A moving picture of it from ``sides`` sides, or None.
        width: Of the picture [pixels].
        color: What the branch's colours mean: ``young``, or the worst of all frames:
            ``strain_energy``, ``strain``, ``stress``, ``stress_over_strength``, ``det_f``; or
            ``residual``.
        plan: Which path to show; default the newest.
        motion: Which frames to play; default the plan's, else the newest.
        strength: Stress that breaks the wood [Pa]; assumed where it is not given.
        data_path: The .npz to write instead of ``output``.

    Raises:
        InputError: not one of output and data, or nothing to show.
        WorkError: Blender failed.
    """
    from limber.results.scene.blender_process import make_scene
    from limber.results.scene.contents import scene_data
    from limber.store.loading import load_targets

    if (output is None) == (data_path is None):
        raise InputError("Exactly one of --output and --data must be given.",
                         "It states what to write.", "Give -o scene.blend.")
    progress(0.0, "reading the branch folder")
    branch = Branch.read(branch_folder)
    data = scene_data(branch, plan, motion, load_targets(branch), strength)
    if color not in data.info["scalars"]:
        raise InputError(f"The branch has no {color} to show.",
                         f"It has: {', '.join(data.info['scalars'])}.",
                         "Run `limber plan` or `limber simulate` first.")
    if output is None:
        target = present(data_path, "file for the data")
        data.write(_writable(target))
        return {"data": target, "vertex_count": len(data.arrays["vertices"])}
    if turntable is not None and turntable.suffix.lower() not in _MOVING:
        raise InputError(f"{turntable.name} has no suffix of an animation.", "",
                         f"Name it {' or '.join(_MOVING)}.")
    with tempfile.TemporaryDirectory(prefix="limber-scene-") as temporary:
        prepared = Path(temporary) / "scene.npz"
        data.write(prepared)
        arguments = ["--data", prepared, "--scene", _writable(output), "--color", color,
                     "--width", width]
        if picture is not None:
            arguments += ["--picture", _writable(picture)]
        if turntable is not None:
            _writable(turntable)
            frames = Path(temporary) / "round"
            frames.mkdir()
            arguments += ["--round", frames, "--sides", sides]
        result = make_scene(arguments, progress.part(0.1, 1.0))
        if turntable is not None:
            _write_moving(turntable, sorted(frames.glob("*.png")))
    if not output.is_file():
        raise WorkError(f"Blender ended without an error but did not write {output}.", "",
                        "`limber doctor` states which Blender was used.")
    return result | {"scene": output, "picture": picture, "turntable": turntable}


def _write_moving(path: Path, pictures: list[Path]) -> None:
    """Write pictures one after the other as one that moves, and begins again."""
    from PIL import Image

    if not pictures:
        raise WorkError("Blender ended without an error but rendered nothing.", "",
                        "`limber doctor` states which Blender was used.")
    shown = [Image.open(picture).convert("RGB") for picture in pictures]
    beside = path.with_name(f".{path.name}.part")
    try:
        shown[0].save(beside, format="PNG" if path.suffix.lower() == ".png" else path.suffix[1:],
                      save_all=True, append_images=shown[1:], loop=0,
                      duration=round(1000 * _TURN_SECONDS / len(shown)))
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def _writable(path: Path) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            return path.resolve()
    except OSError as error:
        raise InputError(f"{path.parent} cannot be written to ({error.strerror}).",
                         "The result goes there.", "Choose another location.") from error


STAGE = StageDescription(
    "scene", 120, by_name(scene, picture="render", data_path="data"), SceneInputs, SceneSettings,
    NoOptions, reads=("mesh.vtu",))
