"""Clouds of a depth camera in ROS, as points in the branch's frame."""

import time

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, WorkError
from limber.core.numerics.rigid import matrices
from limber.robot.ros.bridge import Bridge
from limber.robot.ros.messages import CLOUD, JOINT_STATE, JointStates, cloud_of

_CLOUD_SECONDS = 10.0  # a cloud is megabytes of text
_LISTEN_SECONDS = 0.5
_STANDS_RAD_S = 1e-3


class CloudTopic:
    """A camera's clouds; where it looks from follows from the cell and the arm's joints.

    Args:
        cell: Its [camera] states where the camera is mounted.
        bridge: Connection to rosbridge.
        topic: The cloud's topic, in the camera's optical frame.
        joint_states: That of the arm, for a camera on the flange.

    Raises:
        InputError: the cell has no camera.
    """

    def __init__(self, cell: Cell, bridge: Bridge, topic: str, joint_states: str):
        if cell.camera is None:
            raise InputError("The cell file has no [camera].", "The cloud would be in an unknown "
                             "frame.", "Add [camera] with pose and mount.")
        self._cell, self._bridge, self._topic = cell, bridge, topic
        self._joint_states = joint_states
        self._states = JointStates(cell)
        self._flange: np.ndarray | None = None
        self._moves = False
        bridge.subscribe(topic, CLOUD)
        if cell.camera.mount == "flange":
            bridge.subscribe(joint_states, JOINT_STATE)

    def next_cloud(self) -> np.ndarray:
        """Return the points of the next cloud [m], branch frame, shape [n, 3].

        Raises:
            WorkError: none arrives. InputError: it is no cloud.
        """
        end = time.monotonic() + _CLOUD_SECONDS
        while time.monotonic() < end:
            message = self._bridge.receive(_LISTEN_SECONDS)
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
        return self._cell.camera.mount == "branch" or (
            self._flange is not None and not self._moves)

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
