"""The moving parts of a scene: frames with their values, and marks that move with them."""

import numpy as np

from limber.core.errors import BranchFolderError
from limber.core.files.reading import read_arrays, require_shapes
from limber.mechanics.materials.materials import STRENGTH_OVER_YOUNG, strength_of
from limber.results.motion_files import FramesFile, read_frames_file, read_pc2
from limber.results.scene.arrays import SceneData
from limber.results.scene.colours import colour_scale, levels_of, palette
from limber.results.scene.still_objects import add_scalar
from limber.store import Branch

_FRAME_SCALARS = {
    "strain_energy_density_j_m3": ("strain_energy", "strain energy density", "J/m³", "inferno"),
    "principal_strain": ("strain", "largest principal strain", "%", "inferno"),
    "principal_stress_pa": ("stress", "largest principal stress", "Pa", "inferno"),
    "det_f": ("det_f", "volume relative to the rest volume", "", "viridis")}
"""Arrays of ``frames/NAME.npz`` [frames, vertices]: name in the scene, title, unit, colours."""
_FRAME_VALUES = {"energies_j": "frame_energy", "kinetic_energies_j": "frame_kinetic_energy",
                 "min_det_f": "frame_min_det_f", "largest_principal_strains": "frame_strain"}
"""Lists of ``frames/NAME.json`` with one number per frame, and their arrays in the scene."""


def add_motion(data: SceneData, branch: Branch, plan: str | None, motion: str | None,
               strength: float | None = None) -> None:
    """Add the frames of ``motion``; by default those of the plan, else the newest.

    ``strength`` [Pa] is the breaking stress of the wood; assumed if not given.

    Raises:
        BranchFolderError: the frames do not exist or belong to another mesh.
    """
    names = [name.removesuffix(".pc2") for name in branch.names("frames") if name.endswith(".pc2")]
    data.info["motions"] = names
    if motion is not None and motion not in names:
        raise BranchFolderError(f"The branch has no frames named {motion!r}.",
                                f"Its frames are: {', '.join(names) or 'none'}.",
                                "Name one of them, or run `limber simulate`.")
    name = motion or (plan if plan in names else None)
    if name is None and plan is None and names:
        name = max(names, key=lambda each: _finished(branch, each))
    if name is None:
        return
    count = len(data.arrays["vertices"])
    positions, _, _ = read_pc2(branch.path(f"frames/{name}.pc2"))
    if positions.shape[1] != count:
        if motion is None and _is_of_an_earlier_mesh(branch, name):
            data.info["notes"].append(f"{name} belongs to an earlier mesh, so its motion is not "
                                      "shown")
            return
        raise BranchFolderError(
            f"frames/{name}.pc2 has {positions.shape[1]} vertices; the mesh's surface has "
            f"{count}.",
            "The frames belong to another mesh; Blender would silently show the rest shape.",
            "Run the stage that makes them again.")
    about = _about(branch, name, len(positions))
    _add_times(data, name, about, len(positions))
    data.arrays["frame_bounds"] = np.array(
        [bound(positions.reshape(-1, 3), axis=0) for bound in (np.min, np.max)], float)
    _add_values(data, branch, name, about, positions)
    _add_share_of_strength(data, strength)
    _add_carried(data, positions, name == plan)


def _finished(branch: Branch, name: str) -> str:
    """Return when frames were written, from the manifest: copying changes a file's own time."""
    return max((entry.finished for entry in branch.manifest.stages.values()
                if f"frames/{name}.pc2" in entry.writes), default="")


def _is_of_an_earlier_mesh(branch: Branch, name: str) -> bool:
    """Whether the mesh was made again after the frames were written."""
    stages = branch.manifest.stages
    meshed = max((stages[key].finished for key in ("reconstruct", "mesh") if key in stages),
                 default="")
    return _finished(branch, name) < meshed


def _about(branch: Branch, name: str, count: int) -> FramesFile:
    if not branch.has(f"frames/{name}.json"):
        return FramesFile(frame_count=count)
    path = branch.path(f"frames/{name}.json")
    about = read_frames_file(path)
    if about.frame_count not in (None, count):
        raise BranchFolderError(f"{path} describes {about.frame_count} frames, but there are "
                                f"{count}.", "The two files do not belong together.",
                                "Run the stage again.")
    return about


def _add_times(data: SceneData, name: str, about: FramesFile, count: int) -> None:
    """Add the time of each frame; a path without times plays one pose per frame."""
    times, rate = about.times_s, about.rate
    is_timed = times is not None
    data.arrays["frame_times"] = np.asarray(times, float) if is_timed else np.arange(count) / rate
    data.info["frames"] = {"name": name, "file": f"frames/{name}.pc2", "count": count,
                           "rate_hz": rate, "is_timed": is_timed}


def _add_values(data: SceneData, branch: Branch, name: str, about: FramesFile,
                positions: np.ndarray) -> None:
    count, vertex_count = positions.shape[:2]
    for key, array in _FRAME_VALUES.items():
        if (values := getattr(about, key)) is not None:
            data.arrays[array] = np.asarray(values, float)
    if not branch.has(f"frames/{name}.npz"):
        return
    path = branch.path(f"frames/{name}.npz")
    content = read_arrays(path, "the values of a motion's frames")
    for key, (scalar, title, unit, colours) in _FRAME_SCALARS.items():
        # Lists of another motion, or of a part of it, are left out.
        if key not in content or content[key].shape != (count, vertex_count):
            continue
        require_shapes(path, content, {key: (count, vertex_count)},
                       "the values of a motion's frames")
        add_frame_scalar(data, scalar, content[key], title, unit, colours)


def _add_share_of_strength(data: SceneData, strength: float | None) -> None:
    """Add each frame's ratio of stress to the breaking stress of the wood."""
    stress, young = data.arrays.get("frame_scalar:stress"), data.arrays.get("scalar:young")
    if stress is None or young is None:
        return
    source_text = (f"{100 * STRENGTH_OVER_YOUNG:g} % of E, assumed" if strength is None
                   else f"{strength / 1e6:.3g} MPa")
    add_frame_scalar(data, "stress_over_strength", stress / strength_of(young, strength),
                      f"stress over strength ({source_text})", "", "inferno", is_from_zero=True)


def add_frame_scalar(data: SceneData, name: str, values: np.ndarray, title: str, unit: str,
                     colours: str, *, is_from_zero: bool = False) -> None:
    """Add a value in each frame [frames, v], and the worst of all frames, on one scale."""
    values = values.astype(np.float32)
    worst, word = (values.min(axis=0), "least") if name == "det_f" else (
        values.max(axis=0), "peak")
    spanned = np.append(np.maximum(worst, 0.0), 0.0) if is_from_zero else worst
    scale = colour_scale(spanned, title, unit, colours)
    add_scalar(data, name, worst.astype(float), {**scale, "title": f"{word} {title}"})
    data.info["frame_scalars"][name] = scale
    data.arrays |= {f"frame_scalar:{name}": values, f"frame_level:{name}": levels_of(values, scale),
                    f"palette:{colours}": palette(colours)}


def _add_carried(data: SceneData, positions: np.ndarray, is_plan: bool) -> None:
    vertices = data.arrays["vertices"]
    for name in ("control_points", "grasp", "targets"):
        if len(data.arrays.get(name, ())):
            moved = carried(data.arrays[name], vertices, positions)
            data.arrays[f"{name}_motion"] = moved[:, 0] if name == "grasp" else moved
    if is_plan and "path:plan" in data.arrays:
        # The path is that of the gripper, which the grasp patch follows.
        data.arrays["grasp_motion"] = _along(data.arrays["path:plan"], len(positions))


def carried(points: np.ndarray, vertices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the motion of ``points`` inside the branch with the surface, [frames, k, 3].

    Inverse-distance weights of a high power: the ring of vertices around a point dominates, or both
    rings if the point is between two.
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
    distances = np.linspace(0.0, length[-1], count)
    return np.column_stack([np.interp(distances, length, points[:, axis]) for axis in range(3)])
