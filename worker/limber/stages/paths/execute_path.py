"""The path that a plan is executed along: its poses, and the branch's forces solved again there."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from limber.cell.cell_file import Cell
from limber.core.errors import Command, InputError, Option, Text, WorkError
from limber.core.files.tables import csv_records, read_columns
from limber.core.not_none import present
from limber.core.numerics.rigid import composed, matrices, pose_vectors
from limber.core.progress import Progress
from limber.mechanics import BranchModel, Grasp, StaticResult, follow_poses
from limber.mechanics.sensitivities import grasp_slopes, static_sensitivities
from limber.planning.constraints.chance import YoungUncertainty
from limber.planning.cost import arc_lengths
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.recordings.recording import POSE_COLUMNS
from limber.robot.driver.force_samples import INDEPENDENT_READINGS
from limber.robot.driver.force_test import BLOCK_SECONDS, ForceErrors, noticed
from limber.robot.motion.execution import Blocked, RobotMotion
from limber.robot.motion.trajectory import Predicted, Trajectory
from limber.stages.paths.execute_summary import execution_summary
from limber.stages.paths.plan_cell import KeptClear, legs_in_cell
from limber.stages.pulls.record_nudge import Nudge, checked_nudge
from limber.stages.pulls.record_path import GRASP_RADIUS_M
from limber.stages.pulls.record_prediction import PullModel
from limber.store import Branch
from limber.store.loading import stiffness_deviation

if TYPE_CHECKING:
    from limber.stages.paths.execute import ExecutePlan

_SPACING = 0.0025  # m between poses that are solved: a chord of it on a bend of 0.3 m stretches
# a branch by 3 micrometres
_MOST_POSES = 120
_BEFORE_PATH_SECONDS = 10.0  # from the tare to the path's start


@dataclass(frozen=True)
class PlannedMotion:
    """What :class:`.ExecutePlan` follows: ``asked`` with the plan's own values where none were
    given, ``stated`` by its file; the branch's ``model``, what is ``known`` of its moduli, and the
    wrenches ``predicted`` with it; ``motion`` and the ``wish`` it was made by; the nudge before the
    path, None where the arm can make none; ``result`` as of :meth:`.ExecutePlan.run`; of a path
    planned anew ``begun``, its rest from where the branch is held."""

    branch: Branch
    cell: Cell
    asked: "ExecutePlan"
    stated: dict[str, Any]
    model: GraspModel
    known: YoungUncertainty | None
    predicted: Predicted
    wish: dict[str, Any]
    motion: RobotMotion
    across: Nudge | None
    result: dict[str, Any]
    begun: Trajectory | None = None


def planned_poses(branch: Branch, name: str, rest: np.ndarray) -> np.ndarray:
    """Return the planned approach, else a straight one, and path of the grasp from rest [m, rad],
    shape [n, 6], with the branch's rotations; NaN if the table has none."""
    whole = branch.has(f"plans/{name}-motion.csv")
    path = branch.require(f"plans/{name}-motion.csv" if whole else f"plans/{name}.csv", "plan")
    table = read_columns(path, ("x_m", "y_m", "z_m"), "the table of a path")
    nothing = np.full(len(table["x_m"]), np.nan)
    planned = np.column_stack([table.get(column, nothing) for column in POSE_COLUMNS])
    if whole:
        rows = csv_records(path, "the table of a motion")
        planned = planned[[row.get("phase") != "return" for row in rows]]
    if len(planned) < 2:
        raise InputError(f"{path} has {len(planned)} points.", "This is not a path.", "Plan again.")
    # At rest the grasped piece is at its own position and not rotated.
    start = np.r_[rest, np.zeros(3)]
    distance = float(np.linalg.norm(planned[0, :3] - rest))
    leading = start + np.linspace(0, 1, max(int(np.ceil(distance / 0.01)), 1) + 1)[:-1, None] * (
        planned[0] - start)
    return np.vstack([leading, planned]) if distance > 1e-4 else planned


def offsets_along(turning: dict[str, Any] | None, positions: np.ndarray) -> np.ndarray:
    """Return a plan's rotations beyond the branch's own at ``positions`` [n, 3] [rad], [n, 3]."""
    if turning is None:
        return np.zeros_like(positions)
    known, along = np.array(turning["along_m"]), arc_lengths(positions)
    share = along / max(float(along[-1]), 1e-12) * known[-1]
    return np.column_stack([np.interp(share, known, column)
                            for column in np.array(turning["offsets_rad"]).T])


def predicted_along(model: GraspModel, known: YoungUncertainty | None, positions: np.ndarray,
                    turning: dict[str, Any] | None, clear: KeptClear, progress: Progress,
                    ) -> Predicted:
    """Return the model's prediction from rest to the path's end: the grasp passes the plan's
    ``positions`` [n, 3], rotated as the branch would and by the plan's offset (``turning``), in
    steps so small that straight lines stretch nothing, and the wrench is that of the branch so
    clamped. NoPathError if it comes nearer to an obstacle than ``clear`` allows; WorkError if a
    pose has no reliable solution. ``known``: of the moduli, if anything is."""
    positions = _closely(positions)
    offsets = offsets_along(turning, positions)
    clamped = Grasp.gripping(model.mesh, model.grasp.centre, GRASP_RADIUS_M)
    firm = model.model.gripped(clamped)
    poses, wrenches, stiffness, covariances = [], [], [], []
    state = held = model.rest.displacement
    for number, position in enumerate(positions):
        free = model.follow(position[None], state)[0]
        reason = refusal(free)
        if reason is None:
            state = free.displacement
            pose = np.r_[position, model.pose(state)[3:]]
            if offsets[number].any():
                pose[3:] = composed(offsets[number], pose[3:])
            result = follow_poses(firm, clamped, pose[None], start=held)[0]
            reason = refusal(result)
        if reason is not None:
            raise WorkError(f"Pose {number + 1} of {len(positions)} has no reliable solution "
                            f"({reason}).", "Its force is unknown, so the robot does not go "
                                            "there.",
                            "Plan a gentler path.")
        held = result.displacement
        clear.require(pose[:3], model.mesh, held)
        poses.append(pose)
        wrenches.append(np.r_[result.reaction_force, result.reaction_torque])
        stiffness.append(grasp_slopes(firm, clamped, held).wrench)
        covariances.append(np.zeros((3, 3)) if known is None
                           else _by_young(firm, clamped, result, known))
        progress(0.05 + 0.35 * number / len(positions), "forces along the path")
    return Predicted(np.array(poses), np.array(wrenches), np.array(stiffness),
                     np.array(covariances))


def path_nudge(branch: Branch, model: GraspModel, cell: Cell, motion: RobotMotion,
               blocked: Blocked, progress: Progress) -> Nudge | None:
    """Return the nudge of the held branch before its path; None where the arm can make none.
    ConvergenceError if its force cannot be predicted."""
    path = motion.path
    assert path.joints is not None
    base = matrices(np.array(cell.base.pose))
    held = PullModel(model.model, stiffness_deviation(branch), cell, model.rest_position)
    return checked_nudge(cell, held, pose_vectors(base @ matrices(path.poses[0])), path.joints[0],
                         path, blocked, progress)


def require_within_limits(cell: Cell, poses: np.ndarray, forces: np.ndarray) -> None:
    """Refuse a path at ``poses`` [n, 6] with ``forces`` [n, 3] that the guard would stop:
    InputError with the limit and the value, or the position outside the workspace."""
    peak = float(np.linalg.norm(forces, axis=1).max())
    if peak >= cell.limits.soft_force_n:
        raise InputError(f"The path needs {peak:.3g} N, the soft limit is "
                         f"{cell.limits.soft_force_n:.3g} N.", "The guard would pause the motion.",
                         "Plan with a lower ", Option("max_force"), ", or raise "
                         "limits.soft_force_n in the cell file.")
    box = cell.workspace
    if box is not None:
        outside = np.any((poses[:, :3] < box.low_m) | (poses[:, :3] > box.high_m), axis=1)
        if outside.any():
            position = ", ".join(f"{x:.3f}" for x in poses[int(outside.argmax()), :3])
            raise InputError(f"The path leaves the workspace at ({position}) m.",
                             "The guard would stop there.", "Plan inside it, or correct the cell "
                                                            "file.")


def require_watched(cell: Cell, path: Trajectory, is_unwatched: bool, warn: Callable[[Text], None],
                    noise: float | None = None) -> list[dict[str, Any]]:
    """Return what the guard would notice on a path. Refuse one with forces so small that it would
    not see an empty gripper, or only tell it if ``is_unwatched``; ``noise`` of a block at rest per
    axis [N], if measured. InputError with the peak force and what explains as much."""
    assert path.expected is not None
    errors = ForceErrors.of_cell(cell, noise)
    found = noticed(path, errors, matrices(np.array(cell.base.pose))[:3, :3])
    if found[0]["after_m"] is not None:
        return found
    told = (f"The guard could not see an {found[0]['fault']}: the force along the path is at most "
            f"{np.linalg.norm(path.expected.wrenches[:, :3], axis=1).max():.2g} N. The noise of "
            f"the sensor ({'measured' if noise else 'stated'}: {errors.noise:.2g} N in "
            f"{BLOCK_SECONDS:g} s), its drift and the prediction's own error explain as much")
    if is_unwatched:
        warn(Text(f"{told}. ", Command("execute"), " follows it only with ",
                  Option("unwatched", True), "."))
        return found
    raise InputError(
        f"{told}.", "The arm would go on with nothing in the gripper, or with a broken branch.",
        "Plan a path that bends the branch further or hold it nearer to its root; state the sensor "
        "as it is (sensor.force_sigma_n, sensor.drift_n_per_minute); or give ",
        Option("unwatched", True), ", and watch the branch yourself.")


def force_sigma(cell: Cell, samples: np.ndarray) -> float:
    """Return the deviation of the smoothed force by noise and by drift since the tare [N], of
    samples of the path as :data:`limber.robot.driver.link.COLUMNS`."""
    minutes = (samples[-1, 0] - samples[0, 0] + _BEFORE_PATH_SECONDS) / 60.0
    return float(np.hypot(cell.sensor.force_sigma_n / np.sqrt(INDEPENDENT_READINGS),
                          cell.sensor.drift_n_per_minute * minutes))


def _by_young(model: BranchModel, grasp: Grasp, result: StaticResult, uncertainty: YoungUncertainty,
              ) -> np.ndarray:
    """Covariance of the force due to the uncertainty of Young's modulus [N^2], shape [3, 3]."""
    slopes = static_sensitivities(model, result, grasp, None, shares=uncertainty.shares.T)
    scaled = slopes.reaction_force * uncertainty.deviations
    return scaled @ uncertainty.correlation @ scaled.T


def _closely(positions: np.ndarray) -> np.ndarray:
    """Return positions [n, 3] with more in between, on a smooth curve with little overshoot."""
    kept = np.r_[True, np.linalg.norm(np.diff(positions, axis=0), axis=1) > 1e-9]
    positions = positions[kept]
    places = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    spacing = max(_SPACING, places[-1] / _MOST_POSES)
    stations = np.concatenate([
        np.linspace(a, b, max(int(np.ceil((b - a) / spacing)), 1) + 1)[:-1]
        for a, b in pairwise(places)] + [places[-1:]])
    return Akima1DInterpolator(places, positions, method="makima")(stations)


def checked_motion(cell: Cell, asked: "ExecutePlan", predicted: Predicted, motion: RobotMotion,
                   across: Nudge | None, clear: KeptClear, progress: Progress, first: int = 0,
                   ) -> dict[str, Any]:
    """Return what is known of a motion for the result. InputError if the predicted poses from the
    ``first`` on break a limit of the cell, or the guard could not watch the path."""
    result = execution_summary(cell, motion, across) | clear.describe() | {"legs": legs_in_cell(
        cell, clear.obstacles, motion, predicted.poses[:, :3], np.array(clear.surfaces),
        present(asked.hold, "time at the path's end"), progress)}
    require_within_limits(cell, predicted.poses[first:], predicted.wrenches[first:, :3])
    return result | {"noticed": require_watched(cell, motion.path, asked.unwatched, progress.warn)}
