"""The shape of an arm: its links as rods with round ends, for what stands in the way."""

from dataclasses import dataclass

import numpy as np

from limber.robot.ur.arms import Arm
from limber.robot.ur.kinematics import link_frames

_UPPER_TUBE, _FORE_TUBE = 0.9, 0.75
"""Radius of the two long tubes in that of the housing at their thicker end."""


@dataclass(frozen=True)
class Rods:
    """The moving links of an arm in some poses, in its base's frame.

    Attributes:
        names: Of the links, one a rod.
        starts, ends: Of the rods' axes [m], shape [n, rods, 3].
        radii: [m], shape [rods].
    """

    names: tuple[str, ...]
    starts: np.ndarray
    ends: np.ndarray
    radii: np.ndarray


def rods_of(arm: Arm, joints: np.ndarray) -> Rods:
    """Return the links of an arm at joint angles [rad], shape [n, 6].

    The tubes lie beside the lines of the Denavit-Hartenberg table, by the offsets of shoulder and
    elbow. The base's foot is left out: it stands where it is mounted, and touches that.
    """
    frames = link_frames(arm, joints)
    places, axis = frames[:, :, :3, 3], frames[:, 0, :3, 2]
    at_shoulder, at_forearm = arm.lateral
    shoulder = places[:, 0] + at_shoulder * axis
    elbow = places[:, 1] + at_shoulder * axis
    inner = places[:, 1] + at_forearm * axis
    wrist = places[:, 2] + at_forearm * axis
    thick, middle, thin = arm.housing
    # The last rod's round end stops at the flange.
    last = places[:, 5] - min(thin, arm.d[5]) * frames[:, 5, :3, 2]
    links = (
        ("shoulder", places[:, 0], shoulder, thick),
        ("upper arm", shoulder, elbow, _UPPER_TUBE * thick),
        ("elbow", elbow, inner, middle),
        ("forearm", inner, wrist, _FORE_TUBE * middle),
        ("wrist 1", wrist, places[:, 3], thin),
        ("wrist 2", places[:, 3], places[:, 4], thin),
        ("wrist 3", places[:, 4], last, thin))
    names, starts, ends, radii = zip(*links, strict=True)
    return Rods(names, np.stack(starts, axis=1), np.stack(ends, axis=1), np.array(radii))
