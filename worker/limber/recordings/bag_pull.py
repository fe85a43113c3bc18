"""A bag as a pull: choice of topics, one clock, and the gripper's wrench on the branch."""

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError, Option, Text
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.core.optional import require_extra
from limber.geometry.cloud.camera import Camera, read_camera, write_camera
from limber.geometry.io.clouds import read_points
from limber.geometry.io.depth_images import depth_metres
from limber.recordings.bag_reader import LIMBER, PULL_TOML, Bag, Frames, Motion, Topic, stamped
from limber.recordings.image_folders import copy_clouds, copy_rgbd, moved_into, write_frame
from limber.recordings.import_request import ImportRequest, Recorded
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, Observations, Pull, entry_text
from limber.recordings.time_series import Stream

BRANCH_FRAME = "branch"
"""Frame of a bag that is taken as the branch's."""

MOST_MARKERS = 60
"""Most points of a cloud that counts as tracked markers, if all clouds have the same number."""

_LONGEST_GAP = 0.1  # [s] between wrenches, or three of their steps, beyond which nothing is known
_GRIPPERS = ("grasp", "gripper", "tcp", "tool", "tool0", "flange", "ee_link", "hand")

def pull_of_bag(bag: Bag, request: ImportRequest) -> Recorded:
    """Return the series of a bag; images and clouds become files in the pull's folder. InputError
    without wrench or pose, with several grippers and no choice, or clocks that do not overlap."""
    return _BagReading(bag, request).recorded()


class _BagReading:
    """A bag with the clock and the frames that are used, and what was assumed."""

    def __init__(self, bag: Bag, request: ImportRequest):
        self.request, self.settings = request, request.settings
        self.clock = "stamps" if self.settings.bag_clock == "header" else "logged"
        self.warnings = list(bag.notes)
        self.bag = stamped(bag, self.clock, self.warnings)
        self.frames = Frames(self.bag.of("transform"), self.clock)

    def times(self, topic: Topic) -> np.ndarray:
        """Times of a topic's messages [s]."""
        return getattr(topic, self.clock)

    def recorded(self) -> Recorded:
        """The gripper's poses and wrenches, and the observations, from time 0."""
        wrench = self.chosen("wrench", "wrench",
                             "Stiffness cannot be estimated without a measured force.")
        if self.bag.broken:
            self.warnings.append(f"{self.bag.path.name}: {self.bag.broken} messages could not be "
                                 "decoded and were discarded.")
        times, poses, self.base = self.gripper()
        self.require_one_clock("wrench", self.times(wrench), times)
        wrenches = self.on_branch(wrench, times, poses)
        self.placed = self.placement()
        poses, wrenches = moved_into(pose_vectors(self.placed), poses, wrenches)
        self.begin = float(times[0])
        robot = Stream(times - self.begin, np.hstack([poses, wrenches]),
                       POSE_COLUMNS + WRENCH_COLUMNS)
        observation, seen = self.observed()
        if seen is not None:
            self.require_one_clock("points", seen.times + self.begin, times)
        labels = [f"m{k}" for k in range(0 if seen is None else seen.point_count)]
        return Recorded(observation, robot, seen, labels, is_table=False,
                        warnings=tuple(self.warnings))

    def chosen(self, kind: str, name: str, why: str) -> Topic:
        """The one topic of a kind, or the one that was given for ``name``."""
        bag, topics, named = self.bag, self.bag.of(kind), self.settings.topic_of(name)
        option = Option("topic", (f"{name}=TOPIC",))
        if named is not None:
            topics = tuple(topic for topic in topics if topic.name == named)
        if len(topics) == 1:
            return topics[0]
        known = ", ".join(topic.name for topic in bag.of(kind)) or "none"
        if not topics:
            present = ", ".join((*(topic.name for every in bag.kinds.values() for topic in every),
                                 *bag.others)) or "no messages"
            missing = f"no {kind}" if named is None else f"no {kind} on {named}"
            raise InputError(f"{bag.path} has {missing}.",
                             Text(why, f" Its topics: {present[:400]}."),
                             "Name a topic with ", option, f" (known: {known}).")
        raise InputError(f"{bag.path} has {len(topics)} {kind} topics: {known}.", "A pull uses one "
                         "gripper and one topic of each kind.", "Select one with ", option, ".")

    def gripper(self) -> tuple[np.ndarray, np.ndarray, str]:
        """Times [s], poses [n, 6] of the gripper, and their reference frame."""
        name = self.settings.topic_of("pose")
        if not self.bag.of("pose") or (name is not None and not name.startswith("/")):
            found = self.by_frames(name) or self.by_joints()
            if found is not None:
                return found
        topic = self.chosen("pose", "pose", "The gripper's pose is needed.")
        motion = Motion.of(self.times(topic), topic.values)
        if len(motion.times) < 2:
            raise InputError(f"{self.bag.path}: {topic.name} has {len(motion.times)} poses.",
                             "A pull needs at least two.", "Record it again.")
        return motion.times, motion.poses, topic.frame.lstrip("/")

    def by_frames(self, name: str | None) -> tuple[np.ndarray, np.ndarray, str] | None:
        """The gripper from the tree of frames, if it moves there."""
        moving = [topic for topic in self.bag.of("transform") if len(topic.stamps) > 2]
        chosen = [frame for frame in self.frames.names
                  if (frame == name if name else frame.lower() in _GRIPPERS)]
        if not moving or not chosen:
            return None
        # Of a chain flange, tool0, gripper, the last in our list is the gripper.
        frame = min(chosen, key=lambda frame: name is None and _GRIPPERS.index(frame.lower()))
        longest = max(moving, key=lambda topic: len(topic.stamps))
        root = _root(self.bag, frame)
        times = np.unique(self.times(longest))
        found = self.frames.between(frame, root, times)
        if found is None:
            return None
        self.warnings.append(
            f"{self.bag.path.name}: the gripper's pose is that of frame {frame} in {root}.")
        return times, pose_vectors(found), root

    def by_joints(self) -> tuple[np.ndarray, np.ndarray, str] | None:
        """The gripper from the arm's joint angles; InputError if there are only angles, and no arm
        was named."""
        if not self.bag.of("joints"):
            return None
        if self.request.robot is None:
            raise InputError(f"{self.bag.path} contains only joint angles.", "The gripper's pose "
                             "must be computed from the arm's model and tool.", "Give the robot's "
                             "cell file with ", Option("cell"), " cell.toml, or record poses or "
                             "TF.")
        topic = self.chosen("joints", "pose", "The gripper's pose is needed.")
        times, first = np.unique(self.times(topic), return_index=True)
        return times, self.request.robot.joint_poses(topic.labels, topic.values[first]), "base"

    def require_one_clock(self, one: str, first: np.ndarray, second: np.ndarray) -> None:
        """Refuse times [s] that do not overlap with those of the poses."""
        if not (len(first) and len(second)):
            return
        if first[0] <= second[-1] and second[0] <= first[-1]:
            return
        hint = "log" if self.settings.bag_clock == "header" else "header"
        raise InputError(f"{self.bag.path}: the {one} time stamps run from {first[0]:.1f} to "
                         f"{first[-1]:.1f} s, the pose time stamps from {second[0]:.1f} to "
                         f"{second[-1]:.1f} s. They start {abs(first[0] - second[0]):.0f} s apart.",
                         "They do not overlap, so they come from different clocks.", "Synchronise "
                         "the clocks (NTP), or use the other time stamps with ",
                         Option("bag_clock", hint), ".")

    def on_branch(self, topic: Topic, times: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Wrench at the poses' times, in the poses' frame, about the gripper, shape [n, 6]."""
        clock = self.times(topic)
        order = np.argsort(clock, kind="stable")
        stamps, values = clock[order], topic.values[order]
        good = np.isfinite(values).all(axis=1) & np.isfinite(stamps)
        stamps, values = stamps[good], values[good]
        if len(stamps) < 2:
            raise InputError(f"{topic.name} has {len(stamps)} wrenches.",
                             "A pull needs at least two.", "Record it again.")
        after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
        longest = max(_LONGEST_GAP, 3 * float(np.median(np.diff(stamps))))
        lonely = (stamps[after] - stamps[after - 1] > longest) | (
            times < stamps[0] - longest) | (times > stamps[-1] + longest)
        wrench = np.column_stack([np.interp(times, stamps, column) for column in values.T])
        wrench[lonely] = np.nan
        own, base = topic.frame.lstrip("/"), self.base
        if own == base or (own == BRANCH_FRAME and not base):
            return wrench
        found = self.frames.between(own, base, times)
        if found is None:
            self.warnings.append(f"{topic.name} is in frame {own or '(none)'}, whose pose in "
                                 f"{base or '(none)'} is not known. It is assumed to have the "
                                 "gripper's axes and centre.")
            found = matrices(poses)
        lever = found[:, :3, 3] - poses[:, :3]
        force, torque = (np.einsum("nij,nj->ni", found[:, :3, :3], np.nan_to_num(part))
                         for part in np.hsplit(wrench, 2))
        turned = np.hstack([force, torque + np.cross(lever, force)])
        turned[lonely] = np.nan
        return turned

    def placement(self) -> np.ndarray:
        """The poses' frame in the branch's, shape [4, 4]."""
        base, stated = self.base, self.settings.frame_pose
        where = f"Poses are in frame {base or '(none)'}"
        if stated is not None:
            placed = matrices(np.array(stated))
            if self.settings.cell is None or base == "base":
                return placed
            found = self.static(base, "base")
            if found is None:
                self.warnings.append(f"{where}. It is assumed to be the robot's base as the "
                                     "pendant shows it. ROS' base_link is rotated by 180 degrees "
                                     "relative to that base.")
            return placed if found is None else placed @ found
        found = self.static(base, BRANCH_FRAME)
        if found is None:
            self.warnings.append(Text(f"{where}, which is assumed to be the branch's frame. If it "
                                      "is not, give ", Option("frame_pose"), "."))
        return np.eye(4) if found is None else found

    def static(self, frame: str, within: str) -> np.ndarray | None:
        """A static frame in another, shape [4, 4], if the bag connects them."""
        found = self.frames.between(frame, within, np.zeros(1))
        return None if found is None else found[0]

    def frame_of(self, topic: Topic) -> np.ndarray:
        """A static topic's frame in the branch's, shape [4, 4]."""
        own = topic.frame.lstrip("/")
        if own == BRANCH_FRAME:
            return np.eye(4)
        found = self.static(own, self.base)
        if found is None:
            self.warnings.append(f"{topic.name} is in frame {own or '(none)'}, whose position is "
                                 "not known. It is assumed to be the frame of the poses.")
        return self.placed if found is None else self.placed @ found

    def observed(self) -> tuple[str, Observations | None]:
        """Observations of the branch: markers as values; images and clouds become files."""
        bag, named = self.bag, self.settings.topic_of("points")
        if named == "none":
            return "none", None
        images = [topic for topic in bag.of("image") if named in (None, topic.name)]
        points = [topic for topic in bag.of("points") if named in (None, topic.name)]
        if named is not None and not images and not points:
            self.chosen("points", "points",
                        Text("The option ", Option("topic"), " requests it."))
        if named is None and len(points) == 1:
            images = []
        if len(images) + len(points) > 1:
            known = ", ".join(topic.name for topic in (*images, *points))
            raise InputError(f"{bag.path} has more than one topic that shows the branch: {known}.",
                             "The model is compared with only one of them.", "Select one with ",
                             Option("topic", ("points=TOPIC",)), ", or give ",
                             Option("topic", ("points=none",)), ".")
        if images:
            self.write_images(images[0])
            return "depth", None
        if not points:
            return "none", None
        topic, times = points[0], self.times(points[0]) - self.begin
        placed = self.frame_of(topic)
        if topic.counts is None and topic.values.shape[1] <= MOST_MARKERS:
            moved = topic.values @ placed[:3, :3].T + placed[:3, 3]
            order = np.unique(times, return_index=True)[1]
            return "markers", self.request.tracks(times[order], moved[order])
        ends = np.cumsum([len(points) for points in topic.values] if topic.counts is None
                         else topic.counts)
        parts = np.split(topic.values.reshape(-1, 3), ends[:-1])
        with tempfile.TemporaryDirectory(prefix="limber-bag-") as scratch:
            for time, part in zip(times, parts, strict=True):
                write_frame(Path(scratch, f"{time:.6f}.ply"),
                            part[np.isfinite(part).all(axis=1)] @ placed[:3, :3].T
                            + placed[:3, 3])
            copy_clouds(Path(scratch), self.request.folder,
                        self.settings.model_copy(update={"unit": "m"}), self.request.progress)
        return "clouds", None

    def write_images(self, topic: Topic) -> None:
        """Depth images with the pose and intrinsics of their camera, into the pull's folder."""
        from PIL import Image

        height, width = topic.values.shape[1:]
        infos = [info for info in self.bag.of("camera")
                 if tuple(info.values[0, :2]) == (width, height)]
        beside = [info for info in infos
                  if info.name.rsplit("/", 1)[0] == topic.name.rsplit("/", 1)[0]]
        if not infos:
            raise InputError(f"{self.bag.path}: there is no CameraInfo of {width} x {height} "
                             f"pixels for {topic.name}.", "Depth images cannot be used without "
                             "focal length and principal point.",
                             "Record the camera_info topic too.")
        _, _, fx, fy, cx, cy = (beside or infos)[0].values[0]
        pose = pose_vectors(self.frame_of(topic)).tolist()
        camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, depth_scale=1000.0,
                        pose=tuple(pose))
        with tempfile.TemporaryDirectory(prefix="limber-bag-") as scratch:
            Path(scratch, "depth").mkdir()
            write_camera(Path(scratch, "camera.toml"), camera)
            for image, time in zip(topic.values, self.times(topic) - self.begin, strict=True):
                # By ROS' convention (REP 118) 16 bits are millimetres, floats metres.
                depth = image if image.dtype.kind == "u" else np.clip(
                    np.nan_to_num(image) * 1000.0, 0, 65535).round().astype(np.uint16)
                Image.fromarray(depth).save(Path(scratch, "depth", f"{time:.6f}.png"))
            self.warnings += copy_rgbd(Path(scratch), self.request.folder, self.settings,
                                       self.request.progress)


def _root(bag: Bag, frame: str) -> str:
    """The root frame above ``frame``."""
    above = {topic.labels[0].lstrip("/"): topic.frame.lstrip("/") for topic in bag.of("transform")}
    seen = {frame}
    while frame in above and above[frame] not in seen and frame != BRANCH_FRAME:
        frame = above[frame]
        seen.add(frame)
    return frame


# A pull as an MCAP file of ROS 2 messages, which Foxglove, PlotJuggler and ROS open.
#
# Topics: ``/gripper/wrench`` (what the gripper exerts on the branch), ``/gripper/pose``, ``/tf``
# (branch to gripper and camera), ``/markers`` or ``/cloud`` (PointCloud2), ``/camera/depth`` with
# ``/camera/camera_info``. All but the camera's are in the frame ``branch``.

_GRIPPER, _CAMERA = "gripper", "camera"
_Message = tuple[float, str, Callable[[float], Any]]
"""Time [s], topic, and the message for a time from the first one's on [s]."""


def write_mcap(path: Path, folder: Path, pull: Pull) -> dict[str, int]:
    """Write a pull and the frames in its folder, from time 0, without what was not measured; return
    the number of messages per topic. MissingDependencyError without the packages."""
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
        for time, topic, make in every:
            seconds = max(time - begin, 0.0)
            message = make(seconds)
            kind = message.__msgtype__
            if topic not in channels:
                text, _ = messages.store.generate_msgdef(kind, ros_version=2)
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(messages.store.serialize_cdr(message, kind))
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

    def pose(self, pose: np.ndarray, seconds: float) -> Any:
        """Return a pose [m, rad], shape [6]."""
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(seconds),
                         pose=self.make("geometry_msgs/msg/Pose",
                                        position=self.vector(pose[:3], "Point"),
                                        orientation=self.turn(pose[3:])))

    def wrench(self, wrench: np.ndarray, seconds: float) -> Any:
        """Return a force and torque [N, N m], shape [6]."""
        return self.make("geometry_msgs/msg/WrenchStamped", header=self.header(seconds),
                         wrench=self.make("geometry_msgs/msg/Wrench",
                                          force=self.vector(wrench[:3]),
                                          torque=self.vector(wrench[3:])))

    def transform(self, child: str, pose: np.ndarray, seconds: float) -> Any:
        """Return the pose of a frame in the branch's."""
        moved = self.make("geometry_msgs/msg/Transform", translation=self.vector(pose[:3]),
                          rotation=self.turn(pose[3:]))
        return self.make("tf2_msgs/msg/TFMessage", transforms=[self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(seconds),
            child_frame_id=child, transform=moved)])

    def cloud(self, points: np.ndarray, seconds: float) -> Any:
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
        yield time, "/gripper/pose", partial(messages.pose, pose)
        yield time, "/tf", partial(messages.transform, _GRIPPER, pose)
        if np.isfinite(wrench[:3]).all():
            yield time, "/gripper/wrench", partial(messages.wrench, wrench)


def _of_points(messages: _Messages, pull: Pull) -> Iterator[_Message]:
    if pull.observations is None:
        return
    times = pull.observations.times + pull.entry.time_offset_s
    for time, points in zip(times, pull.observations.positions, strict=True):
        yield time, "/markers", partial(messages.cloud, points)


def _of_frames(messages: _Messages, folder: Path, pull: Pull) -> Iterator[_Message]:
    """Images and clouds of a camera; each file is read when it is written."""
    offset = pull.entry.time_offset_s
    camera = read_camera(folder / "camera.toml") if (folder / "camera.toml").is_file() else None
    for time, file in _frames(folder):
        if file.suffix == ".ply":
            yield time + offset, "/cloud", partial(_cloud, messages, file)
        elif camera is not None:
            yield time + offset, "/camera/depth", partial(_image, messages, camera, file)
            yield time + offset, "/camera/camera_info", partial(_camera_info, messages, camera)
            yield time + offset, "/tf", partial(messages.transform, _CAMERA, np.array(camera.pose))


def _cloud(messages: _Messages, file: Path, seconds: float) -> Any:
    return messages.cloud(read_points(file).points, seconds)


def _image(messages: _Messages, camera: Camera, file: Path, seconds: float) -> Any:
    """Depths in metres as floats, whatever the file's scale."""
    depth = depth_metres(file, camera).astype("<f4")
    return messages.make(
        "sensor_msgs/msg/Image", header=messages.header(seconds, _CAMERA),
        height=depth.shape[0], width=depth.shape[1], encoding="32FC1", is_bigendian=0,
        step=4 * depth.shape[1], data=np.frombuffer(depth.tobytes(), np.uint8))


def _camera_info(messages: _Messages, camera: Camera, seconds: float) -> Any:
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1.0])
    p = np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1.0, 0])
    return messages.make(
        "sensor_msgs/msg/CameraInfo", header=messages.header(seconds, _CAMERA),
        height=camera.height, width=camera.width, distortion_model="plumb_bob", d=np.zeros(5),
        k=k, r=np.eye(3).ravel(), p=p, binning_x=0, binning_y=0,
        roi=messages.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0,
                          width=0, do_rectify=False))
