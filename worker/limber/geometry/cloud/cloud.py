"""Point clouds with attributes: the type, and its PLY file."""

import re
import unicodedata
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import InputError
from limber.core.files.text_columns import three_of

# Columns of a cloud: names and shapes that every writer of clouds accepts.

PARTS = {"normal": ("nx", "ny", "nz"), "color": ("red", "green", "blue")}
"""Attributes of three numbers per point, and their columns in files."""
_LONGEST_NAME = 60
"""Most characters of a name; Blender cuts the names of attributes at 63."""
_RESERVED = frozenset({"x", "y", "z", *PARTS, *(name for parts in PARTS.values()
                                              for name in parts)})
"""Reserved names: positions, normals and colours only."""


def property_names(titles: Iterable[str], taken: Collection[str] = ()) -> list[str]:
    """Return a name for each title, all different when case is ignored and none in ``taken``: ASCII
    letters, digits and underscores, as PLY needs. A title that is such a name is kept."""
    used = {name.lower() for name in taken}
    names = []
    for title in titles:
        plain = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode()
        if not re.fullmatch(r"\w+", plain, re.ASCII):
            plain = re.sub(r"[\W_]+", "_", plain, flags=re.ASCII).strip("_") or "unnamed"
        name, number = plain[:_LONGEST_NAME], 1
        while name.lower() in used:
            number += 1
            end = f"_{number}"
            name = plain[:_LONGEST_NAME - len(end)] + end
        used.add(name.lower())
        names.append(name)
    return names


def valid_columns(attributes: dict[str, np.ndarray], titles: dict[str, str], count: int,
                  taken: Collection[str] = ()) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return attributes that every writer accepts, and the file's names of those renamed:
    ``normal`` and ``color`` (0..255) [n, 3], and columns with a number for each point."""
    kept: dict[str, np.ndarray] = {}
    columns: list[tuple[str, str, np.ndarray]] = []
    for name, values in attributes.items():
        if values.dtype.kind not in "biuf" or values.shape[:1] != (count,):
            continue
        if name in PARTS and values.ndim == 2 and values.shape[1] >= 3:
            kept[name] = _bytes(values[:, :3]) if name == "color" else values[:, :3]
        else:
            columns += _split(titles.get(name, name), name, values)
    names = property_names((name for _, name, _ in columns), _RESERVED | set(taken))
    renamed = {name: title for name, (title, _, _) in zip(names, columns, strict=True)
               if name != title}
    return kept | {name: values for name, (_, _, values) in zip(names, columns, strict=True)
                   }, renamed


def _bytes(color: np.ndarray) -> np.ndarray:
    """Colours in 0..255, converted from 0..255, fractions of 1 or 16 bits."""
    if color.dtype == np.uint8:
        return color
    values = np.nan_to_num(color.astype(float), posinf=0.0, neginf=0.0)
    top = values.max(initial=0.0)
    if top > 255:
        values = values / 257
    elif top < 1.01 and color.dtype.kind == "f":  # some programs round to a little over 1
        values = values * 255
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _split(title: str, name: str, values: np.ndarray) -> list[tuple[str, str, np.ndarray]]:
    """Title, name and numbers of each column of an attribute."""
    if values.ndim == 1:
        return [(title, name, values)]
    flat = values.reshape(len(values), -1)
    return [(f"{title}_{k}", f"{name}_{k}", flat[:, k]) for k in range(flat.shape[1])]


def ply_columns(name: str, values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return the PLY properties of a valid attribute, in types that PLY has."""
    values = _in_ply_type(values)
    return [(part, values[:, k]) for k, part in enumerate(PARTS[name])] if name in PARTS else [
        (name, values)]


def _in_ply_type(values: np.ndarray) -> np.ndarray:
    """Numbers in one of PLY's types: up to 32 bits for integers, float or double."""
    kind, size = values.dtype.kind, values.dtype.itemsize
    if kind == "b":
        return values.astype(np.uint8)
    if kind == "f":
        return values.astype(np.float64 if size >= 8 else np.float32)
    if size < 8:
        return values.astype(values.dtype.newbyteorder("="))
    low, high = (int(values.min()), int(values.max())) if len(values) else (0, 0)
    small = np.iinfo(np.int32)
    return values.astype(np.int32 if small.min <= low and high <= small.max else np.float64)


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


# Order and axes of a cloud that do not depend on its file.
#
# Choices point by point, or in cells of a grid, must not depend on the order or rotation of a file:
# the same plant must give the same result.

_STEP = 1e-6  # fraction of the cloud's size: finer than any scanner resolves, coarser than rounding


@dataclass(frozen=True)
class OwnFrame:
    """Points [n, 3] [m] in the cloud's own ``order`` and ``axes`` [3, 3] (columns) from ``middle``,
    on a grid that hides rounding: a moved, rotated or scaled file is rounded differently."""

    coordinates: np.ndarray
    order: np.ndarray
    middle: np.ndarray
    axes: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> "OwnFrame":
        """The frame of points [m], shape [n, 3]."""
        order = own_order(points)
        middle = points[order].mean(axis=0)
        offset = points[order] - middle
        axes = own_axes(offset)
        coordinates = offset @ axes
        size = float(np.linalg.norm(np.ptp(coordinates, axis=0)))
        step = 2.0**np.floor(np.log2(max(_STEP * size, 1e-300)))
        return cls(np.round(coordinates / step) * step, order, middle, axes)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return the positions of points in this frame, shape [..., 3]."""
        return (points - self.middle) @ self.axes

    def outside(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the points at positions of this frame, shape [..., 3]."""
        return coordinates @ self.axes.T + self.middle


def own_order(points: np.ndarray) -> np.ndarray:
    """Return indices [n] of points [n, 3] in an order that depends only on their positions. By
    distance from the middle alone, regions grown from the first points would start there."""
    order = np.argsort(np.linalg.norm(points - points.mean(axis=0), axis=1), kind="stable")
    return order[np.random.default_rng(0).permutation(len(points))]


def own_axes(points: np.ndarray) -> np.ndarray:
    """The directions in which a cloud extends, longest first, as columns, shape [3, 3]. They are
    right-handed; the first two point towards the longer tails."""
    offset = points - points.mean(axis=0)
    axes = np.linalg.eigh(offset.T @ offset)[1][:, ::-1]
    axes = axes * np.where(((offset @ axes)**3).sum(axis=0) < 0, -1.0, 1.0)
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes


# Even thinning of a cloud.


def thinned(points: np.ndarray, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` points, one from each cell of a grid along the cloud's own axes,
    so that a rotated cloud is thinned in the same way."""
    if len(points) <= limit:
        return np.arange(len(points))
    points = points @ own_axes(points)
    low = points.min(axis=0)
    # Points are on a surface: the cell size grows with the square root of the excess of points.
    size = float(np.median(cKDTree(points).query(
        points[:: max(len(points) // 2000, 1)], k=2)[0][:, 1])) * np.sqrt(len(points) / limit)
    size = max(size, 1e-6 * float(np.ptp(points, axis=0).max()), 1e-12)
    for _ in range(40):
        cell = np.floor((points - low) / size).astype(np.int64)
        extent = cell.max(axis=0) + 1
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        _, first = np.unique(key, return_index=True)
        if len(first) <= limit:
            return np.sort(first)
        size *= max(1.03, np.sqrt(len(first) / limit))
    return np.sort(first)
