"""A pull as an MCAP file of ROS 2 messages, which Foxglove, PlotJuggler and ROS open.

Topics: ``/gripper/wrench`` (what the gripper exerts on the branch), ``/gripper/pose``, ``/tf``
(branch to gripper and camera), ``/markers`` or ``/cloud`` (PointCloud2), ``/camera/depth`` with
``/camera/camera_info``. All but the camera's are in the frame ``branch``.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.optional import require_extra
from limber.geometry.cloud.camera import Camera, read_camera
from limber.geometry.io.clouds import read_points
from limber.geometry.io.depth_images import depth_metres
from limber.recordings.bags.bag_pull import BRANCH_FRAME
from limber.recordings.bags.bag_reader import LIMBER, PULL_TOML
from limber.recordings.recording import Pull, entry_text

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
