"""Calibration errors of a cell: standard deviations of errors constant over a recording.

Noise averages out over frames; an error of a millimetre in the gripper's frame does not. A fit
treats these errors as unknowns, with the deviations given here as their prior.
"""

from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from limber.recordings.recording import PullEntry


class CalibrationEntry(BaseModel):
    """Standard deviations, under ``[calibration]`` of ``pull.toml``; 0: known exactly.

    The defaults are those of a carefully set up cell without later measurement: a hand-eye
    calibration accurate to a millimetre and a degree, a force sensor within 2 % whose zero drifts
    by a newton (makers' sheets allow more; see the note on field errors), a camera accurate to a
    millimetre.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    pose_sigma_m: float = Field(
        1e-3, ge=0,
        description="Position of the gripper's frame in the branch's frame, each axis.")
    pose_sigma_rad: float = Field(
        0.0175, ge=0,
        description="Rotation of the gripper's frame in the branch's frame, each axis.")
    pose_noise_m: float = Field(
        1e-4, gt=0, description="Error of a single pose: the robot's repeatability.")
    force_gain_sigma: float = Field(0.02, ge=0, description="Relative error of the force.")
    force_bias_sigma_n: float = Field(
        1.0, ge=0, description="Zero offset of the force, each axis.")
    force_drift_sigma_n: float = Field(
        1.0, ge=0, description="Drift of the force's zero over the recording, each axis.")
    torque_bias_sigma_nm: float = Field(
        0.05, ge=0, description="Zero offset of the torque, each axis.")
    camera_sigma_m: float = Field(
        1e-3, ge=0,
        description="Position of the observer's frame in the branch's frame, each axis.")
    camera_sigma_rad: float = Field(
        1e-3, ge=0, description="Rotation of the observer's frame about the branch, each axis.")
    point_sigma_m: float = Field(
        5e-3, ge=0, description="Position of each observed point along the branch, relative to "
        "its place on the scanned one, and across it unless rest_points_m states it. Scanned tips "
        "were up to 16 mm short.")
    clock_sigma_s: float = Field(
        2e-3, ge=0,
        description="Offset of the observer's clock from the robot's that remains after alignment.")
    slip_sigma_m: float = Field(
        5e-4, ge=0, description="Slip of the grasp along the branch from beginning to end.")
    held_length_sigma_m: float = Field(
        1e-3, ge=0, description="Half the length of the piece that a clamping gripper holds.")
    repeat_sigma: float = Field(
        0.02, ge=0, description="Relative variation of the stiffness of one branch between "
        "recordings: creep, temperature, how it is held.")


EXACT = CalibrationEntry(
    pose_sigma_m=0.0, pose_sigma_rad=0.0, force_gain_sigma=0.0, force_bias_sigma_n=0.0,
    force_drift_sigma_n=0.0, torque_bias_sigma_nm=0.0, camera_sigma_m=0.0, camera_sigma_rad=0.0,
    point_sigma_m=0.0, clock_sigma_s=0.0, slip_sigma_m=0.0, held_length_sigma_m=0.0,
    repeat_sigma=0.0)
"""Calibration of a simulated cell without errors."""
WITHOUT_GRIPPER = CalibrationEntry(
    pose_sigma_m=0.0, pose_sigma_rad=0.0, force_gain_sigma=0.0, force_bias_sigma_n=0.0,
    force_drift_sigma_n=0.0, torque_bias_sigma_nm=0.0, camera_sigma_m=0.0, camera_sigma_rad=1e-3,
    point_sigma_m=0.0, clock_sigma_s=0.0, slip_sigma_m=0.0, held_length_sigma_m=0.0)
"""Calibration for a stated load and markers registered to the branch at rest. The remaining error
is the rotation of that registration.
"""


def calibration_of(entry: "PullEntry") -> CalibrationEntry:
    """Return the calibration of a pull's cell; the defaults if its recording does not state it."""
    return entry.calibration or CalibrationEntry()
