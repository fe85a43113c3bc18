"""The moving parts of a scene: frames with their values, and marks that move with them."""

from typing import Any

import numpy as np

from limber.core.errors import BranchFolderError, Command, InputError, Option
from limber.core.files.reading import read_arrays, require_shapes
from limber.core.files.tables import read_columns
from limber.estimation.estimate_file import read_estimate
from limber.mechanics.materials.materials import STRENGTH_OVER_YOUNG, strength_of
from limber.planning.plan_file import read_plan_summary
from limber.planning.search_files import read_trees
from limber.recordings.recording import Pull, PullEntry, read_pull
from limber.results.findings import PATH_NAMES, SAME, remarks_on
from limber.results.motion_files import FramesFile, read_frames_file, read_pc2
from limber.results.scene.colours import (
    SceneData,
    add_rods,
    colour_scale,
    colours_of,
    levels_of,
    palette,
)
from limber.results.scene.graphs import energy_graph, force_graph, young_graph
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
    """Add the frames of ``motion``, by default the plan's, else the newest; ``strength``: breaking
    stress of the wood [Pa], else assumed. BranchFolderError if they do not exist or belong to
    another mesh."""
    names = [name.removesuffix(".pc2") for name in branch.names("frames") if name.endswith(".pc2")]
    data.info["motions"] = names
    if motion is not None and motion not in names:
        raise BranchFolderError(f"The branch has no frames named {motion!r}.",
                                f"Its frames are: {', '.join(names) or 'none'}.",
                                "Name one of them, or run ", Command("simulate"), ".")
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
    """Return the motion of ``points`` inside the branch with the surface, [frames, k, 3], by
    inverse-distance weights of a high power: the ring of vertices around a point dominates, or both
    rings between two."""
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


# Measurements of a pull: points and gripper over time, on the moving branch.

RESIDUAL = "measured to simulated"
"""Title of the distance between observed and simulated position of a point."""


def add_observation(data: SceneData, branch: Branch) -> None:
    """Add the measurements of the shown motion's pull, else the newest's: ``observation`` [t, m, 3]
    m (the last one where ``observation_visible`` [t, m] is false) at ``observation_times`` [t] s,
    the gripper's ``observation_grasp`` [g, 3] m likewise on the same clock; ``info["pulls"]`` names
    all. If `limber simulate --pull` replays it, ``observation_motion`` [frames, m, 3] and
    ``observation_seen`` [frames, m] are in each frame, and scalar ``residual`` is the distance to
    the simulation."""
    pulls = [name for name in branch.names("pulls") if branch.has(f"pulls/{name}/pull.toml")]
    data.info["pulls"] = pulls
    frames = data.info.get("frames") or {}
    pull_name = frames.get("name")
    name = pull_name if pull_name in pulls else (pulls[-1] if pulls else None)
    if name is None:
        return
    try:
        pull = read_pull(branch.path(f"pulls/{name}"))
    except InputError as error:
        data.info["notes"].append(f"pull {name} cannot be shown: {error}")
        return
    is_shown = name == pull_name and frames["is_timed"]
    data.info["observation"] = {"pull": name, "is_shown": is_shown}
    data.arrays["observation_grasp"] = pull.poses[:, :3]
    data.arrays["observation_grasp_times"] = pull.times
    if (graph := force_graph(name, pull.times, pull.wrenches[:, :3],
                             cursor=times_of_frames(data, name))) is not None:
        data.info["graphs"]["force"] = graph
    seen = pull.observations
    if seen is not None and seen.visible.any():
        data.arrays["observation"] = _held_on(seen.positions, seen.visible)
        data.arrays["observation_visible"] = seen.visible
        data.arrays["observation_times"] = seen.times + pull.entry.time_offset_s
    if is_shown:
        _add_frames(data, branch, pull, seen.point_count if seen is not None else 0)


def times_of_frames(data: SceneData, pull: str) -> np.ndarray:
    """Return the time of each frame on the clock of a pull [s]; none if the frames are not its own.
    """
    about = data.info.get("observation") or {}
    if about.get("pull") != pull or not about["is_shown"]:
        return np.empty(0)
    times = data.arrays["frame_times"]
    # A replay starts at the gripper's first pose.
    return times - times[0] + data.arrays["observation_grasp_times"][0]


def _add_frames(data: SceneData, branch: Branch, pull: Pull, count: int) -> None:
    """Add the position of each point in each frame, and its distance to the simulation."""
    if "observation" not in data.arrays:
        return
    seen_at, seen = _in_frames(data, times_of_frames(data, pull.name))
    data.arrays |= {"observation_motion": seen_at, "observation_seen": seen}
    rest = _rest_points(data, pull.entry, count)
    if rest is None or not seen.any():
        return
    vertices = data.arrays["vertices"]
    positions, _, _ = read_pc2(branch.path(data.info["frames"]["file"]))
    distance = np.linalg.norm(seen_at - carried(rest, vertices, positions), axis=2)
    add_frame_scalar(data, "residual", _around(rest, distance, seen, vertices),
                     f"{RESIDUAL}, pull {pull.name}", "m", "inferno", is_from_zero=True)


def _rest_points(data: SceneData, entry: PullEntry, count: int) -> np.ndarray | None:
    """Return the rest positions of the observed points [m], shape [count, 3]; None if unknown."""
    rest = entry.rest_points_m
    found = np.array(rest, float) if rest is not None else data.arrays.get("control_points")
    return found if found is not None and found.shape == (count, 3) else None


def _in_frames(data: SceneData, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions at ``times`` [s], [frames, m, 3], linear between observations, and whether
    seen, [frames, m]: not where the nearest observation lacks the point, nor before the first and
    after the last."""
    found, visible, at = (data.arrays[f"observation{part}"] for part in ("", "_visible", "_times"))
    nearest = np.abs(times[:, None] - at).argmin(axis=1)
    step = np.diff(at).max(initial=0.0)
    is_inside = (times >= at[0] - step) & (times <= at[-1] + step)
    positions = np.empty((len(times), *found.shape[1:]))
    for point in range(found.shape[1]):
        known = visible[:, point]
        for axis in range(3):
            positions[:, point, axis] = (np.interp(times, at[known], found[known, point, axis])
                                         if known.any() else 0.0)
    return positions, visible[nearest] & is_inside[:, None]


def _around(points: np.ndarray, distance: np.ndarray, seen: np.ndarray, vertices: np.ndarray,
            ) -> np.ndarray:
    """Return distances [frames, m] at all vertices, by inverse squared distance; 0 if not observed.
    """
    weights = np.maximum(np.linalg.norm(vertices[:, None] - points, axis=2), 1e-9) ** -2
    total = seen @ weights.T
    values = np.where(seen, distance, 0.0) @ weights.T
    return np.divide(values, total, out=np.zeros_like(values), where=total > 0)


def _held_on(positions: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return positions; an unobserved one is replaced by the last, or else the first, observed one.
    """
    found = positions.copy()
    found[~visible] = 0.0
    for point in range(positions.shape[1]):
        seen = np.flatnonzero(visible[:, point])
        if len(seen):
            last = np.searchsorted(seen, np.arange(len(positions)), side="right") - 1
            found[:, point] = positions[seen[np.maximum(last, 0)], point]
    return found


# Measured against simulated: distances to the estimated branch during a pull.


def add_fit(data: SceneData, branch: Branch, name: str | None) -> None:
    """Add Young's modulus along the branch as a graph, and the fit to pull ``name``, else the
    estimate's first: ``rods:fit`` (lines along simulated points, balls at measured ones, coloured
    by the distance), scalar ``residual`` and graphs. InputError if ``estimate.json`` is damaged."""
    if not branch.has("estimate.json"):
        return
    estimate = read_estimate(branch.path("estimate.json"))
    data.info["graphs"]["young"] = young_graph(estimate)
    pulls = {pull["name"]: pull for pull in estimate["pulls"]}
    if not pulls:
        return
    pull = pulls.get(name) or next(iter(pulls.values()))
    if (force := force_graph(pull["name"], pull["all_times_s"], pull["measured_force_n"],
                             pull["simulated_force_n"],
                             times_of_frames(data, pull["name"]))) is not None:
        data.info["graphs"]["force"] = force
    _add_distances(data, pull)


def _add_distances(data: SceneData, pull: dict[str, Any]) -> None:
    measured, simulated = (np.array(pull[name], float) for name in ("observed_m", "simulated_m"))
    if measured.size == 0:
        return
    distance = np.linalg.norm(measured - simulated, axis=2)
    known = np.isfinite(distance)
    if not known.any():
        return
    scale = colour_scale(distance[known], f"{RESIDUAL}, pull {pull['name']}", "m", "inferno")
    size = float(np.ptp(data.arrays["vertices"], axis=0).max())
    # Simulated points of a moment are joined along the branch; measured ones are balls.
    number = np.cumsum(known).reshape(known.shape) - 1
    joined = known[:, :-1] & known[:, 1:]
    lines = np.column_stack([number[:, :-1][joined], number[:, 1:][joined]])
    add_rods(data, "fit", f"Measured over simulated, pull {pull['name']}",
             np.concatenate([simulated[known], measured[known]]), lines, 0.002 * size,
             np.tile(distance[known], 2), scale, ball_from=int(known.sum()),
             ball_radius=0.009 * size)
    seen = known.any(axis=0)
    if "residual" in data.info["frame_scalars"]:
        # The residual of each played frame is there already and says more.
        return
    if len(data.arrays.get("control_points", ())) == measured.shape[1] and seen.all():
        mean = np.sqrt((np.where(known, distance, 0.0)**2).sum(axis=0) / known.sum(axis=0))
        values = _mean_near(data.arrays["control_points"], mean, data.arrays["vertices"])
        add_scalar(data, "residual", values, colour_scale(values, RESIDUAL, "m", "inferno"))


def _mean_near(points: np.ndarray, values: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return values of a few points interpolated at all vertices, by inverse squared distance."""
    distance = np.linalg.norm(vertices[:, None] - points, axis=2)
    weights = np.maximum(distance, 1e-9) ** -2
    return (weights @ values) / weights.sum(axis=1)


# Paths to a goal in a scene: points, poses, energies, search trees and the goal.

_POSITION = ("x_m", "y_m", "z_m")
_TREES = {"D-RRT*": "plan", "RRT*": "baseline"}  # name of the path of each tree
_ROTATION = ("rx_rad", "ry_rad", "rz_rad")


def add_plan(data: SceneData, branch: Branch, plan: str | None) -> str | None:
    """Add the paths of ``plan``, by default the newest, and its goal; return its name.
    BranchFolderError if it does not exist or is damaged."""
    plans = [key.split(":", 1)[1] for key in branch.manifest.stages if key.startswith("plan:")]
    data.info["plans"] = plans
    if plan is None:
        if not plans:
            return None
        plan = max(plans, key=lambda name: branch.manifest.stages[f"plan:{name}"].finished)
    summary = read_plan_summary(
        branch.require(f"plans/{plan}.json", "plan", Option("name", plan)))
    for key, name in (("plan", plan), ("baseline", f"{plan}-baseline")):
        if not branch.has(f"plans/{name}.csv"):
            continue
        table = read_columns(branch.path(f"plans/{name}.csv"), _POSITION, "the table of a path")
        _add_path(data, key, table)
        data.info["paths"][key] = {"title": PATH_NAMES[key],
                                   "note": _path_note(summary.get(key) or {})}
    gap = (summary.get("certificate") or {}).get("gap_percent")
    if gap is not None and "plan" in data.info["paths"]:
        data.info["paths"]["plan"]["note"] += f", at most {gap:.1f} % above the least cost"
    _add_trees(data, branch, plan)
    _add_energy_scale(data)
    data.info["plan"] = plan
    data.info["goal"] = _goal(summary, data.arrays.get("path:plan"))
    saved, added = summary.get("energy_saved_percent"), summary.get("length_added_percent")
    if saved is not None and added is not None:
        data.info["notes"].append(
            "no shorter path was found" if max(abs(saved), abs(added)) < SAME else
            f"energy {round(-saved):+d} %, length {round(added):+d} % against the shortest path")
    if legs := summary.get("legs"):
        data.info["notes"].append("motion: " + ", ".join(
            f"{leg['name']} {leg['duration_s']:.0f} s" for leg in legs))
    if beyond := remarks_on(summary).get("peak_strain"):
        data.info["notes"].append(f"strain, {beyond}")
    return plan


def _add_path(data: SceneData, key: str, table: dict[str, np.ndarray]) -> None:
    positions = np.column_stack([table[name] for name in _POSITION])
    data.arrays[f"path:{key}"] = positions
    if all(name in table for name in _ROTATION):
        data.arrays[f"path_pose:{key}"] = np.column_stack(
            [positions, *(table[name] for name in _ROTATION)])
    for column, name in (("energy_j", "energy"), ("force_n", "force"), ("strain", "strain")):
        if column in table:
            data.arrays[f"path_{name}:{key}"] = table[column]


def _add_trees(data: SceneData, branch: Branch, plan: str) -> None:
    """Add the search trees; a user may have deleted their file, which is large."""
    data.info["trees"] = {}
    if not branch.has(f"plans/{plan}-trees.csv"):
        return
    trees = read_trees(branch.path(f"plans/{plan}-trees.csv"))
    for planner, key in _TREES.items():
        if planner in trees:
            data.arrays[f"tree:{key}"], data.arrays[f"tree_parent:{key}"] = trees[planner]
            data.info["trees"][key] = {"title": planner, "node_count": len(trees[planner][0])}


def _add_energy_scale(data: SceneData) -> None:
    """Colour all paths by energy on one scale, so that they can be compared."""
    energies = {key: data.arrays[f"path_energy:{key}"] for key in data.info["paths"]
                if f"path_energy:{key}" in data.arrays}
    if energies:
        scale = colour_scale(np.concatenate(list(energies.values())), "energy along the path",
                             "J", "inferno")
        data.info["path_energy"] = scale
        size = float(np.ptp(data.arrays["vertices"], axis=0).max())
        for key, values in energies.items():
            data.arrays[f"path_color:{key}"] = colours_of(values, scale)
            points = data.arrays[f"path:{key}"]
            along = np.arange(len(points) - 1)
            add_rods(data, key, f"{data.info['paths'][key]['title']} path by energy", points,
                     np.column_stack([along, along + 1]), 0.005 * size, values, scale)
        data.info["graphs"]["energy"] = energy_graph({
            key: (data.info["paths"][key]["title"], data.arrays[f"path:{key}"], values)
            for key, values in energies.items()})


def _path_note(summary: dict[str, Any]) -> str:
    parts = []
    if summary.get("length_m") is not None:
        parts.append(f"{100 * summary['length_m']:.1f} cm")
    if summary.get("energy_sum_nmm") is not None:
        total = summary["energy_sum_nmm"]
        parts.append(f"{total:.0f} N mm" if abs(total) >= 100 else f"{total:.3g} N mm")
    return ", ".join(parts)


def _goal(summary: dict[str, Any], path: np.ndarray | None) -> dict[str, Any] | None:
    """Return what must reach the goal region, its centre [m], and its radius [m] or None."""
    goal = summary.get("goal") or {}
    centre, radius = goal.get("position_m"), goal.get("tolerance_m")
    if centre is None:
        if path is None:
            return None
        centre = path[-1]
    return {"kind": goal.get("kind", "grasp"), "radius_m": radius,
            "centre_m": [float(value) for value in centre[:3]]}
