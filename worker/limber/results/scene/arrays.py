"""The file that passes a scene to Blender's process: arrays by name, and their meaning."""

import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.files.atomic import write_atomically
from limber.core.json_values import plain

FORMAT = 2
"""Version of the .npz file; the add-on refuses any other."""


@dataclass
class SceneData:
    """Arrays by name and a dictionary that describes them; see limber.results.scene.contents"""

    arrays: dict[str, np.ndarray]
    info: dict[str, Any] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write one .npz file that ``numpy.load(path, allow_pickle=False)`` reads.

        A path without the suffix is given it.
        """
        text = json.dumps(plain(self.info), allow_nan=False)
        path = path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")
        # Not directly into the file: an archive that cannot be written raises again when it is
        # garbage-collected.
        content = io.BytesIO()
        np.savez(content, info=np.array(text), **self.arrays)
        write_atomically(path, content.getvalue())
