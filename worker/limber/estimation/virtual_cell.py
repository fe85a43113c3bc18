"""Simulated errors of a cell: drawn once, then applied to its recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from limber.core.numerics.rigid import composed, rotated
from limber.geometry.skeleton.control_points import control_points
from limber.geometry.skeleton.skeleton import Skeleton
from limber.recordings.cell_errors import CalibrationEntry
from limber.recordings.recording import Pull


@dataclass(frozen=True)
class CellErrors:
    """Errors of one cell; they stay the same in all its recordings.

    Attributes:
        calibration: Their standard deviations.
        gripper_offset, gripper_turn: Errors of the gripper's frame [m, rad], shape [3] each.
        force_gain: Factor of the force.
        camera_offset, camera_turn: Errors of the observer's frame [m, rad], shape [3] each.
    """

    calibration: CalibrationEntry
    gripper_offset: np.ndarray
    gripper_turn: np.ndarray
    force_gain: float
    camera_offset: np.ndarray
    camera_turn: np.ndarray

    @classmethod
    def drawn(cls, calibration: CalibrationEntry, rng: np.random.Generator) -> "CellErrors":
        """Draw the errors that remain after a calibration."""
        return cls(calibration, calibration.pose_sigma_m * rng.standard_normal(3),
                   calibration.pose_sigma_rad * rng.standard_normal(3),
                   1 + calibration.force_gain_sigma * rng.standard_normal(),
                   calibration.camera_sigma_m * rng.standard_normal(3),
                   calibration.camera_sigma_rad * rng.standard_normal(3))

    @property
    def truth(self) -> dict[str, Any]:
        """The drawn errors, for ``truth`` in ``pull.toml``."""
        return {"gripper_place_m": self.gripper_offset.tolist(),
                "gripper_turn_rad": self.gripper_turn.tolist(), "force_gain": self.force_gain,
                "camera_place_m": self.camera_offset.tolist(),
                "camera_turn_rad": self.camera_turn.tolist()}

    def recorded(self, pull: Pull, rng: np.random.Generator) -> Pull:
        """Return an exact pull as the cell records it, with zero and drift of this recording.

        Noise of the sensors is not included. The gripper's frame is rotated about the grasp, the
        observer's about the centre of the points.
        """
        known, times = self.calibration, pull.times
        wrenches = pull.wrenches.copy()
        wrenches[:, :3] = self.force_gain * wrenches[:, :3] + self._zero(times, rng)
        wrenches[:, 3:] += known.torque_bias_sigma_nm * rng.standard_normal(3)
        point = np.array(pull.entry.grasp.point_m)
        poses = pull.poses.copy()
        moved = rotated(self.gripper_turn, poses[:, :3] - point)
        poses[:, :3] = (point + self.gripper_offset + moved
                        + known.pose_noise_m * rng.standard_normal((len(times), 3)))
        poses[:, 3:] = composed(self.gripper_turn, poses[:, 3:])
        late = known.clock_sigma_s * rng.standard_normal()
        observations = pull.observations
        if observations is not None:
            observations = replace(observations, positions=self._seen(
                times, observations.positions, late))
        return replace(pull, entry=pull.entry.model_copy(update={"calibration": known}),
                       poses=poses, wrenches=wrenches, observations=observations)

    def _zero(self, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Zero of the force over a recording [N], shape [n, 3]; it drifts as a sensor warms up."""
        share = (times - times[0]) / (times[-1] - times[0])
        slowing = rng.uniform(0.3, 3.0)
        course = (1 - np.exp(-share / slowing)) / (1 - np.exp(-1 / slowing))
        return (self.calibration.force_bias_sigma_n * rng.standard_normal(3)
                + self.calibration.force_drift_sigma_n * rng.standard_normal(3) * course[:, None])

    def _seen(self, times: np.ndarray, positions: np.ndarray, late: float) -> np.ndarray:
        middle = positions.mean(axis=(0, 1))
        spline = scipy.interpolate.CubicSpline(times, positions)
        at = spline(np.clip(times + late, times[0], times[-1]))
        turned = rotated(self.camera_turn, (at - middle).reshape(-1, 3)).reshape(at.shape)
        return middle + turned + self.camera_offset


def marked_points(skeleton: Skeleton, fractions: Sequence[float],
                  shifts: np.ndarray | float) -> np.ndarray:
    """Return where points really are that were meant to be on the control points [m], shape [K, 3].

    Args:
        skeleton: The true axes.
        fractions: Positions of the control points on the main path.
        shifts: Distances along the branch from there [m], shape [K], or of all.
    """
    length = skeleton.arc_length[skeleton.main_path()[-1]]
    return control_points(skeleton, tuple(np.clip(
        np.array(fractions) + shifts / length, 0.01, 0.99).tolist()))
