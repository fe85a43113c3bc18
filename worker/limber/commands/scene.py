"""``limber scene``: a Blender scene of a branch, made by a process that has bpy.

The core never imports bpy: the ``bpy`` package in this Python, or a Blender program, runs the
add-on's ``make_scene.py`` on data prepared by :mod:`limber.scene.data`.
"""

import importlib.util
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import click

from limber.cli import Run, stage_command
from limber.errors import InputError, MissingDependencyError, WorkError
from limber.progress import Progress
from limber.store import Branch

_SCRIPT = Path(__file__).parents[3] / "addon" / "make_scene.py"


@stage_command("scene")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The .blend to write.")
@click.option("--render", "picture", type=click.Path(path_type=Path),
              help="Also render a picture (PNG) of the end of the path.")
@click.option("--width", type=click.IntRange(160, 8192), default=1120, show_default=True,
              help="Of the picture [pixels]; its height is three quarters of it.")
@click.option("--color", type=click.Choice(["young", "strain_energy"]), default="young",
              show_default=True, help="What the branch's colours mean.")
@click.option("--plan", help="Which path to show.  [default: the newest]")
@click.option("--data", "data_path", type=click.Path(path_type=Path),
              help="Write only what a scene shows, as arrays (.npz): what the add-on opens.")
def command(run: Run, branch_folder: Path, output: Path | None, picture: Path | None,
            width: int, color: str, plan: str | None, data_path: Path | None) -> dict[str, Any]:
    """A Blender scene with the branch, its motion and paths (needs bpy or Blender).

    Files made by the bpy package (5.0) open in Blender 4.5 and newer. To have one made by another
    Blender, 4.2 or newer, name that in LIMBER_SCENE_BLENDER.
    """
    from limber.scene.data import scene_data

    if (output is None) == (data_path is None):
        raise InputError("Neither or both of --output and --data were given.",
                         "One says what to make.", "Give -o scene.blend.")
    run.progress(0.0, "reading the branch folder")
    data = scene_data(Branch.open(branch_folder), plan)
    if color not in data.info["scalars"]:
        raise InputError(f"The branch has no {color} to show.", "", "Run `limber plan` first.")
    if data_path is not None:
        data.write(_writable(data_path))
        return {"data": data_path, "vertex_count": len(data.arrays["vertices"])}
    with tempfile.TemporaryDirectory(prefix="limber-scene-") as temporary:
        prepared = Path(temporary) / "scene.npz"
        data.write(prepared)
        arguments = ["--data", prepared, "--scene", _writable(output), "--color", color]
        if picture is not None:
            arguments += ["--picture", _writable(picture), "--width", width]
        result = _make_scene(arguments, run.progress.part(0.1, 1.0))
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


def _make_scene(arguments: list[object], progress: Progress) -> dict[str, Any]:
    from limber.jobs.process import run_json_process

    progress(0.0, "starting Blender")
    result = run_json_process("scene", [*blender_command(), "--", *map(str, arguments)], progress,
                              fix="`limber doctor` says which Blender was used.")
    return {key: result[key] for key in ("object_count", "frame_count", "blender")}


def blender_command() -> list[str]:
    """Return the command that runs the add-on's script in a process with bpy.

    Raises:
        MissingDependencyError: neither the bpy package nor a Blender is there.
    """
    if not _SCRIPT.is_file():
        raise MissingDependencyError(
            f"The add-on's {_SCRIPT.name} is not beside the worker.",
            "`limber scene` needs it.", "Run from a checkout of the project.")
    named = os.environ.get("LIMBER_SCENE_BLENDER")
    if named is None and importlib.util.find_spec("bpy") is not None:
        return [sys.executable, str(_SCRIPT)]
    blender = named or os.environ.get("LIMBER_BLENDER") or shutil.which("blender")
    if not blender:
        raise MissingDependencyError(
            "There is no bpy package in this Python and no Blender was found.",
            "A scene needs one of them.",
            "Install bpy (pip install 'limber[blender]'), or set LIMBER_BLENDER to a Blender.")
    return [blender, "--background", "--factory-startup", "--python-exit-code", "3",
            "--python", str(_SCRIPT)]
