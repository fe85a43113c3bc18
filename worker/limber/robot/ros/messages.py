"""Topics and messages of ROS 2 as the robot's own values: joints, wrenches, paths, clouds."""

import base64
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, WorkError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot.interface import PLAYING, Sample
from limber.robot.motion.trajectory import Trajectory
from limber.robot.ros.bridge import Bridge
from limber.robot.ros.topics import Topics

JOINT_STATE = "sensor_msgs/msg/JointState"
STOP = "std_msgs/msg/Bool"
END = "std_msgs/msg/Empty"
CLOUD = "sensor_msgs/msg/PointCloud2"
FOLLOW = "control_msgs/action/FollowJointTrajectory"
JOG = "control_msgs/msg/JointJog"
TWIST = "geometry_msgs/msg/TwistStamped"
STATUS_KINDS = {"safety_mode": "ur_dashboard_msgs/msg/SafetyMode",
                "robot_mode": "ur_dashboard_msgs/msg/RobotMode",
                "runtime_state": "std_msgs/msg/Bool", "slider": "std_msgs/msg/Float64"}
"""What the UR driver publishes of its controller: the field of a sample, and the message."""
RUNNING: dict[str, Any] = {"safety_mode": 1, "robot_mode": 7, "runtime_state": PLAYING,
                           "slider": 1.0}
"""A controller in order: of an arm whose driver publishes nothing of it."""
_PROGRAM_STOPPED = 1
_SOFTLY_SECONDS = 0.3  # more than the path's own time, to set off after a pause
_AXES = ("x", "y", "z")
_SPLINE_RAD = 5e-5  # from a trajectory between two points of its goal; .05 mm at a reach of 1 m
_FLOATS = {7: "f4", 8: "f8"}  # sensor_msgs/msg/PointField


def stamp_of(message: dict[str, Any]) -> float:
    """Return the time of a message with a header [s]."""
    stamp = message["header"]["stamp"]
    return float(stamp["sec"]) + 1e-9 * float(stamp.get("nanosec", stamp.get("nsecs", 0)))


class JointStates:
    """Turns joint states into samples of a cell's arm, past those of other nodes; ``ordered``: its
    joints' names in ROS, empty before its first message, ``others``: those of the last message not
    of it."""

    def __init__(self, cell: Cell, prefix: str = ""):
        # A URDF file's own names may have the prefix already.
        self._arm, self.wanted = cell.arm, [name if name.startswith(prefix) else prefix + name
                                            for name in cell.arm.ros_joints]
        self._prefix = prefix
        self._tool = matrices(np.array(cell.tool.grasp_pose))
        self.ordered: list[str] = []
        self.others: list[str] = []

    def sample(self, message: dict[str, Any], arrived: float,
               status: Mapping[str, Any] = RUNNING) -> Sample | None:
        """Return the sample of a message that arrived at ``arrived`` [s, monotonic], None if it
        lacks joints of the arm; missing numbers are NaN, for which the guard stops. ``status``: by
        the names of :class:`.Sample`. InputError if a joint matches two names, or another arm's
        joints come too."""
        if (chosen := self._chosen(message["name"])) is None:
            self.others = list(message["name"])
            return None
        joints = _of(message, "position", chosen)
        speeds = _of(message, "velocity", chosen)
        pose, speed = np.full(6, np.nan), np.full(6, np.nan)
        if np.isfinite(joints).all():
            flange = self._arm.forward(joints)
            pose = pose_vectors(flange @ self._tool)
            speed = self._arm.jacobian(joints) @ speeds
            speed[:3] += np.cross(speed[3:], flange[:3, :3] @ self._tool[:3, 3])
        return Sample(clock=stamp_of(message), arrived=arrived, joints=joints, joint_speeds=speeds,
                      pose=pose, speed=speed, wrench=np.zeros(6), **status)

    def _chosen(self, names: list[str]) -> list[int] | None:
        """Where the arm's joints are in a message's names, or None."""
        if self.ordered and set(self.ordered) <= set(names):
            return [names.index(name) for name in self.ordered]
        found = [[k for k, name in enumerate(names) if name == joint]
                 or [k for k, name in enumerate(names)
                     if joint in name and name.startswith(self._prefix)]
                 for joint in self.wanted]
        if not all(found):
            return None
        for number, (joint, places) in enumerate(zip(self.wanted, found, strict=True)):
            alike = self.ordered[number:number + 1] + [names[k] for k in places]
            if len(alike) != 1:
                raise InputError(f"{len(alike)} joints of ROS are named like {joint}: "
                                 f"{', '.join(alike)}.", f"A {self._arm.name} has one.",
                                 "State robot.ros.prefix in the cell file, the beginning of its "
                                 "joints' names, where two arms publish on one topic.")
        self.ordered = [names[places[0]] for places in found]
        return [places[0] for places in found]


def _of(message: dict[str, Any], name: str, chosen: list[int]) -> np.ndarray:
    values = message.get(name) or []
    if len(values) <= max(chosen):
        return np.full(len(chosen), np.nan)
    return np.array([np.nan if values[k] is None else values[k] for k in chosen], float)


def status_of(name: str, message: dict[str, Any]) -> float:
    """Return what a message of :data:`STATUS_KINDS` reports, as :class:`.Sample` has it."""
    if name == "slider":  # in per cent
        return np.nan if message["data"] is None else 0.01 * float(message["data"])
    if name == "runtime_state":
        return PLAYING if message["data"] else _PROGRAM_STOPPED
    return int(message["mode"])


def wrench_of(message: dict[str, Any]) -> np.ndarray:
    """Return force and torque of a stamped wrench [N, N m], shape [6]."""
    fields = message["wrench"]
    values = [fields[kind].get(axis) for kind in ("force", "torque") for axis in "xyz"]
    return np.array([np.nan if value is None else value for value in values], float)


def cloud_of(message: dict[str, Any]) -> np.ndarray:
    """Return the finite points [m], shape [n, 3], of a PointCloud2 as rosbridge sends it, in base64
    (rosbridge v2 protocol: byte arrays); InputError without coordinates, or of another size than
    stated."""
    try:
        data = base64.b64decode(message["data"], validate=True)
        kinds = {field["name"]: (int(field["offset"]), _FLOATS[field["datatype"]])
                 for field in message["fields"] if field["name"] in _AXES}
        order = ">" if message["is_bigendian"] else "<"
        layout = np.dtype({"names": _AXES, "formats": [order + kinds[axis][1] for axis in _AXES],
                           "offsets": [kinds[axis][0] for axis in _AXES],
                           "itemsize": int(message["point_step"])})
        width, height, step = (int(message[name]) for name in ("width", "height", "row_step"))
        if len(data) != height * step or step < width * layout.itemsize:
            raise ValueError(f"{len(data)} bytes for {height} rows of {step}")
        rows: np.ndarray = np.ndarray((height, width), layout, data,
                                      strides=(step, layout.itemsize))
        points = np.stack([rows[axis].astype(float) for axis in _AXES], axis=-1).reshape(-1, 3)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"A message is no cloud of points ({error!r}).",
                         "x, y and z as floating-point numbers are needed.",
                         "Check the topic: it has to be a sensor_msgs/msg/PointCloud2.") from error
    return points[np.isfinite(points).all(axis=1)]


def goal_of(trajectory: Trajectory, names: list[str], since: float = 0.0,
            here: np.ndarray | None = None) -> dict[str, Any]:
    """Return the goal of FollowJointTrajectory, ``names`` in the arm's order, with only the points
    that the controller's interpolation needs: while a bridge reads a large message it sends no
    samples. Of the trajectory after a time ``since`` [s], if any, from the joints ``here`` on."""
    if trajectory.joints is None:
        raise InputError("The motion has no joint angles.", "ROS follows joint angles.", "")
    times, joints = trajectory.times, trajectory.joints
    if since > 0.0:
        left = times > since
        times = np.r_[0.0, times[left] - since + _SOFTLY_SECONDS]
        joints = np.vstack([joints[0] if here is None else here, joints[left]])
    speeds = np.gradient(joints, times, axis=0)
    stands = (np.diff(joints, axis=0) == 0.0).all(axis=1)
    speeds[np.r_[True, stands] | np.r_[stands, True]] = 0.0
    points = []
    for row in _knots(times, joints, speeds):
        nanoseconds = round(1e9 * float(times[row]))
        points.append({"positions": np.round(joints[row], 7).tolist(),
                       "velocities": np.round(speeds[row], 6).tolist(),
                       "time_from_start": {"sec": nanoseconds // 10**9,
                                           "nanosec": nanoseconds % 10**9}})
    return {"trajectory": {"joint_names": names, "points": points}}


def spline(time: float | np.ndarray, times: np.ndarray, joints: np.ndarray, speeds: np.ndarray,
           ) -> np.ndarray:
    """Return the joint angles at times [s] between two points, shape [..., joints], by the cubic
    spline of ROS' joint_trajectory_controller (ros2_controllers, "Trajectory Representation");
    their times, joints and speeds have shapes [2], [2, joints], [2, joints]."""
    length = times[1] - times[0]
    part = (np.asarray(time, float)[..., None] - times[0]) / length
    rest = 1.0 - part
    return (rest**2 * ((1.0 + 2.0 * part) * joints[0] + part * length * speeds[0])
            + part**2 * ((1.0 + 2.0 * rest) * joints[1] - rest * length * speeds[1]))


def _knots(times: np.ndarray, joints: np.ndarray, speeds: np.ndarray) -> list[int]:
    """Return rows of a trajectory such that splines between them stay on it."""
    def fits(first: int, end: int) -> bool:
        ends, rows = [first, end], slice(first, end + 1)
        passed = spline(times[rows], times[ends], joints[ends], speeds[ends])
        return bool(np.abs(passed - joints[rows]).max() <= _SPLINE_RAD)

    last, rows = len(times) - 1, [0]
    while (first := rows[-1]) < last:
        # Twice as far each time, then by halving; neighbours always fit.
        good, bad = first + 1, last + 1
        while good < last and fits(first, further := min(2 * good - first, last)):
            good = further
        if good < last:
            bad = min(2 * good - first, last)
        while bad - good > 1:
            middle = (good + bad) // 2
            good, bad = (middle, bad) if fits(first, middle) else (good, middle)
        rows.append(good)
    return rows


_CLOUD_SECONDS = 10.0  # a cloud is megabytes of text
_CLOUD_LISTEN_SECONDS = 0.5
_STANDS_RAD_S = 1e-3


class CloudTopic:
    """A camera's clouds in its optical frame; where it looks from follows from the cell's [camera]
    and, on the flange, the arm's ``joint_states``. InputError if the cell has no camera."""

    def __init__(self, cell: Cell, bridge: Bridge, topic: str):
        if cell.camera is None:
            raise InputError("The cell file has no [camera].", "The cloud would be in an unknown "
                             "frame.", "Add [camera] with pose and mount.")
        self._cell, self._bridge, self._topic = cell, bridge, topic
        topics = Topics.of_cell(cell)
        self._joint_states = joint_states = topics.joint_states
        self._states = JointStates(cell, topics.prefix)
        self._flange: np.ndarray | None = None
        self._moves = False
        bridge.subscribe(topic, CLOUD)
        if cell.camera.mount == "flange":
            bridge.subscribe(joint_states, JOINT_STATE)

    def next_cloud(self) -> np.ndarray:
        """Return the points of the next cloud [m], branch frame, shape [n, 3]. WorkError if none
        arrives; InputError if it is no cloud."""
        end = time.monotonic() + _CLOUD_SECONDS
        while time.monotonic() < end:
            message = self._bridge.receive(_CLOUD_LISTEN_SECONDS)
            if message is None or message.get("op") != "publish":
                continue
            if message.get("topic") == self._joint_states:
                self._follow(message["msg"])
            elif message.get("topic") == self._topic and self._is_placed:
                return self._in_branch(cloud_of(message["msg"]))
        raise WorkError(f"No cloud came on {self._topic} within {_CLOUD_SECONDS:.0f} s"
                        f"{' while the arm stood' if self._moves else ''}.", "",
                        "Check the topic's name with `ros2 topic list`, and that the arm stands.")

    @property
    def _is_placed(self) -> bool:
        """Whether it is known where the camera is: a moving arm leaves that open."""
        assert self._cell.camera is not None
        return self._cell.camera.mount == "branch" or (self._flange is not None and not self._moves)

    def _follow(self, message: dict) -> None:
        sample = self._states.sample(message, time.monotonic())
        if sample is None:
            return
        self._moves = not float(np.abs(sample.joint_speeds).max()) < _STANDS_RAD_S
        self._flange = self._cell.arm.forward(sample.joints)

    def _in_branch(self, points: np.ndarray) -> np.ndarray:
        camera = self._cell.camera
        assert camera is not None
        frame = matrices(np.array(camera.pose))
        if camera.mount == "flange":
            assert self._flange is not None
            frame = matrices(np.array(self._cell.base.pose)) @ self._flange @ frame
        near, far = camera.range_m
        seen = points[(points[:, 2] >= near) & (points[:, 2] <= far)]
        return seen @ frame[:3, :3].T + frame[:3, 3]
