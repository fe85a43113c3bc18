"""Measurements of a pull: points and gripper over time, on the moving branch."""

import numpy as np

from limber.core.errors import InputError
from limber.recordings.recording import Pull, PullEntry, read_pull
from limber.results.motion_files import read_pc2
from limber.results.scene.animation import add_frame_scalar, carried
from limber.results.scene.arrays import SceneData
from limber.results.scene.graphs import force_graph
from limber.store import Branch

RESIDUAL = "measured to simulated"
"""Title of the distance between observed and simulated position of a point."""


def add_observation(data: SceneData, branch: Branch) -> None:
    """Add the measurements of the pull whose motion is shown, else of the newest pull.

    ``observation`` [t, m, 3] m (the last observed position where ``observation_visible`` [t, m] is
    false), ``observation_times`` [t] s; ``observation_grasp`` [g, 3] m of the gripper, and
    ``observation_grasp_times`` [g] s, on the same clock. ``info["pulls"]`` names all recordings.

    If the frames are those of this pull (``limber simulate --pull`` replays it under its name),
    ``observation_motion`` [frames, m, 3] is the position of each point in each frame,
    ``observation_seen`` [frames, m] whether it was observed then. Scalar ``residual`` is its
    distance to the simulation.
    """
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
    """Return the rest positions of the observed points [m], shape [count, 3]; None if unknown.
    """
    rest = entry.rest_points_m
    found = np.array(rest, float) if rest is not None else data.arrays.get("control_points")
    return found if found is not None and found.shape == (count, 3) else None


def _in_frames(data: SceneData, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of points at ``times`` [s], [frames, m, 3], and whether seen, [frames, m].

    Positions are interpolated linearly between two observations of a point. A point counts as not
    seen where the nearest observation lacks it, and before the first and after the last.
    """
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
