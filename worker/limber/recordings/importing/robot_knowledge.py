"""How well a robot's pose and force are known, where its recording does not tell it."""

from dataclasses import replace

import numpy as np

from limber.recordings.cell_errors import CalibrationEntry
from limber.recordings.importing.import_request import ImportRequest
from limber.recordings.recording import Pull


def of_known_robot(pull: Pull, request: ImportRequest) -> Pull:
    """Return the pull with what its robot's cell leaves open.

    A pull that tells it stays as it is; without a cell it is said what is taken.
    """
    settings, robot = request.settings, request.robot
    if pull.entry.calibration is not None:
        return pull
    if robot is None:
        taken = CalibrationEntry()
        return pull.warned(
            f"{pull.name}: nothing says how well gripper and force sensor are known. Taken: the "
            f"gripper's frame within {1e3 * taken.pose_sigma_m:g} mm and "
            f"{np.degrees(taken.pose_sigma_rad):.1g} degrees, the force within "
            f"{100 * taken.force_gain_sigma:g} %, its zero within {taken.force_bias_sigma_n:g} N "
            f"and its drift within {taken.force_drift_sigma_n:g} N, all standard deviations; the "
            "interval of an estimate is as wide. Give --cell with the robot's cell file.")
    sensor = pull.entry.sensor.model_copy(update={
        "force_range_n": robot.noise.force_range_n,
        **({} if "force_sigma" in request.given else {
            "force_sigma_n": robot.noise.force_sigma_n}),
        **({} if settings.torque_sigma is not None or pull.entry.sensor.torque_sigma_nm is None
           else {"torque_sigma_nm": robot.noise.torque_sigma_nm})})
    return replace(pull, entry=pull.entry.model_copy(update={
        "sensor": sensor, "calibration": robot.errors(float(pull.times[-1] - pull.times[0]))}))
