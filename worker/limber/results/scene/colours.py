"""Colour scales: units, tick labels and colours."""

import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.files.atomic import write_atomically
from limber.core.json_values import plain
from limber.core.numerics.rigid import any_normal

# Colours as sRGB, evenly spaced; both maps stay monotonic in greyscale.
_COLOUR_MAPS = {
    "viridis": ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962",
                "#addc30", "#fde725"),
    "inferno": ("#1b0c41", "#4a0c6b", "#781c6d", "#a52c60", "#cf4446", "#ed6925", "#fb9b06",
                "#f7d13d", "#fcffa4"),
}
_MOST_DECADES = 1e3  # range of a logarithmic scale; lower values have its first colour
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))


def colour_scale(values: np.ndarray, title: str, unit: str, colours: str) -> dict[str, Any]:
    """Return a scale that spans ``values``, in ``viridis`` or ``inferno``: title, unit, low, high,
    log, ticks, stops, colours; and ``is_one``: all are mid-scale."""
    low, high = float(values.min()), float(values.max())
    is_one = high - low <= 1e-6 * abs(high)
    if is_one:
        # A single value: put it mid-scale, so that it has a colour and a label.
        low, high = (0.5 * low, 1.5 * low) if low > 0 else (low - 0.5, low + 0.5)
    log = low > 0 and high / low > 10.0
    if log:
        low = max(low, high / _MOST_DECADES)
    middle = float(np.sqrt(low * high)) if log else 0.5 * (low + high)
    ticks = [with_unit(value, unit, value if log else high) for value in (low, middle, high)]
    return {"title": title, "unit": unit, "low": low, "high": high, "log": log, "ticks": ticks,
            "stops": _stops(colours), "colours": colours, "is_one": is_one}


def colours_of(values: np.ndarray, scale: dict[str, Any]) -> np.ndarray:
    """Return linear colours of values by a scale, shape [n, 4]."""
    position = _scale_positions(values, scale)
    stops = np.array(scale["stops"])
    channels = [np.interp(position, stops[:, 0], stops[:, channel]) for channel in (1, 2, 3)]
    return np.column_stack([*channels, np.ones_like(position)])


def css_colours(values: np.ndarray, scale: dict[str, Any]) -> list[str]:
    """Return the colours of values by a scale, as style sheets and SVG write them."""
    linear = colours_of(values, scale)[:, :3]
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in
            np.round(255 * srgb).astype(int).tolist()]


def linear_of(srgb: np.ndarray) -> np.ndarray:
    """Return linear values of sRGB values between 0 and 1, as Blender expects colours."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def palette(name: str) -> np.ndarray:
    """Return the linear colours of levels 0 to 255, shape [256, 4]; see :func:`levels_of`."""
    scale = {"low": 0.0, "high": 255.0, "log": False, "stops": _stops(name)}
    return colours_of(np.arange(256.0), scale)


def levels_of(values: np.ndarray, scale: dict[str, Any]) -> np.ndarray:
    """Return the nearest of 256 evenly spaced colours of a scale for each value, as bytes."""
    return np.round(255 * _scale_positions(values, scale)).astype(np.uint8)


def _scale_positions(values: np.ndarray, scale: dict[str, Any]) -> np.ndarray:
    """Return the positions of values on a scale, 0 to 1."""
    low, high = scale["low"], scale["high"]
    if scale["log"]:
        values, low, high = np.log(np.maximum(values, low)), np.log(low), np.log(high)
    return np.clip((values - low) / (high - low), 0.0, 1.0)


def with_unit(value: float, unit: str, size: float) -> str:
    """Return ``value`` as text, with the prefix for ``size``; a fraction may be in %."""
    if not unit:
        return f"{value:.3g}"
    if unit == "%":
        return f"{100 * value:.3g} %"
    # A value that rounds up to a prefix gets it: 1 MPa, not 1e+03 kPa.
    factor, prefix = next((p for p in _PREFIXES if 1.0005 * abs(size) >= p[0]), (1.0, ""))
    return f"{value / factor:.3g} {prefix}{unit}"


def _stops(name: str) -> list[list[float]]:
    """Return rows ``[position 0..1, red, green, blue]``, linear."""
    colours = [linear_of(np.array([int(text[i:i + 2], 16) / 255 for i in (1, 3, 5)])).tolist()
               for text in _COLOUR_MAPS[name]]
    return [[number / (len(colours) - 1), *colour] for number, colour in enumerate(colours)]


# The file that passes a scene to Blender's process: arrays by name, and their meaning.

FORMAT = 2
"""Version of the .npz file; the add-on refuses any other."""


@dataclass
class SceneData:
    """Arrays by name and a dictionary that describes them; see limber.results.scene.animation"""

    arrays: dict[str, np.ndarray]
    info: dict[str, Any] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write one .npz file that ``numpy.load(path, allow_pickle=False)`` reads; the suffix is
        added."""
        text = json.dumps(plain(self.info), allow_nan=False)
        path = path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")
        # Not directly into the file: an archive that cannot be written raises again when it is
        # garbage-collected.
        content = io.BytesIO()
        np.savez(content, info=np.array(text), **self.arrays)
        write_atomically(path, content.getvalue())

    def write_gltf(self, path: Path, color: str) -> int:
        """Write the branch in the colours of ``color``, its paths and the scan as binary glTF, in
        metres; return the number of objects."""
        import trimesh

        solids = {"Branch": ("vertices", "faces", f"color:{color}")} | {
            self.info["paths"][key]["title"]: (f"rods:{key}", f"rod_faces:{key}",
                                               f"rod_color:{key}")
            for key in self.info["paths"] if key in self.info["rods"]}
        things: dict[str, Any] = {
            title: trimesh.Trimesh(self.arrays[points], self.arrays[faces], process=False,
                                   vertex_colors=self.arrays[colours])
            for title, (points, faces, colours) in solids.items()}
        if "cloud" in self.arrays:
            things["Scan"] = trimesh.PointCloud(self.arrays["cloud"])
        # Its y points up.
        scene = trimesh.Scene(things).apply_transform(
            [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
        write_atomically(path, scene.export(file_type="glb"))
        return len(things)


# Lines and points of a scene as thin rods and small balls, coloured by a value at each point.

_SIDES = 6


def add_rods(data: SceneData, name: str, title: str, points: np.ndarray, lines: np.ndarray,
             radius: float | np.ndarray, values: np.ndarray, scale: dict[str, Any], *,
             ball_from: int | None = None, ball_radius: float = 0.0) -> None:
    """Add lines [l, 2] between points [m], [n, 3], as rods of a radius [m], one for all or per
    point, coloured by ``values`` [n]: ``rods:NAME``, ``rod_faces:NAME``, ``rod_color:NAME`` and
    ``info["rods"][NAME]``. Points from ``ball_from`` on are balls of ``ball_radius`` [m]."""
    parts = [(*rods(points, np.asarray(lines, int).reshape(-1, 2), radius), 0)]
    if ball_from is not None:
        parts.append((*balls(points[ball_from:], ball_radius), ball_from))
    counts = np.cumsum([0, *(len(vertices) for vertices, *_ in parts)])
    faces = np.concatenate([part + count for (_, part, _, _), count in
                            zip(parts, counts[:-1], strict=True)])
    if not len(faces):
        return
    node = np.concatenate([part + first for _, _, part, first in parts])
    data.arrays |= {f"rods:{name}": np.concatenate([part for part, *_ in parts]),
                    f"rod_faces:{name}": faces,
                    f"rod_color:{name}": colours_of(np.asarray(values, float), scale)[node]}
    data.info["rods"][name] = {"title": title, "scale": scale}


def balls(points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [v, 3] m, triangles [f, 3] and the point of each vertex [v]: icosahedra."""
    golden = (1 + np.sqrt(5)) / 2
    base = np.array([[0.0, a, b] for a in (-1, 1) for b in (-golden, golden)])
    corners = np.concatenate([np.roll(base, turn, axis=1) for turn in range(3)])
    # Its triangles join corners that are 2 apart.
    near = np.abs(np.linalg.norm(corners[:, None] - corners, axis=2) - 2) < 1e-9
    triples = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)
               if near[i, j] and near[j, k] and near[i, k]]
    one = np.array([triple if np.linalg.det(corners[list(triple)]) > 0 else triple[::-1]
                    for triple in triples])
    corners *= radius / np.linalg.norm(corners[0])
    node = np.repeat(np.arange(len(points)), 12)
    faces = (12 * np.arange(len(points))[:, None, None] + one).reshape(-1, 3)
    return points[node] + np.tile(corners, (len(points), 1)), faces, node


def rods(points: np.ndarray, lines: np.ndarray, radius: float | np.ndarray,
         ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [v, 3] m, triangles [f, 3] and the point of each vertex [v] of open tubes;
    lines without length get none."""
    points = np.asarray(points, float)
    size = np.broadcast_to(np.asarray(radius, float), len(points))
    vector = points[lines[:, 1]] - points[lines[:, 0]]
    length = np.linalg.norm(vector, axis=1)
    lines, vector = lines[length > 0], vector[length > 0] / length[length > 0, None]
    first = any_normal(vector)
    second = np.cross(vector, first)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    ring = (first[:, None] * np.cos(angle)[:, None] + second[:, None] * np.sin(angle)[:, None])
    ends = points[lines][:, :, None] + size[lines][:, :, None, None] * ring[:, None]
    node = np.repeat(lines, _SIDES, axis=1).ravel()
    k = np.arange(_SIDES)
    after = (k + 1) % _SIDES
    one = np.concatenate([np.column_stack([k, after, k + _SIDES]),
                          np.column_stack([after, after + _SIDES, k + _SIDES])])
    faces = 2 * _SIDES * np.arange(len(lines))[:, None, None] + one
    return ends.reshape(-1, 3), faces.reshape(-1, 3), node
