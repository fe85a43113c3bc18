"""Point clouds with attributes: the type, and its PLY file."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO

import numpy as np

from limber.core.errors import InputError
from limber.core.files.text_columns import three_of
from limber.geometry.cloud.columns import PARTS, ply_columns, valid_columns

POINTS = "\0points"
"""Name of the coordinates [n, 3] among columns of any name."""
LEFT_OUT = "\0left_out"
"""Name of the number of points that a reader left out, in the same columns."""
_LONGEST_TITLE = 1000  # characters of a title that a file's header may repeat


@dataclass(frozen=True)
class Cloud:
    """Points and their attributes.

    Attributes:
        points: Positions, shape [n, 3]; metres once they are in a branch folder.
        attributes: Name to array, shape [n] or [n, k]: ``normal`` [n, 3], ``color`` [n, 3] in
            0..255, and any scalars of the file.
        not_finite: Number of discarded points whose coordinates are not finite.
        titles: The file's name of an attribute, where it differs.
        unit: Unit of the points, if the file states it: m, cm, mm, um or in.
        notes: Information for the user about the file.
        left_out: Number of points left out during reading because others are next to them.
    """

    points: np.ndarray
    attributes: dict[str, np.ndarray] = field(default_factory=dict)
    not_finite: int = 0
    titles: dict[str, str] = field(default_factory=dict)
    unit: str | None = None
    notes: tuple[str, ...] = ()
    left_out: int = 0

    @classmethod
    def from_columns(cls, columns: dict[str, np.ndarray], titles: dict[str, str] | None = None,
                     ) -> "Cloud":
        """Sort named columns into positions, normals, colours and scalars.

        Raises:
            InputError: none are called x, y and z.
        """
        names = list(columns)
        axes = three_of("position", names)
        if axes is None:
            raise InputError(f"The columns are {', '.join(columns)}.", "x, y and z are missing.",
                             "Name the coordinates x, y, z.")
        used = {names[k] for k in axes}
        attributes: dict[str, np.ndarray] = {}
        for target in PARTS:
            if found := three_of(target, names):
                attributes[target] = np.stack([columns[names[k]] for k in found], axis=1)
                used |= {names[k] for k in found}
        attributes |= {name: np.ascontiguousarray(values) for name, values in columns.items()
                       if name not in used}
        points = np.stack([np.asarray(columns[names[k]], np.float64) for k in axes], axis=1)
        return cls(points, attributes, titles=titles or {})

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, chosen: np.ndarray) -> "Cloud":
        """Return the points at indices, or where a mask is true, with their attributes."""
        return replace(self, points=self.points[chosen],
                       attributes={k: v[chosen] for k, v in self.attributes.items()})

    def with_points(self, points: np.ndarray) -> "Cloud":
        """Return the cloud with other positions, attributes kept."""
        return replace(self, points=points)

    def with_valid_columns(self, taken: Collection[str] = ()) -> "Cloud":
        """Return the cloud with attributes valid for every writer, see :func:`valid_columns`.
        """
        attributes, titles = valid_columns(self.attributes, self.titles, len(self), taken)
        return replace(self, attributes=attributes, titles=titles)

    def write_ply(self, path: Path | IO[bytes], *comments: str) -> None:
        """Write a binary PLY file, or to a stream: positions as double, attributes in their types.

        Attributes get valid names; comments state their names in the scan's file.
        """
        from plyfile import PlyData, PlyElement

        valid = self.with_valid_columns()
        columns: list[tuple[str, np.ndarray]] = [
            (name, self.points[:, k].astype("<f8")) for k, name in enumerate("xyz")]
        for name, values in valid.attributes.items():
            columns += ply_columns(name, values)
        table = np.empty(len(self.points), [(name, column.dtype) for name, column in columns])
        for name, column in columns:
            table[name] = column
        titles = [f"column {name}: {title[:_LONGEST_TITLE]!a}"
                  for name, title in valid.titles.items()]
        PlyData([PlyElement.describe(table, "vertex")], byte_order="<",
                comments=["unit: m", *comments, *titles]).write(
                    str(path) if isinstance(path, Path) else path)

