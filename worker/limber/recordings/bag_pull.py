"""A bag as a pull: choice of topics, one clock, and the gripper's wrench on the branch."""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError, Option, Text
from limber.core.optional import require_extra
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.camera import Camera, read_camera, write_camera
from limber.geometry.io.clouds import read_points
from limber.geometry.io.depth_images import depth_metres
from limber.recordings.bag_reader import LIMBER, PULL_TOML, Bag, Frames, Motion, Topic, stamped
from limber.recordings.image_folders import copy_clouds, copy_rgbd, moved_into, write_frame
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, Observations, Pull, entry_text
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
    wrench = _chosen(bag, "wrench", settings.wrench_topic, "wrench_topic",
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
        raise InputError(f"{bag.path} has {missing}.", Text(why, f" Its topics: {present[:400]}."),
                         "Name a topic with ", Option(option), f" (known: {known}).")
    raise InputError(f"{bag.path} has {len(topics)} {kind} topics: {known}.", "A pull uses one "
                     "gripper and one topic of each kind.", "Select one with ", Option(option), ".")


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
    topic = _chosen(bag, "pose", name, "pose_topic", "The gripper's pose is needed.")
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
        raise InputError(f"{bag.path} contains only joint angles.", "The gripper's pose must be "
                         "computed from the arm's model and tool.", "Give the robot's cell file "
                         "with ", Option("cell"), " cell.toml, or record poses or TF.")
    topic = _chosen(bag, "joints", name, "pose_topic", "The gripper's pose is needed.")
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
    raise InputError(f"{bag.path}: the {one} time stamps run from {first[0]:.1f} to "
                     f"{first[-1]:.1f} s, the {other} time stamps from {second[0]:.1f} to "
                     f"{second[-1]:.1f} s. They start {abs(first[0] - second[0]):.0f} s apart.",
                     "They do not overlap, so they come from different clocks.", "Synchronise the "
                     "clocks (NTP), or use the other time stamps with ", Option("bag_clock", hint),
                     ".")


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
        warnings.append(Text(f"Poses are in frame {base or '(none)'}, which is assumed to be the "
                             "branch's frame. If it is not, give ", Option("frame_pose"), "."))
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
        _chosen(bag, "points", named, "points_topic", Text("The option ", Option("points_topic"),
                                                             " requests it."))
    if len(images) + len(points) > 1:
        if named is None and len(points) == 1:
            images = []
        else:
            known = ", ".join(topic.name for topic in (*images, *points))
            raise InputError(f"{bag.path} has more than one topic that shows the branch: {known}.",
                             "The model is compared with only one of them.", "Select one with ",
                             Option("points_topic"), ", or give ",
                             Option("points_topic", "none"), ".")
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


# A pull as an MCAP file of ROS 2 messages, which Foxglove, PlotJuggler and ROS open.
#
# Topics: ``/gripper/wrench`` (what the gripper exerts on the branch), ``/gripper/pose``, ``/tf``
# (branch to gripper and camera), ``/markers`` or ``/cloud`` (PointCloud2), ``/camera/depth`` with
# ``/camera/camera_info``. All but the camera's are in the frame ``branch``.

_GRIPPER, _CAMERA = "gripper", "camera"
_Message = tuple[float, str, str, Any]


def write_mcap(path: Path, folder: Path, pull: Pull) -> dict[str, int]:
    """Write a pull and the frames in its folder; return the number of messages per topic.

    Times start at 0. Wrenches and poses that were not measured are omitted.

    Raises:
        MissingDependencyError: the packages are not installed.
    """
    require_extra("bags", ("mcap", "rosbags"), "Writing an MCAP file")
    from mcap.writer import Writer

    messages = _Messages()
    begin = min([float(pull.times[0]), *(time for time, _ in _frames(folder)),
                 *(pull.observations.times[:1] + pull.entry.time_offset_s
                   if pull.observations is not None else [])])
    counts: dict[str, int] = {}
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="limber")
        writer.add_metadata(LIMBER, {"pull": pull.name, PULL_TOML: entry_text(pull.entry)})
        channels: dict[str, int] = {}
        every = sorted([*_of_robot(messages, pull), *_of_points(messages, pull),
                        *_of_frames(messages, folder, pull)], key=lambda entry: entry[0])
        for time, topic, kind, make in every:
            if topic not in channels:
                text, _ = messages.store.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            seconds = max(time - begin, 0.0)
            data = bytes(messages.store.serialize_cdr(make(seconds), kind))
            stamp = round(1e9 * seconds)
            writer.add_message(channels[topic], stamp, data, stamp)
            counts[topic] = counts.get(topic, 0) + 1
        writer.finish()
    return counts


def _frames(folder: Path) -> list[tuple[float, Path]]:
    """Depth images and clouds by time [s]."""
    files = [*(folder / "depth").glob("*.png"), *(folder / "clouds").glob("*.ply")]
    return sorted((float(file.stem), file) for file in files)


class _Messages:
    """Makes messages by ROS 2's own definitions."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)

    def make(self, kind: str, **content: Any) -> Any:
        """Return a message of a type such as ``geometry_msgs/msg/Vector3``."""
        return self.store.types[kind](**content)

    def header(self, seconds: float, frame: str = BRANCH_FRAME) -> Any:
        """Return a header."""
        whole = int(seconds)
        nanoseconds = min(round(1e9 * (seconds - whole)), 999_999_999)
        stamp = self.make("builtin_interfaces/msg/Time", sec=whole, nanosec=nanoseconds)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def vector(self, values: np.ndarray, kind: str = "Vector3") -> Any:
        """Return a vector or point."""
        x, y, z = map(float, values)
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def turn(self, vector: np.ndarray) -> Any:
        """Return the quaternion of a rotation vector [rad]."""
        x, y, z, w = map(float, Rotation.from_rotvec(vector).as_quat())
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def transform(self, seconds: float, child: str, pose: np.ndarray) -> Any:
        """Return the pose of a frame in the branch's."""
        moved = self.make("geometry_msgs/msg/Transform", translation=self.vector(pose[:3]),
                          rotation=self.turn(pose[3:]))
        return self.make("tf2_msgs/msg/TFMessage", transforms=[self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(seconds),
            child_frame_id=child, transform=moved)])

    def cloud(self, seconds: float, points: np.ndarray) -> Any:
        """Return points [n, 3] as doubles; NaN for points not seen."""
        rows = np.ascontiguousarray(points, "<f8")
        fields = [self.make("sensor_msgs/msg/PointField", name=name, offset=8 * k, datatype=8,
                            count=1) for k, name in enumerate("xyz")]
        return self.make(
            "sensor_msgs/msg/PointCloud2", header=self.header(seconds), height=1,
            width=len(rows), fields=fields, is_bigendian=False, point_step=24,
            row_step=24 * len(rows), data=np.frombuffer(rows.tobytes(), np.uint8),
            is_dense=bool(np.isfinite(rows).all()))


def _of_robot(messages: _Messages, pull: Pull) -> Iterator[_Message]:
    for time, pose, wrench in zip(pull.times, pull.poses, pull.wrenches, strict=True):
        yield time, "/gripper/pose", "geometry_msgs/msg/PoseStamped", (
            lambda seconds, pose=pose: messages.make(
                "geometry_msgs/msg/PoseStamped", header=messages.header(seconds),
                pose=messages.make("geometry_msgs/msg/Pose",
                                   position=messages.vector(pose[:3], "Point"),
                                   orientation=messages.turn(pose[3:]))))
        yield time, "/tf", "tf2_msgs/msg/TFMessage", (
            lambda seconds, pose=pose: messages.transform(seconds, _GRIPPER, pose))
        if np.isfinite(wrench[:3]).all():
            yield time, "/gripper/wrench", "geometry_msgs/msg/WrenchStamped", (
                lambda seconds, wrench=wrench: messages.make(
                    "geometry_msgs/msg/WrenchStamped", header=messages.header(seconds),
                    wrench=messages.make("geometry_msgs/msg/Wrench",
                                         force=messages.vector(wrench[:3]),
                                         torque=messages.vector(wrench[3:]))))


def _of_points(messages: _Messages, pull: Pull) -> Iterator[_Message]:
    if pull.observations is None:
        return
    times = pull.observations.times + pull.entry.time_offset_s
    for time, points in zip(times, pull.observations.positions, strict=True):
        yield time, "/markers", "sensor_msgs/msg/PointCloud2", (
            lambda seconds, points=points: messages.cloud(seconds, points))


def _of_frames(messages: _Messages, folder: Path, pull: Pull) -> Iterator[_Message]:
    """Images and clouds of a camera; each file is read when it is written."""
    offset = pull.entry.time_offset_s
    camera = read_camera(folder / "camera.toml") if (folder / "camera.toml").is_file() else None
    for time, file in _frames(folder):
        if file.suffix == ".ply":
            yield time + offset, "/cloud", "sensor_msgs/msg/PointCloud2", (
                lambda seconds, file=file: messages.cloud(seconds, read_points(file).points))
        elif camera is not None:
            yield time + offset, "/camera/depth", "sensor_msgs/msg/Image", (
                lambda seconds, file=file: _image(messages, seconds, file, camera))
            yield time + offset, "/camera/camera_info", "sensor_msgs/msg/CameraInfo", (
                lambda seconds: _camera_info(messages, seconds, camera))
            yield time + offset, "/tf", "tf2_msgs/msg/TFMessage", (
                lambda seconds: messages.transform(seconds, _CAMERA, np.array(camera.pose)))


def _image(messages: _Messages, seconds: float, file: Path, camera: Camera) -> Any:
    """Depths in metres as floats, whatever the file's scale."""
    depth = depth_metres(file, camera).astype("<f4")
    return messages.make(
        "sensor_msgs/msg/Image", header=messages.header(seconds, _CAMERA),
        height=depth.shape[0], width=depth.shape[1], encoding="32FC1", is_bigendian=0,
        step=4 * depth.shape[1], data=np.frombuffer(depth.tobytes(), np.uint8))


def _camera_info(messages: _Messages, seconds: float, camera: Camera) -> Any:
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
    p = np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1.0, 0])
    return messages.make(
        "sensor_msgs/msg/CameraInfo", header=messages.header(seconds, _CAMERA),
        height=camera.height, width=camera.width, distortion_model="plumb_bob", d=np.zeros(5),
        k=k, r=np.eye(3).ravel(), p=p, binning_x=0, binning_y=0,
        roi=messages.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0,
                          width=0, do_rectify=False))
