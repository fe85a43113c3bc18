"""What a Blender scene shows of a branch folder: arrays ready to show, and what they mean.

The add-on computes nothing, so colours, tick labels and the direction of view are worked out
here. One ``.npz`` file carries them to Blender's process: plain arrays (nothing pickled), and
``info``, a JSON text. Vertices are those of the mesh's surface in the order of the PC2 frames:
``mesh.surface_faces()`` compacted by ``numpy.unique``.
"""

import csv
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from limber.errors import BranchFolderError
from limber.geometry.tets.tet_mesh import TetMesh
from limber.plain import plain
from limber.store import Branch

FORMAT = 1
"""Of the .npz file; the add-on refuses another one."""

# Colours as sRGB, evenly spaced; both maps keep their order when seen in grey.
_COLOUR_MAPS = {
    "viridis": ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962",
                "#addc30", "#fde725"),
    "inferno": ("#1b0c41", "#4a0c6b", "#781c6d", "#a52c60", "#cf4446", "#ed6925", "#fb9b06",
                "#f7d13d", "#fcffa4"),
}
_MOST_DECADES = 1e3  # a logarithmic scale spans at most this; what is below has its first colour
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"))


@dataclass
class SceneData:
    """Arrays by name and a dictionary that says what they are; see :func:`scene_data`."""

    arrays: dict[str, np.ndarray]
    info: dict[str, Any] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write one .npz file that ``numpy.load(path, allow_pickle=False)`` reads."""
        text = json.dumps(plain(self.info), allow_nan=False)
        np.savez(path, info=np.array(text), **self.arrays)


def scene_data(branch: Branch, plan: str | None = None) -> SceneData:
    """Gather what there is to show of ``branch``; ``plan`` names a path, the newest by default.

    Arrays: ``vertices`` [v, 3] m, ``faces`` [f, 3]; for each name in ``info["scalars"]`` the
    values ``scalar:NAME`` [v] and linear colours ``color:NAME`` [v, 4]; ``control_points``
    [k, 3] m and ``grasp`` [1, 3] m, with the radii of the balls that mark them,
    ``control_points_radius`` [k] m and ``grasp_radius`` [1] m; for each of ``info["paths"]`` the
    points ``path:NAME`` [p, 3] m; ``grasp_motion`` [frames, 3] m, ``control_points_motion``
    [frames, k, 3] m and ``frame_energy`` [frames] J; ``view_points`` [n, 3] m and
    ``view_direction`` [3].

    Raises:
        BranchFolderError: no mesh yet, no such plan, or frames of another mesh.
    """
    mesh = TetMesh.read(branch.require("mesh.vtu", "reconstruct"))
    faces = mesh.surface_faces()
    used, compact = np.unique(faces, return_inverse=True)
    data = SceneData({"vertices": mesh.nodes[used], "faces": compact.reshape(-1, 3)})
    data.info = {"format": FORMAT, "name": branch.name, "folder": str(branch.folder.resolve()),
                 "unit": "m", "scalars": {}, "paths": {}, "notes": [_size_note(branch, mesh)]}
    data.info |= {"source": branch.manifest.source, "alignment": _alignment(branch)}
    _add_scalars(data, mesh, used)
    _add_markers(data, mesh, used)
    plan = _add_plan(data, branch, plan)
    _add_frames(data, branch, plan, len(used))
    _add_view(data)
    data.arrays = {name: np.ascontiguousarray(array) for name, array in data.arrays.items()}
    return data


def _size_note(branch: Branch, mesh: TetMesh) -> str:
    entry = branch.manifest.stages.get("reconstruct") or branch.manifest.stages.get("mesh")
    length = (entry.result if entry else {}).get("length_m")
    extent = f"{length:.2f} m of centreline" if length else f"{np.ptp(mesh.nodes[:, 2]):.2f} m high"
    return f"{extent}, {mesh.tet_count} tetrahedra"


def _alignment(branch: Branch) -> np.ndarray:
    """Return the 4x4 matrix that takes points of the scan's file to the branch's frame [m]."""
    place = branch.manifest.alignment
    matrix = np.eye(4)
    matrix[:3, 3] = place.apply(np.zeros((1, 3)))[0]
    matrix[:3, :3] = (place.apply(np.eye(3)) - matrix[:3, 3]).T
    return matrix


def _add_scalars(data: SceneData, mesh: TetMesh, used: np.ndarray) -> None:
    if "young" in mesh.cell_data:
        young = at_nodes(mesh, mesh.cell_data["young"])[used]
        _add_scalar(data, "young", young, "Young's modulus", "Pa", "viridis")


def _add_scalar(data: SceneData, name: str, values: np.ndarray, title: str, unit: str,
                colours: str) -> None:
    scale = _colour_scale(values, title, unit, colours)
    data.info["scalars"][name] = scale
    data.arrays[f"scalar:{name}"] = np.asarray(values, float)
    data.arrays[f"color:{name}"] = _colours(values, scale)


def at_nodes(mesh: TetMesh, values: np.ndarray) -> np.ndarray:
    """Return values of tetrahedra, shape [tet_count], averaged at each node by volume, [n]."""
    volume = np.abs(mesh.volumes)
    total, weight = np.zeros(mesh.node_count), np.zeros(mesh.node_count)
    for corner in mesh.tets.T:
        np.add.at(total, corner, volume * np.asarray(values, float))
        np.add.at(weight, corner, volume)
    return total / np.maximum(weight, np.finfo(float).tiny)


def _colour_scale(values: np.ndarray, title: str, unit: str, colours: str) -> dict[str, Any]:
    low, high = float(values.min()), float(values.max())
    if high - low <= 1e-6 * abs(high):
        # One value everywhere: put it in the middle, so that it has a colour and a label.
        low, high = (0.5 * low, 1.5 * low) if low > 0 else (low - 0.5, low + 0.5)
    log = low > 0 and high / low > 10.0
    if log:
        low = max(low, high / _MOST_DECADES)
    middle = float(np.sqrt(low * high)) if log else 0.5 * (low + high)
    ticks = [_with_unit(value, unit, value if log else high) for value in (low, middle, high)]
    return {"title": title, "unit": unit, "low": low, "high": high, "log": log, "ticks": ticks,
            "stops": _stops(colours)}


def _with_unit(value: float, unit: str, size: float) -> str:
    """Return ``value`` in words, with the prefix that suits ``size``."""
    # What rounds up to a prefix gets it: 1 MPa, not 1e+03 kPa.
    factor, prefix = next((p for p in _PREFIXES if 1.0005 * abs(size) >= p[0]), (1.0, ""))
    return f"{value / factor:.3g} {prefix}{unit}"


def _stops(name: str) -> list[list[float]]:
    """Return rows ``[position 0..1, red, green, blue]``, linear as Blender wants colours."""
    colours = [_linear_from_hex(text) for text in _COLOUR_MAPS[name]]
    return [[number / (len(colours) - 1), *colour] for number, colour in enumerate(colours)]


def _linear_from_hex(text: str) -> list[float]:
    srgb = np.array([int(text[i:i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return [float(value) for value in linear]


def _colours(values: np.ndarray, scale: dict[str, Any]) -> np.ndarray:
    low, high = scale["low"], scale["high"]
    if scale["log"]:
        values, low, high = np.log(values), np.log(low), np.log(high)
    place = np.clip((values - low) / (high - low), 0.0, 1.0)
    stops = np.array(scale["stops"])
    channels = [np.interp(place, stops[:, 0], stops[:, channel]) for channel in (1, 2, 3)]
    return np.column_stack([*channels, np.ones_like(place)])


def _add_markers(data: SceneData, mesh: TetMesh, used: np.ndarray) -> None:
    """Add control points, grasp and base, as far as the mesh names them."""
    points = mesh.point_data
    if "control_point" in points:
        index = np.asarray(points["control_point"]).astype(int)
        nodes = [np.flatnonzero(index == k) for k in range(index.max() + 1)]
        data.arrays["control_points"] = np.array(
            [mesh.nodes[at].mean(axis=0) for at in nodes if len(at)]).reshape(-1, 3)
    if "grasp" in points:
        at = np.flatnonzero(np.asarray(points["grasp"]) > 0)
        if len(at):
            data.arrays["grasp"] = mesh.nodes[at].mean(axis=0).reshape(1, 3)
    for name, share in (("control_points", 0.011), ("grasp", 0.012)):
        if len(data.arrays.get(name, ())):
            data.arrays[f"{name}_radius"] = _marker_radii(
                data.arrays[name], data.arrays["vertices"], share)
    if "fixed" in points:
        fixed = data.arrays["vertices"][np.asarray(points["fixed"])[used] > 0]
        if len(fixed):
            middle = (fixed.min(axis=0) + fixed.max(axis=0)) / 2
            radius = np.linalg.norm((fixed - middle)[:, :2], axis=1).max()
            data.info["base"] = {"centre_m": middle, "top_m": fixed[:, 2].max(),
                                 "radius_m": radius}


def _marker_radii(points: np.ndarray, vertices: np.ndarray, share: float) -> np.ndarray:
    """Return radii [m] of balls at ``points`` that are seen: as a share of all, and not inside."""
    distance = np.linalg.norm(points[:, None] - vertices, axis=2)
    around = np.sort(distance, axis=1)[:, :4].mean(axis=1)
    least = share * np.ptp(vertices, axis=0).max()
    return np.clip(1.35 * around, least, 2.5 * least)


def _add_plan(data: SceneData, branch: Branch, plan: str | None) -> str | None:
    plans = [key.split(":", 1)[1] for key in branch.manifest.stages if key.startswith("plan:")]
    if plan is None:
        if not plans:
            return None
        plan = max(plans, key=lambda name: branch.manifest.stages[f"plan:{name}"].finished)
    summary = json.loads(branch.require(f"plans/{plan}.json", f"plan --name {plan}").read_text(
        encoding="utf-8"))
    for key, name, title in (("plan", plan, "D-RRT*"), ("baseline", f"{plan}-baseline", "RRT*")):
        if not branch.has(f"plans/{name}.csv"):
            continue
        data.arrays[f"path:{key}"] = _positions(branch.path(f"plans/{name}.csv"))
        data.info["paths"][key] = {"title": title, "note": _path_note(summary.get(key) or {})}
    data.info["plan"] = plan
    data.info["goal"] = _goal(summary.get("goal") or {}, data.arrays.get("path:plan"))
    saved, added = summary.get("energy_saved_percent"), summary.get("length_added_percent")
    if saved is not None and added is not None:
        data.info["notes"].append(f"energy {-saved:+.0f} %, length {added:+.0f} % against RRT*")
    return plan


def _positions(path: Path) -> np.ndarray:
    """Return the columns x_m, y_m, z_m of a path, shape [p, 3]."""
    with open(path, encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    try:
        points = np.array([[float(row[c]) for c in ("x_m", "y_m", "z_m")] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise BranchFolderError(f"{path} is not a path ({error}).",
                                "Columns x_m, y_m and z_m with numbers were expected.",
                                "Run `limber plan` again.") from error
    if len(points) == 0 or not np.isfinite(points).all():
        raise BranchFolderError(f"{path} has no finite points.", "There is nothing to show.",
                                "Run `limber plan` again.")
    return points


def _path_note(summary: dict[str, Any]) -> str:
    parts = []
    if summary.get("length_m") is not None:
        parts.append(f"{100 * summary['length_m']:.1f} cm")
    if summary.get("energy_sum_nmm") is not None:
        total = summary["energy_sum_nmm"]
        parts.append(f"{total:.0f} N mm" if abs(total) >= 100 else f"{total:.3g} N mm")
    return ", ".join(parts)


def _goal(goal: dict[str, Any], path: np.ndarray | None) -> dict[str, Any] | None:
    """Return what is to reach the goal region, its centre [m] and its radius [m] or None."""
    centre = goal.get("position_m")
    if centre is None:
        if path is None:
            return None
        centre = path[-1]
    return {"kind": goal.get("kind", "grasp"), "radius_m": goal.get("tolerance_m"),
            "centre_m": [float(value) for value in centre[:3]]}


def _add_frames(data: SceneData, branch: Branch, plan: str | None, vertex_count: int) -> None:
    names = [name.removesuffix(".pc2") for name in branch.names("frames") if name.endswith(".pc2")]
    name = plan if plan in names else (names[-1] if names and plan is None else None)
    if name is None:
        return
    path = branch.path(f"frames/{name}.pc2")
    positions = _read_pc2(path, vertex_count)
    about = {}
    if branch.has(f"frames/{name}.json"):
        about = json.loads(branch.path(f"frames/{name}.json").read_text(encoding="utf-8"))
    data.info["frames"] = {"name": name, "file": f"frames/{name}.pc2", "count": len(positions)}
    data.arrays["frame_bounds"] = np.array(
        [bound(positions.reshape(-1, 3), axis=0) for bound in (np.min, np.max)], float)
    if len(about.get("energies_j") or ()) == len(positions):
        data.arrays["frame_energy"] = np.asarray(about["energies_j"], float)
    if branch.has(f"frames/{name}.npz"):
        _add_strain_energy(data, branch.path(f"frames/{name}.npz"), vertex_count)
    if "control_points" in data.arrays:
        data.arrays["control_points_motion"] = _carried(
            data.arrays["control_points"], data.arrays["vertices"], positions)
    if "path:plan" in data.arrays:
        data.arrays["grasp_motion"] = _along(data.arrays["path:plan"], len(positions))


def _add_strain_energy(data: SceneData, path: Path, vertex_count: int) -> None:
    """Add where the branch is strained most along the path: the largest value of any frame."""
    with np.load(path, allow_pickle=False) as content:
        density = np.asarray(content["strain_energy_density_j_m3"], float)
    if density.ndim == 2 and density.shape[1] == vertex_count and np.isfinite(density).all():
        _add_scalar(data, "strain_energy", density.max(axis=0), "peak strain energy density",
                    "J/m³", "inferno")


def _read_pc2(path: Path, vertex_count: int) -> np.ndarray:
    """Return the frames of a PC2 file, shape [frames, v, 3]; it must fit the mesh's surface."""
    from limber.mechanics.frames import read_pc2

    positions, _, _ = read_pc2(path)
    points = positions.shape[1]
    if points != vertex_count:
        raise BranchFolderError(
            f"{path} moves {points} vertices; the mesh's surface has {vertex_count}.",
            "The frames belong to another mesh; Blender would silently show the rest shape.",
            "Run `limber plan` again.")
    return positions


def _carried(points: np.ndarray, vertices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return where ``points`` inside the branch go: as the surface around them; [frames, k, 3].

    By inverse-distance weights of a high power: the ring of vertices about a point counts, and
    both rings where a point lies between two.
    """
    distance = np.linalg.norm(points[:, None] - vertices, axis=2)
    weights = np.maximum(distance, 1e-9) ** -4
    weights /= weights.sum(axis=1, keepdims=True)
    return points + np.einsum("kv,fvi->fki", weights, positions - vertices)


def _along(points: np.ndarray, count: int) -> np.ndarray:
    """Return a path's own points if it has ``count``, else points evenly spaced along it."""
    if len(points) == count:
        return points
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    places = np.linspace(0.0, length[-1], count)
    return np.column_stack([np.interp(places, length, points[:, axis]) for axis in range(3)])


def _add_view(data: SceneData) -> None:
    """Add what the camera must see, and its direction: across the plane of the motion."""
    arrays = data.arrays
    vertices = arrays["vertices"]
    seen = [vertices, *(arrays[name] for name in arrays if name.startswith("path:"))]
    if "frame_bounds" in arrays:
        seen.append(_corners(arrays["frame_bounds"]))
    goal = data.info.get("goal")
    if goal:
        radius = goal["radius_m"] or 0.0
        centre = np.array(goal["centre_m"])
        seen.append(_corners(np.array([centre - radius, centre + radius])))
    arrays["view_points"] = np.vstack(seen)
    data.info["size_m"] = np.ptp(arrays["view_points"], axis=0).max()
    data.info["ground_m"] = arrays["view_points"][:, 2].min()
    motion = [arrays[name] for name in arrays if name.startswith("path:")]
    arrays["view_direction"] = _view_direction(np.vstack(motion or [vertices])[:, :2])


def _view_direction(points: np.ndarray) -> np.ndarray:
    """Return a unit vector that looks across the main direction of ``points`` [n, 2], downwards."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    across = axes[0] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    # Of the two sides, always the same one, so that a picture made twice is the same picture.
    across = across if across[1] >= 0 else -across
    turned = np.array([across[0] - 0.3 * across[1], across[1] + 0.3 * across[0], -0.22])
    return turned / np.linalg.norm(turned)


def _corners(bounds: np.ndarray) -> np.ndarray:
    pick = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    return np.take_along_axis(bounds, pick, axis=0)
