"""Point clouds with attributes: the type, and its PLY file."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Cloud:
    """Points and what is known of each.

    Attributes:
        points: Positions, shape [n, 3]; metres once they are in a branch folder.
        attributes: Name to array, shape [n] or [n, k]: ``normal`` [n, 3], ``color`` [n, 3] in
            0..255, and whatever scalars the file had.
        not_finite: Points of the file that were left away, since they are no numbers.
    """

    points: np.ndarray
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    not_finite: int = 0

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, chosen: np.ndarray) -> "Cloud":
        """Return the points at indices, or where a mask is true, with their attributes."""
        return Cloud(self.points[chosen], {k: v[chosen] for k, v in self.attributes.items()},
                     self.not_finite)

    def with_points(self, points: np.ndarray) -> "Cloud":
        """Return the cloud with other positions, attributes kept."""
        return Cloud(points, self.attributes, self.not_finite)

    def write_ply(self, path: Path, *, comment: str = "unit: m") -> None:
        """Write a binary PLY file: positions as double, attributes in their own types."""
        from plyfile import PlyData, PlyElement

        columns: list[tuple[str, np.ndarray]] = [
            (name, self.points[:, k].astype("<f8")) for k, name in enumerate("xyz")]
        for name, values in self.attributes.items():
            columns += _columns(name, values)
        table = np.empty(len(self.points), [(name, column.dtype) for name, column in columns])
        for name, column in columns:
            table[name] = column
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<",
                comments=[comment]).write(str(path))


def _columns(name: str, values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    if values.dtype.kind == "b":
        values = values.astype(np.uint8)
    if values.dtype.itemsize == 8 and values.dtype.kind in "iu":
        values = values.astype(np.int32)  # PLY has no 64-bit integers
    if values.ndim == 1:
        return [(name, values)]
    parts = {"normal": ("nx", "ny", "nz"), "color": ("red", "green", "blue")}.get(
        name, tuple(f"{name}_{k}" for k in range(values.shape[1])))
    if name == "color":
        values = values.astype(np.uint8)
    return [(part, values[:, k]) for k, part in enumerate(parts)]
