"""The values that colour a branch in each frame of its motion, kept in its folder. No bpy.

A .blend keeps the values of only one frame. Those of all frames are in ``.viewport/MOTION.npz`` of
the branch folder, so that a closed and moved file still plays in colours.
"""

import errno
import json
import os
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..branch import branch_folder
from .scene_data import SceneData

_FOLDER = ".viewport"
_FORMAT = 1
_ERRORS = (OSError, ValueError, KeyError, TypeError, EOFError, RecursionError, MemoryError,
           zipfile.BadZipFile)


@dataclass(frozen=True)
class FrameValues:
    """Values of a motion's frames by name.

    Attributes:
        scalars: Values in their real unit, each [frames, v].
        levels: Index into the palette of each, bytes, each [frames, v].
        palettes: Linear colours, each [256, 4].
    """

    scalars: dict[str, np.ndarray]
    levels: dict[str, np.ndarray]
    palettes: dict[str, np.ndarray]

    def colours(self, name: str, palette: str, frame: int) -> np.ndarray:
        """Return the colours of a frame, shape [v, 4]."""
        return self.palettes[palette][self.levels[name][frame]]

    def names(self, frame_count: int, vertex_count: int) -> set[str]:
        """Return the available values of a motion of this size."""
        size = (frame_count, vertex_count)
        return {name for name, values in self.scalars.items()
                if values.shape == size and self.levels.get(name, values[:0]).shape == size}


def values_of(data: SceneData) -> FrameValues:
    """Return the values that the worker gave for each frame."""
    parts = {kind: {name.partition(":")[2]: array for name, array in data.arrays.items()
                    if name.startswith(f"{kind}:")}
             for kind in ("frame_scalar", "frame_level", "palette")}
    return FrameValues(parts["frame_scalar"], parts["frame_level"], parts["palette"])


def path_of(folder: Path, motion: str) -> Path:
    """Return the path of a motion's values in a branch folder."""
    return folder / _FOLDER / f"{motion}.npz"


def _frames_sha256(folder: Path, motion: str) -> str:
    """Return the checksum of the motion itself, which may be made again; empty without one."""
    path = folder / "frames" / f"{motion}.pc2"
    return branch_folder.file_sha256(path) if path.is_file() else ""


def keep(folder: Path, motion: str, values: FrameValues) -> None:
    """Write the values of a motion into the branch folder; OSError if that is impossible."""
    path = path_of(folder, motion)
    if path.name != f"{motion}.npz" or path.parent.is_symlink():
        # The folder, and the name in it, are not trusted.
        raise OSError(errno.EPERM, "a name or link in it points outside the branch folder")
    path.parent.mkdir(exist_ok=True)
    arrays = {f"{kind}:{name}": array for kind, named in (
        ("scalar", values.scalars), ("level", values.levels), ("palette", values.palettes))
        for name, array in named.items()}
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as stream:
            about = {"format": _FORMAT, "frames_sha256": _frames_sha256(folder, motion)}
            np.savez(stream, about=np.array(json.dumps(about)), **arrays)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def read(folder: Path, motion: str) -> FrameValues | None:
    """Return the cached values of a motion; None if they are incomplete, or of other frames."""
    try:
        with np.load(path_of(folder, motion), allow_pickle=False) as content:
            about = json.loads(str(content["about"]))
            if about.get("format") != _FORMAT or (
                    about.get("frames_sha256") != _frames_sha256(folder, motion)):
                return None
            parts: dict[str, dict[str, np.ndarray]] = {"scalar": {}, "level": {}, "palette": {}}
            for name in content.files:
                kind, _, key = name.partition(":")
                if kind in parts:
                    parts[kind][key] = content[name]
    except _ERRORS:
        return None
    found = FrameValues(parts["scalar"], parts["level"], parts["palette"])
    sound = all(colours.shape == (256, 4) for colours in found.palettes.values()) and all(
        level.dtype == np.uint8 for level in found.levels.values()) and all(
        np.isfinite(values).all() for values in found.scalars.values())
    return found if sound else None
