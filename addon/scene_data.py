"""Reads what the worker says is to be shown of a branch: one .npz file, nothing pickled."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 1


class SceneDataError(ValueError):
    """The file is not one that this version of the add-on can show."""


@dataclass(frozen=True)
class SceneData:
    """Arrays by name, and what they are; the worker's limber.scene.data names them all."""

    arrays: dict[str, np.ndarray]
    info: dict[str, Any]

    @property
    def folder(self) -> Path:
        """The branch folder, absolute."""
        return Path(self.info["folder"])


def read_scene_data(path: Path) -> SceneData:
    """Read the file that ``limber scene --data FILE`` wrote.

    Raises:
        SceneDataError: not such a file, or of another version of Limber.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
        info = json.loads(str(arrays.pop("info")))
    except (OSError, ValueError, KeyError) as error:
        raise SceneDataError(f"{path} cannot be shown ({error}).") from error
    if info.get("format") != FORMAT:
        raise SceneDataError(
            f"The worker's data has format {info.get('format')}, this add-on shows {FORMAT}. "
            "Install the add-on and the worker of one version of Limber.")
    return SceneData(arrays, info)
