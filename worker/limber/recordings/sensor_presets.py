"""Sensor presets: how the files of a scanner or camera are read, and the noise of a force sensor.

Axes of most cameras: x right, y down, z forward, so that up is -y. Some files have y up. The camera
is the origin of both.
"""

from dataclasses import dataclass, field
from typing import Any

_Y_DOWN = {"up": [0.0, -1.0, 0.0], "camera_at": [0.0, 0.0, 0.0]}
_Y_UP = {"up": [0.0, 1.0, 0.0], "camera_at": [0.0, 0.0, 0.0]}


@dataclass(frozen=True)
class SensorPreset:
    """A sensor, the settings of a stage that it decides, and their source.

    Attributes:
        title: Its name.
        stage: The stage that reads its data.
        source: Where the values are from.
        settings: Values by the names of the stage's settings.
    """

    title: str
    stage: str
    source: str
    settings: dict[str, Any] = field(default_factory=dict)


def _data_sheet(force: float, torque: float) -> dict[str, float]:
    """Return the noise of a sensor whose data sheet states a precision [N], [N m]: taken as two
    standard deviations.
    """
    return {"force_sigma": force / 2, "torque_sigma": torque / 2}


SENSORS = {
    "laser_scanner": SensorPreset(
        "Laser scanner on a level tripod", "reconstruct",
        "ASTM E2807 (E57): metres. The scanner's level makes z vertical",
        {"unit": "m", "up": [0.0, 0.0, 1.0]}),
    "depth_camera": SensorPreset(
        "Depth camera, ROS optical frame", "reconstruct",
        "REP 103: metres; x right, y down, z forward", {"unit": "m", **_Y_DOWN}),
    "realsense_ply": SensorPreset(
        "RealSense, PLY of its Viewer", "reconstruct",
        "librealsense, issues 3589 and 5833, from 2.19: metres; x right, y up, z backward",
        {"unit": "m", **_Y_UP}),
    "azure_kinect": SensorPreset(
        "Azure Kinect", "reconstruct",
        "Azure Kinect DK, Coordinate systems: millimetres; x right, y down, z forward",
        {"unit": "mm", **_Y_DOWN}),
    "kinect_v2": SensorPreset(
        "Kinect for Windows, version 2", "reconstruct",
        "Kinect for Windows SDK 2.0, CameraSpacePoint: metres; x left, y up, z forward",
        {"unit": "m", **_Y_UP}),
    "zivid": SensorPreset(
        "Zivid", "reconstruct",
        "Zivid, Camera Coordinate System: millimetres; x right, y down, z outward",
        {"unit": "mm", **_Y_DOWN}),
    "ur5e": SensorPreset(
        "UR5e, own sensor", "import-pull",
        "UR5e data sheet: precision 3.5 N and 0.2 Nm, taken as two standard deviations",
        _data_sheet(3.5, 0.2)),
    "ur10e": SensorPreset(
        "UR10e, own sensor", "import-pull",
        "UR10e data sheet: precision 5 N and 0.2 Nm, taken as two standard deviations",
        _data_sheet(5.0, 0.2)),
    "ur5": SensorPreset(
        "UR5 (CB3), from motor currents", "import-pull",
        "Standard deviation of ten weighings, Universal Robots forum, topic 229",
        {"force_sigma": 3.6}),
    "ft300": SensorPreset(
        "Robotiq FT300", "import-pull",
        "Standard deviation of ten weighings on a UR5, Universal Robots forum, topic 229",
        {"force_sigma": 0.6}),
}
