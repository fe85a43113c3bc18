"""From the images or clouds of a pull to control points over time."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from limber.core.errors import Command, InputError, Option
from limber.core.numerics.rigid import poses_at, rotation_angle, rotation_matrix
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.camera import Camera, SeenCloud, depth_to_cloud, read_camera, read_mask
from limber.geometry.io.depth_images import depth_metres
from limber.geometry.skeleton.skeleton import Skeleton
from limber.perception.tracking import Anchor, CurveTracker, rest_offset
from limber.recordings.image_folders import segment_by_depth
from limber.recordings.recording import Observations, Pull

CAMERA_OFFSET_M = 4e-3
"""Error of a camera pose at the branch above which it is corrected, with a warning [m]."""
LASTING_SIGMA_M = 2e-4
"""How far a tube of the skeleton's radii stands beside the branch [m]: a share of a point's error
that is alike in all frames of one bend. A tracker's covariance, right frame by frame, lacks it."""


@dataclass
class _Notes:
    empty: list[str] = field(default_factory=list)
    hidden: int = 0
    messages: list[str] = field(default_factory=list)


def observe(folder: Path, pull: Pull, skeleton: Skeleton, fractions: tuple[float, ...], *,
            progress: Progress = SILENT) -> tuple[Observations, list[str]]:
    """Find the control points, at ``fractions`` of the main path, in all frames of a pull; NaN
    where not visible. Returns warnings too. The first frame shows the branch at rest: it corrects
    the camera's pose. InputError if there are no frames, or the branch is in none."""
    frames = list_frames(folder, pull.entry.observation)
    load = _loader(folder, pull.entry.observation)
    tracker = CurveTracker(skeleton, fractions)
    notes, curve, correction, sight = _Notes(), None, None, None
    count, points = len(frames), len(fractions)
    positions = np.full((count, points, 3), np.nan)
    covariance = np.broadcast_to(np.eye(3), (count, points, 3, 3)).copy()
    times = np.array([time for time, _ in frames])
    poses = poses_at(pull.times, pull.poses,
                     np.clip(times + pull.entry.time_offset_s, pull.times[0], pull.times[-1]))
    for index, (_, path) in enumerate(frames):
        progress(index / count, "tracking the control points", frame=index)
        cloud = load(path)
        if len(cloud.points) < 10:
            notes.empty.append(path.stem)
            continue
        if not np.any(cloud.view):
            # Judged once, at rest: later the branch is elsewhere than its skeleton.
            sight = _line_of_sight(cloud, skeleton) if sight is None else sight
            cloud = replace(cloud, view=np.broadcast_to(sight, cloud.points.shape).copy())
        if correction is None:
            correction = _camera_correction(tracker, cloud, poses[index], poses[0], notes)
        turn, shift = correction
        cloud = SeenCloud(cloud.points @ turn.T + shift, cloud.sigma, cloud.view @ turn.T)
        tracked = tracker.track(cloud, curve, _anchor(tracker, pull, poses[index]))
        curve = tracked.curve
        notes.hidden += int(np.sum(~tracked.visible))
        positions[index, tracked.visible] = tracked.positions[tracked.visible]
        covariance[index] = tracked.covariance + LASTING_SIGMA_M**2 * np.eye(3)
    if len(notes.empty) == count:
        raise InputError(f"{folder}: the branch was not found in any of the {count} frames.",
                         "All masks are empty, or no points lie within the depth range.",
                         "Check the masks and the camera's depth_scale.")
    return Observations(times, positions, covariance), _sentences(pull.name, notes, count)


def list_frames(folder: Path, kind: str) -> list[tuple[float, Path]]:
    """Return time stamp [s] and file of each frame; stamps are the files' names."""
    sub, suffix = ("clouds", ".ply") if kind == "clouds" else ("depth", ".png")
    files = sorted((Path(folder) / sub).glob(f"*{suffix}"))
    try:
        frames = sorted((float(path.stem), path) for path in files)
    except ValueError as error:
        raise InputError(f"{folder}/{sub}: {error}.", "File names must be time stamps in seconds.",
                         "Import the frames with ",
                         Command("import-pull", Option("rate_hz"), "..."), ".") from error
    if len(frames) < 2:
        raise InputError(f"{folder}/{sub} has {len(frames)} frames.", "At least two are needed.",
                         "Import the recording again.")
    return frames


def write_depth(path: Path, depth: np.ndarray, camera: Camera) -> None:
    """Write depth [m] as a 16-bit PNG."""
    from PIL import Image

    steps = np.clip(np.round(depth * camera.depth_scale), 0, 65535).astype(np.uint16)
    Image.fromarray(steps).save(path)


def _loader(folder: Path, kind: str) -> Callable[[Path], SeenCloud]:
    camera_path = folder / "camera.toml"
    if kind == "clouds":
        camera = read_camera(camera_path) if camera_path.exists() else None
        return lambda path: _read_cloud(path, camera)
    camera = read_camera(camera_path)
    empty_scene = folder / "background.png"
    background = depth_metres(empty_scene, camera) if empty_scene.exists() else None

    def load(path: Path) -> SeenCloud:
        mask_path = folder / "mask" / path.name
        mask = read_mask(mask_path) if mask_path.exists() else None
        depth = depth_metres(path, camera, mask)
        return depth_to_cloud(camera, depth, segment_by_depth(
            depth, background=background) if mask is None else mask)
    return load


def _read_cloud(path: Path, camera: Camera | None) -> SeenCloud:
    from limber.geometry.io.clouds import read_cloud

    try:
        points = read_cloud(path, unit="m").points
    except InputError:
        # An empty frame is no reason to give up the others; it is named in the warnings.
        points = np.empty((0, 3))
    points = points[np.isfinite(points).all(axis=1)]
    if camera is None:
        return SeenCloud(points, np.full(len(points), 2e-3), np.zeros((len(points), 3)))
    ray = points - camera.origin
    distance = np.linalg.norm(ray, axis=1)
    return SeenCloud(points, camera.depth_sigma(distance), ray / distance[:, None])


def _line_of_sight(cloud: SeenCloud, skeleton: Skeleton) -> np.ndarray:
    """Guess it where no camera is known: from the seen side towards the axis, shape [3]."""
    from scipy.spatial import cKDTree

    nearest = cKDTree(skeleton.nodes).query(cloud.points)[1]
    inward = np.median(skeleton.nodes[nearest] - cloud.points, axis=0)
    return inward / max(np.linalg.norm(inward), 1e-12)


def _camera_correction(tracker: CurveTracker, cloud: SeenCloud, pose: np.ndarray,
                       rest_pose: np.ndarray, notes: _Notes) -> tuple[np.ndarray, np.ndarray]:
    nothing = np.eye(3), np.zeros(3)
    if np.linalg.norm(pose[:3] - rest_pose[:3]) > 2e-3:
        notes.messages.append("the branch is already pulled in the first usable frame. The "
                              "camera's pose could not be checked.")
        return nothing
    turn, shift = rest_offset(tracker, cloud)
    moved = np.linalg.norm(tracker.rest.nodes @ turn.T + shift - tracker.rest.nodes, axis=1)
    if moved.max() <= CAMERA_OFFSET_M:
        return nothing
    angle = np.degrees(rotation_angle(turn))
    notes.messages.append(
        f"the camera's pose has an error of up to {moved.max() * 1e3:.0f} mm and {angle:.1f} "
        "degrees at the branch at rest. The frames were moved onto the branch. Calibrate the "
        "camera again.")
    return turn, shift


def _anchor(tracker: CurveTracker, pull: Pull, pose: np.ndarray) -> Anchor:
    held = np.array(pull.entry.grasp.point_m)
    arc = tracker.arc_near(held)
    arm = tracker.rest.start().at(np.array([arc]))[0] - held
    turn = rotation_matrix(pose[3:])
    return Anchor(arc, pose[:3] + turn @ arm)


def _sentences(name: str, notes: _Notes, count: int) -> list[str]:
    found = [f"{name}: {message}" for message in notes.messages]
    if notes.empty:
        found.append(f"{name}: {len(notes.empty)} of {count} frames do not show the branch and "
                     f"were discarded. The first is at {notes.empty[0]} s.")
    if notes.hidden:
        found.append(f"{name}: control points were hidden {notes.hidden} times. They are not used "
                     "in those frames.")
    return found
