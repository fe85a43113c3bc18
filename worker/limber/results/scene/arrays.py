"""The file that passes a scene to Blender's process: arrays by name, and their meaning."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.json_values import plain

FORMAT = 2
"""Of the .npz file; the add-on refuses another one."""


@dataclass
class SceneData:
    """Arrays by name and a dictionary that describes them; see limber.results.scene.contents"""

    arrays: dict[str, np.ndarray]
    info: dict[str, Any] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write one .npz file that ``numpy.load(path, allow_pickle=False)`` reads."""
        text = json.dumps(plain(self.info), allow_nan=False)
        np.savez(path, info=np.array(text), **self.arrays)
