"""A bag as a pull: choice of topics, one clock, and the gripper's wrench on the branch."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.camera import Camera, write_camera
from limber.recordings.bags.bag_reader import Bag, Topic
from limber.recordings.bags.stamps import stamped
from limber.recordings.bags.transforms import Frames, Motion
from limber.recordings.image_folders import copy_clouds, copy_rgbd, moved_into, write_frame
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, Observations
from limber.recordings.settings import ImportSettings
from limber.recordings.time_series import Stream

BRANCH_FRAME = "branch"
"""Frame of a bag that is taken as the branch's."""

MOST_MARKERS = 60
"""Most points of a cloud that counts as tracked markers, if all clouds have the same number."""

_LONGEST_GAP = 0.1  # [s] between wrenches, or three of their steps, beyond which nothing is known
_GRIPPERS = ("grasp", "gripper", "tcp", "tool", "tool0", "flange", "ee_link", "hand")

JointPoses = Callable[[tuple[str, ...], np.ndarray], np.ndarray]
"""From names and angles [rad] of joints, [n, k], to poses of the gripper in the base, [n, 6]."""


@dataclass(frozen=True)
class BagPull:
    """The content of a bag that makes up a pull.

    Attributes:
        robot: Pose and wrench, as in a robot's table, branch frame.
        observation: ``markers``, ``clouds``, ``depth`` or ``none``.
        seen: Tracked markers; None for files or no observation.
        warnings: Assumptions that were made.
    """

    robot: Stream
    observation: str
    seen: Observations | None
    warnings: tuple[str, ...]


def pull_of_bag(bag: Bag, folder: Path, settings: ImportSettings,
                joint_poses: JointPoses | None = None, progress: Progress = SILENT) -> BagPull:
    """Import a bag into the folder of a pull: images and clouds as files, the rest as values.

    Args:
        joint_poses: Poses of the gripper by joint angles, if a cell is given.

    Raises:
        InputError: there is no wrench or pose, more than one gripper without a choice, or no common
            time span of the clocks.
    """
    clock = "stamps" if settings.bag_clock == "header" else "logged"
    warnings: list[str] = []
    bag = stamped(bag, clock, warnings)
    frames = Frames(bag.of("transform"), clock)
    wrench = _chosen(bag, "wrench", settings.wrench_topic, "--wrench-topic",
                     "Stiffness cannot be estimated without a measured force.")
    if bag.broken:
        warnings.append(f"{bag.path.name}: {bag.broken} messages could not be decoded and were "
                        "discarded.")
    times, poses, base = _gripper(bag, frames, settings, clock, joint_poses, warnings)
    _require_one_clock(bag, (("wrench", getattr(wrench, clock)), ("pose", times)), settings)
    wrenches = _on_branch(wrench, getattr(wrench, clock), times, poses, base, frames, warnings)
    placed = _placed(base, frames, settings, warnings)
    poses, wrenches = moved_into((*placed[0], *placed[1].as_rotvec()), poses, wrenches)
    begin = float(times[0])
    robot = Stream(times - begin, np.hstack([poses, wrenches]), POSE_COLUMNS + WRENCH_COLUMNS)
    observation, seen = _seen(bag, folder, settings, clock, begin, base, placed, frames, warnings,
                              progress)
    if seen is not None:
        _require_one_clock(bag, (("points", seen.times + begin), ("pose", times)), settings)
    return BagPull(robot, observation, seen, tuple(warnings))


def _chosen(bag: Bag, kind: str, named: str | None, option: str, why: str) -> Topic:
    topics = bag.of(kind)
    if named is not None:
        topics = tuple(topic for topic in topics if topic.name == named)
    if len(topics) == 1:
        return topics[0]
    known = ", ".join(topic.name for topic in bag.of(kind)) or "none"
    if not topics:
        present = ", ".join((*(topic.name for every in bag.kinds.values() for topic in every),
                             *bag.others)) or "no messages"
        missing = f"no {kind}" if named is None else f"no {kind} on {named}"
        raise InputError(f"{bag.path} has {missing}.", f"{why} Its topics: {present[:400]}.",
                         f"Name a topic with {option} (known: {known}).")
    raise InputError(f"{bag.path} has {len(topics)} {kind} topics: {known}.",
                     "A pull uses one gripper and one topic of each kind.",
                     f"Select one with {option}.")


def _gripper(bag: Bag, frames: Frames, settings: ImportSettings, clock: str,
             joint_poses: JointPoses | None, warnings: list[str],
             ) -> tuple[np.ndarray, np.ndarray, str]:
    """Times [s], poses [n, 6] of the gripper, and their reference frame."""
    name = settings.pose_topic
    if not bag.of("pose") or (name is not None and not name.startswith("/")):
        found = (_by_frames(bag, frames, name, clock, warnings)
                 or _by_joints(bag, name, clock, joint_poses))
        if found is not None:
            return found
    topic = _chosen(bag, "pose", name, "--pose-topic", "The gripper's pose is needed.")
    motion = Motion.of(getattr(topic, clock), topic.values)
    if len(motion.times) < 2:
        raise InputError(f"{bag.path}: {topic.name} has {len(motion.times)} poses.",
                         "A pull needs at least two.", "Record it again.")
    return motion.times, _six(motion.positions, motion.turns), topic.frame.lstrip("/")


def _by_frames(bag: Bag, frames: Frames, name: str | None, clock: str, warnings: list[str],
               ) -> tuple[np.ndarray, np.ndarray, str] | None:
    """The gripper from the tree of frames, if it moves there."""
    moving = [topic for topic in bag.of("transform") if len(topic.stamps) > 2]
    chosen = [frame for frame in frames.names
              if (frame == name if name else frame.lower() in _GRIPPERS)]
    if not moving or not chosen:
        return None
    # Of a chain flange, tool0, gripper, the last in our list is the gripper.
    frame = min(chosen, key=lambda frame: name is None and _GRIPPERS.index(frame.lower()))
    longest = max(moving, key=lambda topic: len(topic.stamps))
    root = _root(bag, frame)
    times = np.unique(getattr(longest, clock))
    found = frames.between(frame, root, times)
    if found is None:
        return None
    warnings.append(f"{bag.path.name}: the gripper's pose is that of frame {frame} in {root}.")
    return times, _six(*found), root


def _by_joints(bag: Bag, name: str | None, clock: str, joint_poses: JointPoses | None,
               ) -> tuple[np.ndarray, np.ndarray, str] | None:
    """The gripper from the arm's joint angles.

    Raises:
        InputError: there are only angles, and no arm was named.
    """
    if not bag.of("joints"):
        return None
    if joint_poses is None:
        raise InputError(f"{bag.path} contains only joint angles.",
                         "The gripper's pose must be computed from the arm's model and tool.",
                         "Give the robot's cell file with --cell cell.toml, or record poses or "
                         "TF.")
    topic = _chosen(bag, "joints", name, "--pose-topic", "The gripper's pose is needed.")
    times, first = np.unique(getattr(topic, clock), return_index=True)
    return times, joint_poses(topic.labels, topic.values[first]), "base"


def _root(bag: Bag, frame: str) -> str:
    """The root frame above ``frame``."""
    above = {topic.labels[0].lstrip("/"): topic.frame.lstrip("/") for topic in bag.of("transform")}
    seen = {frame}
    while frame in above and above[frame] not in seen and frame != BRANCH_FRAME:
        frame = above[frame]
        seen.add(frame)
    return frame


def _require_one_clock(bag: Bag, streams: tuple[tuple[str, np.ndarray], ...],
                       settings: ImportSettings) -> None:
    (one, first), (other, second) = streams
    if not (len(first) and len(second)):
        return
    if first[0] <= second[-1] and second[0] <= first[-1]:
        return
    hint = "log" if settings.bag_clock == "header" else "header"
    raise InputError(
        f"{bag.path}: the {one} time stamps run from {first[0]:.1f} to {first[-1]:.1f} s, the "
        f"{other} time stamps from {second[0]:.1f} to {second[-1]:.1f} s. They start "
        f"{abs(first[0] - second[0]):.0f} s apart.",
        "They do not overlap, so they come from different clocks.",
        f"Synchronise the clocks (NTP), or use the other time stamps with --bag-clock {hint}.")


def _on_branch(topic: Topic, clock: np.ndarray, times: np.ndarray, poses: np.ndarray, base: str,
               frames: Frames, warnings: list[str]) -> np.ndarray:
    """Wrench at the poses' times, in the poses' frame, about the gripper, shape [n, 6]."""
    order = np.argsort(clock, kind="stable")
    stamps, values = clock[order], topic.values[order]
    good = np.isfinite(values).all(axis=1) & np.isfinite(stamps)
    stamps, values = stamps[good], values[good]
    if len(stamps) < 2:
        raise InputError(f"{topic.name} has {len(stamps)} wrenches.", "A pull needs at least two.",
                         "Record it again.")
    after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    longest = max(_LONGEST_GAP, 3 * float(np.median(np.diff(stamps))))
    lonely = (stamps[after] - stamps[after - 1] > longest) | (
        times < stamps[0] - longest) | (times > stamps[-1] + longest)
    wrench = np.column_stack([np.interp(times, stamps, column) for column in values.T])
    wrench[lonely] = np.nan
    own = topic.frame.lstrip("/")
    if own == base or (own == BRANCH_FRAME and not base):
        return wrench
    found = frames.between(own, base, times)
    if found is None:
        warnings.append(f"{topic.name} is in frame {own or '(none)'}, whose pose in "
                        f"{base or '(none)'} is not known. It is assumed to have the gripper's "
                        "axes and centre.")
        turns, lever = Rotation.from_rotvec(poses[:, 3:]), np.zeros((len(times), 3))
    else:
        turns, lever = found[1], found[0] - poses[:, :3]
    force, torque = turns.apply(np.nan_to_num(wrench[:, :3])), turns.apply(
        np.nan_to_num(wrench[:, 3:]))
    turned = np.hstack([force, torque + np.cross(lever, force)])
    turned[lonely] = np.nan
    return turned


def _placed(base: str, frames: Frames, settings: ImportSettings, warnings: list[str],
            ) -> tuple[np.ndarray, Rotation]:
    """Position and rotation of the poses' frame in the branch's."""
    if settings.frame_pose is not None:
        pose = np.array(settings.frame_pose)
        position, turn = pose[:3], Rotation.from_rotvec(pose[3:])
        if settings.cell is None or base == "base":
            return position, turn
        found = frames.between(base, "base", np.zeros(1))
        if found is None:
            warnings.append(f"Poses are in frame {base or '(none)'}. It is assumed to be the "
                            "robot's base as the pendant shows it. ROS' base_link is rotated by "
                            "180 degrees relative to that base.")
            return position, turn
        return position + turn.apply(found[0][0]), turn * found[1][0]
    found = frames.between(base, BRANCH_FRAME, np.zeros(1)) if base != BRANCH_FRAME else None
    if found is not None:
        return found[0][0], found[1][0]
    if base != BRANCH_FRAME:
        warnings.append(f"Poses are in frame {base or '(none)'}, which is assumed to be the "
                        "branch's frame. If it is not, give --frame-pose.")
    return np.zeros(3), Rotation.identity()


def _seen(bag: Bag, folder: Path, settings: ImportSettings, clock: str, begin: float, base: str,
          placed: tuple[np.ndarray, Rotation], frames: Frames, warnings: list[str],
          progress: Progress) -> tuple[str, Observations | None]:
    """Observations of the branch: markers as values; images and clouds become files."""
    named = settings.points_topic
    if named == "none":
        return "none", None
    images = [topic for topic in bag.of("image") if named in (None, topic.name)]
    points = [topic for topic in bag.of("points") if named in (None, topic.name)]
    if named is not None and not images and not points:
        _chosen(bag, "points", named, "--points-topic", "The option --points-topic requests it.")
    if len(images) + len(points) > 1:
        if named is None and len(points) == 1:
            images = []
        else:
            known = ", ".join(topic.name for topic in (*images, *points))
            raise InputError(f"{bag.path} has more than one topic that shows the branch: {known}.",
                             "The model is compared with only one of them.",
                             "Select one with --points-topic, or give --points-topic none.")
    if points:
        topic = points[0]
        times = getattr(topic, clock) - begin
        where = _frame_of(topic, base, placed, frames, warnings)
        count = topic.values.shape[1] if topic.counts is None else None
        if count is not None and count <= MOST_MARKERS:
            flat = topic.values.reshape(-1, 3)
            moved = (where[0] + where[1].apply(flat)).reshape(topic.values.shape)
            order = np.unique(times, return_index=True)[1]
            return "markers", Observations(times[order], moved[order])
        _write_clouds(topic, times, where, folder, settings, progress)
        return "clouds", None
    if images:
        _write_images(bag, images[0], getattr(images[0], clock) - begin, base, placed, frames,
                      folder, settings, warnings, progress)
        return "depth", None
    return "none", None


def _frame_of(topic: Topic, base: str, placed: tuple[np.ndarray, Rotation], frames: Frames,
              warnings: list[str]) -> tuple[np.ndarray, Rotation]:
    """Position and rotation of a static topic's frame in the branch's."""
    own = topic.frame.lstrip("/")
    if own == BRANCH_FRAME:
        return np.zeros(3), Rotation.identity()
    if own == base:
        return placed
    found = frames.between(own, base, np.zeros(1))
    if found is None:
        warnings.append(f"{topic.name} is in frame {own or '(none)'}, whose position is not "
                        "known. It is assumed to be the frame of the poses.")
        return placed
    return placed[0] + placed[1].apply(found[0][0]), placed[1] * found[1][0]


def _write_clouds(topic: Topic, times: np.ndarray, where: tuple[np.ndarray, Rotation],
                  folder: Path, settings: ImportSettings, progress: Progress) -> None:
    counts = topic.counts
    ends = np.cumsum(counts) if counts is not None else np.empty(0, int)
    with tempfile.TemporaryDirectory(prefix="limber-bag-") as scratch:
        for number, time in enumerate(times):
            points = topic.values[number] if counts is None else topic.values[
                ends[number] - counts[number]:ends[number]]
            points = where[0] + where[1].apply(points[np.isfinite(points).all(axis=1)])
            write_frame(Path(scratch, f"{time:.6f}.ply"), points)
        copy_clouds(Path(scratch), folder, settings.model_copy(update={"unit": "m"}), progress)


def _write_images(bag: Bag, topic: Topic, times: np.ndarray, base: str,
                  placed: tuple[np.ndarray, Rotation], frames: Frames, folder: Path,
                  settings: ImportSettings, warnings: list[str], progress: Progress) -> None:
    from PIL import Image

    height, width = topic.values.shape[1:]
    infos = [info for info in bag.of("camera") if tuple(info.values[0, :2]) == (width, height)]
    beside = [info for info in infos if info.name.rsplit("/", 1)[0] == topic.name.rsplit("/", 1)[0]]
    if not infos:
        raise InputError(f"{bag.path}: there is no CameraInfo of {width} x {height} pixels for "
                         f"{topic.name}.", "Depth images cannot be used without focal length and "
                         "principal point.", "Record the camera_info topic too.")
    _, _, fx, fy, cx, cy = (beside or infos)[0].values[0]
    position, turn = _frame_of(topic, base, placed, frames, warnings)
    camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, depth_scale=1000.0,
                    pose=(*map(float, position), *map(float, turn.as_rotvec())))
    with tempfile.TemporaryDirectory(prefix="limber-bag-") as scratch:
        Path(scratch, "depth").mkdir()
        write_camera(Path(scratch, "camera.toml"), camera)
        for image, time in zip(topic.values, times, strict=True):
            # By ROS' convention (REP 118) 16 bits are millimetres, floats metres.
            depth = image if image.dtype.kind == "u" else np.clip(
                np.nan_to_num(image) * 1000.0, 0, 65535).round().astype(np.uint16)
            Image.fromarray(depth).save(Path(scratch, "depth", f"{time:.6f}.png"))
        warnings += copy_rgbd(Path(scratch), folder, settings, progress)


def _six(positions: np.ndarray, turns: Rotation) -> np.ndarray:
    return np.hstack([positions, turns.as_rotvec()])
