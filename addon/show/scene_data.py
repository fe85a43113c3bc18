"""Reads the worker's data that show a branch: one .npz file without pickled data.

The file comes from another process. It may have another version or be truncated, so every size,
shape and index is checked before use.
"""

import json
import re
import tokenize
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 2
_LARGEST_BYTES = 4 << 30
_MOST_ARRAYS = 500

# Of the arrays that are drawn. Dimensions by letter: v vertices, f faces, n skeleton nodes, k
# control points, t targets, s frames, m observed points, w points to be seen, p points of a path
# (each has its own), q nodes of a search tree, u vertices and x faces of rods (likewise), y colours
# of a palette, l positions along an arm, h, j, z points along the edges of a grid. i: integers,
# b: booleans, r: real numbers.
_SHAPES = {
    "vertices": "v3 r", "faces": "f3 i", "scalar": "v r", "color": "v4 r", "frame_scalar": "sv r",
    "frame_level": "sv i", "palette": "y4 r",
    "frame_times": "s r", "frame_energy": "s r",
    "skeleton": "n3 r", "skeleton_parent": "n i", "skeleton_radius": "n r",
    "skeleton_radius_sigma": "n r", "skeleton_probability": "n r", "skeleton_flags": "n i",
    "control_points": "k3 r", "control_points_radius": "k r", "control_points_motion": "sk3 r",
    "grasp": "13 r", "grasp_radius": "1 r", "grasp_motion": "s3 r",
    "targets": "t3 r", "targets_radius": "t r", "targets_motion": "st3 r",
    "path": "p3 r", "tree": "q3 r", "tree_parent": "q i",
    "observation_motion": "sm3 r", "observation_seen": "sm b",
    "rods": "u3 r", "rod_faces": "x3 i", "rod_color": "u4 r",
    "energy_grid": "hjz r", "energy_grid_color": "hjz4 r",
    "solid": "u3 r", "solid_faces": "x3 i",
    "robot_starts": "sl3 r", "robot_ends": "sl3 r", "robot_radii": "l r",
    "view_points": "w3 r", "view_direction": "3 r"}
_NEEDED = ("vertices", "faces", "view_points", "view_direction")
_NEEDED_INFO = {"name": str, "folder": str, "scalars": dict, "paths": dict, "notes": list,
                "source": dict, "alignment": list}


class SceneDataError(ValueError):
    """This version of the add-on cannot show the file."""


@dataclass(frozen=True)
class SceneData:
    """Arrays by name, and their description: limber.results.scene.animation lists them all."""

    arrays: dict[str, np.ndarray]
    info: dict[str, Any]

    @property
    def folder(self) -> Path:
        """The branch folder, absolute."""
        return Path(self.info["folder"])


def read_scene_data(path: Path) -> SceneData:
    """Read the file that ``limber scene --data FILE`` wrote.

    Raises:
        SceneDataError: the file is of another kind, truncated, of another version of Limber, or
            its arrays do not match each other.
    """
    try:
        arrays = _arrays(Path(path))
        info = json.loads(str(arrays.pop("info")))
    except (OSError, ValueError, KeyError, TypeError, EOFError, RecursionError, MemoryError,
            NotImplementedError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile) as error:
        raise SceneDataError(f"{path} cannot be shown ({error}).") from error
    if not isinstance(info, dict) or info.get("format") != FORMAT:
        found = info.get("format") if isinstance(info, dict) else None
        raise SceneDataError(
            f"The worker's data has format {found}, but this add-on reads format {FORMAT}. "
            "Install the add-on and the worker of the same version of Limber.")
    trouble = _info_trouble(info) or _arrays_trouble(arrays) or _pairs_trouble(arrays, info)
    if trouble:
        raise SceneDataError(f"{path} cannot be shown ({trouble}).")
    return SceneData(arrays, info)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file, if their sizes match their headers."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) > _MOST_ARRAYS or sum(m.file_size for m in members) > _LARGEST_BYTES:
            raise ValueError("it is too large")
        for member in members:
            if member.compress_type != zipfile.ZIP_STORED:
                # Uncompressed data cannot grow while it is read.
                raise ValueError(f"{member.filename} is compressed")
            with archive.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                read = {(1, 0): np.lib.format.read_array_header_1_0,
                        (2, 0): np.lib.format.read_array_header_2_0}.get(version)
                if read is None:
                    raise ValueError(f"{member.filename} has an unknown version")
                shape, _, kind = read(stream)
                size = kind.itemsize
                for count in shape:
                    size *= count
                if kind.hasobject or size + stream.tell() != member.file_size:
                    raise ValueError(f"{member.filename} does not match its header")
    with np.load(path, allow_pickle=False) as content:
        return {name: content[name] for name in content.files}


def _info_trouble(info: dict[str, Any]) -> str:
    for name, kind in _NEEDED_INFO.items():
        if not isinstance(info.get(name), kind):
            return f"its {name} is missing"
    if np.shape(info["alignment"]) != (4, 4):
        return "its alignment is not a matrix"
    return next((f"its graph {name} is invalid"
                 for name, graph in (info.get("graphs") or {}).items() if not _is_graph(graph)), "")


def _is_graph(graph: Any) -> bool:
    """Whether a graph can be drawn: positions as fractions of a frame, texts at ticks."""
    try:
        rows = [row for line in graph["lines"] for row in line["points"]]
        bands = [row for band in graph["bands"] for row in band["rows"]]
        ticks = [tick for axis in ("x", "y") for tick in graph[axis]["ticks"]]
        colours = [part["color"] for part in (*graph["lines"], *graph["bands"])]
        words = [graph["title"], graph["x"]["title"], graph["y"]["title"],
                 *(part["label"] for part in (*graph["lines"], *graph["bands"])),
                 *(text for _, text in ticks)]
        numbers = [np.array(rows, float).reshape(-1, 2), np.array(bands, float).reshape(-1, 3),
                   np.array(colours, float).reshape(-1, 3),
                   np.array([share for share, _ in ticks], float),
                   np.array(graph.get("cursor") or (), float).reshape(-1)]
    except (KeyError, TypeError, ValueError):
        return False
    return all(isinstance(text, str) for text in words) and all(
        np.isfinite(part).all() for part in numbers)


def _arrays_trouble(arrays: dict[str, np.ndarray]) -> str:
    """Return which array is missing or has a wrong shape or type, or an empty text.

    Arrays unknown to this version are accepted: they are not drawn.
    """
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        return f"{missing[0]} is missing"
    sizes: dict[str, int] = {}
    for name, array in arrays.items():
        kind, _, key = name.partition(":")
        if kind not in _SHAPES:
            continue
        wanted, number = _SHAPES[kind].split()
        letters = [f"{letter}:{key}" if letter in "pqux" else letter
                   for letter in re.findall(r"\d|[a-z]", wanted)]
        fits = len(letters) == array.ndim and all(
            count == (int(letter) if letter.isdigit() else sizes.setdefault(letter, count))
            for letter, count in zip(letters, array.shape, strict=True))
        if not fits:
            return f"{name} has the invalid shape {array.shape}"
        if array.dtype.kind not in {"r": "f", "i": "iu", "b": "b"}[number]:
            return f"{name} has the invalid type {array.dtype}"
        if number == "r" and not np.isfinite(array).all():
            return f"{name} contains values that are not finite"
    surfaces = [("faces", "vertices")] + [
        (name, name.replace(faces, vertices, 1)) for name in arrays
        for faces, vertices in (("rod_faces:", "rods:"), ("solid_faces:", "solid:"))
        if name.startswith(faces)]
    for name, vertices in surfaces:
        faces, count = arrays[name], len(arrays.get(vertices, ()))
        if len(faces) and (faces.min() < 0 or faces.max() >= count):
            return f"{name} contains indices outside the {count} vertices"
    for name, parents in arrays.items():
        if name.partition(":")[0] in ("skeleton_parent", "tree_parent") and len(parents) and (
                parents.min() < -1 or (parents >= np.arange(len(parents))).any()):
            return f"{name} is not a tree"
    return ""


def _pairs_trouble(arrays: dict[str, np.ndarray], info: dict[str, Any]) -> str:
    """Return what ``info`` names that the arrays do not have, or an empty text."""
    wanted = [f"{kind}:{name}" for name in info["scalars"] for kind in ("scalar", "color")]
    wanted += [f"path:{name}" for name in info["paths"]]
    wanted += [f"{kind}:{name}" for name in info.get("trees") or {}
               for kind in ("tree", "tree_parent")]
    wanted += [f"frame_scalar:{name}" for name in info.get("frame_scalars") or {}]
    wanted += ["observation_seen"] * ("observation_motion" in arrays)
    wanted += ["energy_grid", "energy_grid_color"] * bool(info.get("energy_grid"))
    wanted += [f"{kind}:{name}" for name in info.get("rods") or {}
               for kind in ("rods", "rod_faces", "rod_color")]
    wanted += [f"{kind}:{name}" for name in info.get("cell") or {}
               for kind in ("solid", "solid_faces")]
    if len(arrays.get("targets", ())) != len(info.get("targets") or ()):
        return "the number of targets does not match the number of their names"
    for name in ("grasp", "control_points", "targets"):
        wanted += [f"{name}_radius"] * (name in arrays)
        wanted += [f"{name}_motion"] * (name in arrays and bool(info.get("frames")))
    missing = [name for name in wanted if name not in arrays]
    if missing:
        return f"{missing[0]} is missing"
    frames = info.get("frames")
    times = arrays.get("frame_times")
    if frames and (times is None or len(times) != frames.get("count")):
        return "the number of frame times does not match the number of frames"
    return ""
