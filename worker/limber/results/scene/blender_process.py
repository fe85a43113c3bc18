"""The process with bpy that makes a scene: the add-on's ``make_scene.py`` on prepared data.

The core never imports bpy. The ``bpy`` package in this Python, or a Blender program, runs the
script.
"""

import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from limber.core.errors import Command, MissingDependencyError, Text, WorkError
from limber.core.optional import how_to_install
from limber.core.progress import Progress

_OLDEST = (4, 2)
"""Blender that the add-on's script runs in."""
_ANSWER_SECONDS = 20.0
LIBRARIES = ("libegl1", "libgl1", "libice6", "libsm6", "libx11-6", "libxext6", "libxfixes3",
             "libxi6", "libxkbcommon0", "libxrender1", "libxxf86vm1", "libgomp1")
"""Debian's packages that the bpy package is linked against; scripts/setup reads them too."""


def make_scene(arguments: list[object], progress: Progress) -> dict[str, Any]:
    """Run the script with ``arguments``; return its output and the Blender used.
    MissingDependencyError without bpy package and Blender, or if bpy does not load."""
    from limber.core.processes.child import run_json_process

    progress(0.0, "starting Blender")
    command = blender_command()
    try:
        result = run_json_process("scene", [*command, "--", *map(str, arguments)], progress,
                                  fix=Text(Command("doctor"), " states which Blender was used."))
    except WorkError as error:
        if command[0] != sys.executable or (reason := _why_bpy_does_not_load()) is None:
            raise
        raise MissingDependencyError(
            f"The bpy package does not load ({reason}).",
            "It needs a desktop's libraries, even where it opens no window."
            if ".so" in reason else "A scene needs it, or a Blender.",
            (f"On Debian or Ubuntu, as root: apt-get install {' '.join(LIBRARIES)}. "
             if ".so" in reason else "") + "Or set LIMBER_SCENE_BLENDER to a Blender.") from error
    return {key: result[key] for key in ("object_count", "frame_count", "blender")}


def _why_bpy_does_not_load() -> str | None:
    """The error of importing bpy in a process of its own; None if it loads."""
    done = subprocess.run([sys.executable, "-c", "import bpy"], capture_output=True, text=True,
                          check=False)
    return (done.stderr.strip().splitlines() or ["it ended without a word"])[-1] if (
        done.returncode) else None


def blender_command() -> list[str]:
    """Return the command that runs the add-on's script in a process with bpy;
    MissingDependencyError without bpy package and Blender, or without the script."""
    script = str(scene_script())
    named = os.environ.get("LIMBER_SCENE_BLENDER")
    blender = named or os.environ.get("LIMBER_BLENDER") or shutil.which("blender")
    has_bpy = named is None and importlib.util.find_spec("bpy") is not None
    if has_bpy and not _is_older_than_bpy(blender):
        return [sys.executable, script]
    if not blender:
        raise MissingDependencyError(
            "There is no bpy package in this Python and no Blender was found.",
            "A scene needs one of the two.",
            f"{how_to_install('blender')} Or set LIMBER_BLENDER to a Blender.")
    return [blender, "--background", "--factory-startup", "--python-exit-code", "3",
            "--python", script]


def _is_older_than_bpy(blender: str | None) -> bool:
    """Whether a Blender shows our scenes but may be unable to open files of the bpy package. That
    Blender then writes them."""
    if not blender:
        return False
    try:
        version_text = subprocess.run([blender, "--version"], capture_output=True, text=True,
                                      check=False,
                                      timeout=_ANSWER_SECONDS).stdout
        versions = [re.match(r"(?:Blender )?(\d+)\.(\d+)", text)
                    for text in (version_text, importlib.metadata.version("bpy"))]
    except (OSError, subprocess.TimeoutExpired, importlib.metadata.PackageNotFoundError):
        # A Blender that does not respond cannot write.
        return False
    own, bpy = ((0, 0) if found is None else (int(found[1]), int(found[2])) for found in versions)
    return _OLDEST <= own < bpy


def scene_script() -> Path:
    """Return the path of ``make_scene.py``, the wheel's own copy or the checkout's;
    MissingDependencyError if there is none."""
    here = Path(__file__).parent
    candidates = [folder / "addon" / "show" / "make_scene.py" for folder in (here, here.parents[3])]
    for path in candidates:
        if path.is_file():
            return path
    raise MissingDependencyError(f"The add-on's {candidates[0].name} is not installed.",
                                 Text(Command("scene"), " needs it."), "Install Limber from its "
                                 "wheel, or run it from a checkout of the project.")
