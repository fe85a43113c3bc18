"""Modes of a virtual controller, and the faults of its force sensor."""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np


class SafetyMode(IntEnum):
    """As in RTDE's ``safety_mode`` (Universal Robots, "RTDE guide", controller output data)."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


class RuntimeState(IntEnum):
    """As in RTDE's ``runtime_state``."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class RobotMode(IntEnum):
    """As in RTDE's ``robot_mode``."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


@dataclass
class SensorFault:
    """Faults of the force readings, for tests.

    Attributes:
        added: Wrench added to the sensor's report, flange frame [N, N m].
        frozen: Repeats the last reading.
        nan: Reports no numbers.
        joints_nan: Reports no numbers as joint angles.
    """

    added: np.ndarray = field(default_factory=lambda: np.zeros(6))
    frozen: bool = False
    nan: bool = False
    joints_nan: bool = False
