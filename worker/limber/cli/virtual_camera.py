"""A client of the virtual robot's depth camera: images from any pose, and a scan of them."""

import socket
import zlib

import numpy as np

from limber.core.errors import Command, InputError, Option, WorkError
from limber.core.json_values import json_object
from limber.geometry.cloud.camera import D455, Camera, depth_to_cloud
from limber.robot.virtual.server import CAMERA_PORT

_SECONDS = 30.0
_LARGEST_STEP_M = 0.01
"""Largest depth step between neighbouring pixels of one surface; more is a silhouette with flying
pixels."""


class VirtualCamera:
    """A depth camera at any pose; a context manager. WorkError if the port does not answer."""

    def __init__(self, address: str):
        try:
            self._socket = socket.create_connection((address, CAMERA_PORT), _SECONDS)
        except OSError as error:
            raise WorkError(f"No camera answers at {address} port {CAMERA_PORT} ({error}).", "Only "
                            "the virtual robot with a branch has one.", "Start ",
                            Command("virtual-robot"), " with the branch's folder.") from error
        self._stream = self._socket.makefile("rb")

    def __enter__(self) -> "VirtualCamera":
        return self

    def __exit__(self, *_exception: object) -> None:
        self._stream.close()
        self._socket.close()

    def depth(self, camera: Camera) -> np.ndarray:
        """Return a camera's depth image [m], 0 where nothing is seen, shape [height, width];
        WorkError if the virtual robot has ended."""
        try:
            self._socket.sendall(camera.model_dump_json().encode() + b"\n")
            header = json_object(self._stream.readline()) or {}
            packed = self._stream.read(header.get("bytes", 0))
        except (OSError, ValueError) as error:
            raise WorkError(f"The connection to the virtual camera was lost ({error}).") from error
        if "error" in header or not packed:
            raise WorkError("The virtual camera returned no image: "
                            f"{header.get('error', 'it has ended')}.")
        steps = np.frombuffer(zlib.decompress(packed), "<u2")
        return steps.reshape(camera.height, camera.width) / camera.depth_scale


def views_around(middle: np.ndarray, distance: float, count: int,
                 camera: Camera = D455) -> list[Camera]:
    """Return cameras around a position [3], ``distance`` [m] away, alternately high and low."""
    if count < 1 or not distance > 0:
        raise InputError(f"{count} views from a distance of {distance:g} m were "
                         "requested.", "A scan needs at least one view "
                         "from outside the branch.", "Use 8 views from 0.6 m, for example.")
    found = []
    for number in range(count):
        turn, tilt = 2 * np.pi * number / count, 0.35 * (-1) ** number
        direction = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt),
                              np.sin(tilt)])
        found.append(camera.looking(eye=middle + distance * direction, target=middle))
    return found


def scanned(address: str, cameras: list[Camera]) -> np.ndarray:
    """Return the points [m, 3] that cameras see together, without silhouettes; WorkError without
    cameras, or if none sees anything."""
    parts = []
    with VirtualCamera(address) as eye:
        for camera in cameras:
            depth = eye.depth(camera)
            parts.append(depth_to_cloud(camera, depth, _inner(depth)).points)
    points = np.concatenate(parts)
    if not len(points):
        raise WorkError(f"The {len(cameras)} views are empty.", "The cameras do not see the "
                                                               "branch.",
                        "Give another ", Option("middle"), " or ", Option("distance"), ".")
    return points


def _inner(depth: np.ndarray) -> np.ndarray:
    """Pixels whose four neighbours lie on the same surface, shape [height, width]."""
    kept = depth > 0
    for axis in (0, 1):
        for shift in (1, -1):
            beside = np.roll(depth, shift, axis)
            kept &= (beside > 0) & (np.abs(beside - depth) < _LARGEST_STEP_M)
    kept[[0, -1]] = kept[:, [0, -1]] = False
    return kept
