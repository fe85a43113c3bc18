"""The base's calibration, by touched points and by pictures of a board: error and interval."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.stats import chi2

from benchmarks.table import Asked, Row, Setting
from benchmarks.trials import column
from limber.cell.cell_file import CameraEntry, Cell
from limber.cell.ur_arms import ARMS
from limber.core.numerics.rigid import inverted, matrices, pose_vectors, rotation_vector
from limber.geometry.rigid_kernels import pose_of
from limber.robot.calibration import CameraOn, View, fit_base, fit_pictures, gripper_pose
from limber.robot.interface import Sample
from limber.robot.ur.factory_calibration import one_arm

_OFF_NOMINAL_M, _TOUCH_M, _POINTS = 0.005, 2e-4, 8
_PIXEL, _PICTURES = 0.3, 15
_LARGEST_M, _LARGEST_DEGREES = 1e-3, 0.1
_COUNT, _HOLDS, _LEVEL = 120, (0.90, 0.99), 0.95
_CAMERA = CameraEntry(pose=(0,) * 6, width=1280, height=960, focal_px=(1100.0, 1100.0),
                      centre_px=(640.0, 480.0))
_LENS = np.array([[1100.0, 0, 640], [0, 1100.0, 480], [0, 0, 1]])
_CORNERS = np.array([[0.03 * (i - 2.5), 0.03 * (j - 1.5), 0.0] for j in range(4) for i in range(6)])
_CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6},
             tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "mass_kg": 0.0})


def _asked(by: str) -> tuple[Asked, Asked]:
    return (Asked(f"calibration by {by}: base, worst", "1 mm, 0.1 degrees"),
            Asked(f"calibration by {by}: 95 % interval holds", "90 to 99 %"))


_KINDS = {"points": f"{_POINTS} points touched within {1e3 * _TOUCH_M:g} mm, arm up to 5 mm off "
          "nominal",
          "stand": f"{_PICTURES} pictures with {_PIXEL:g} px noise, camera on a stand",
          "gripper": f"{_PICTURES} pictures with {_PIXEL:g} px noise, camera on the gripper"}
CALIBRATION_ROWS = tuple(asked for by in _KINDS.values() for asked in _asked(by))


def calibrations(setting: Setting) -> list[Row]:
    """Calibrate random cells in each way."""
    works: dict[str, Callable[[int], dict[str, float]]] = {
        "points": _by_points, "stand": partial(_by_pictures, "stand"),
        "gripper": partial(_by_pictures, "gripper")}
    rows = []
    for kind, budget in setting.budget.shares(list(works)):
        found = replace(setting, budget=budget).trials(
            f"calibration {kind}", setting.seeds(_COUNT, 2), works[kind], "robot")
        error, held = _asked(_KINDS[kind])
        far, turned, inside = (column(found, name)
                               for name in ("off_m", "turned_degrees", "inside"))
        share = float(inside.mean())
        rows += [Row(*error, f"{1e3 * far.max():.2f} mm, {turned.max():.3f} degrees (95 %: "
                     f"{1e3 * np.quantile(far, 0.95):.2f}, {np.quantile(turned, 0.95):.3f})",
                     bool(far.max() <= _LARGEST_M and turned.max() <= _LARGEST_DEGREES),
                     len(found)),
                 Row(*held, f"{100 * share:.0f} %", _HOLDS[0] <= share <= _HOLDS[1]
                     if len(found) >= _COUNT else None, len(found))]
    return rows


def _by_points(seed: int) -> dict[str, float]:
    """Touch points around a branch; the controller knows its arm's own lengths."""
    rng = np.random.default_rng(seed)
    arm = one_arm(ARMS["ur5e"], _OFF_NOMINAL_M, rng)
    base = matrices(np.r_[rng.uniform(-0.6, 0.6, 3), rng.uniform(-1.0, 1.0, 3)])
    tool, nothing = matrices(np.array(_CELL.tool.grasp_pose)), np.zeros(6)
    touched = []
    for joints in np.array(arm.home) + rng.uniform(-0.35, 0.35, (_POINTS, 6)):
        sample = Sample(1.0, 1.0, joints, nothing, pose_of(arm.forward(joints) @ tool), nothing,
                        nothing, 7, 1, 2, 1.0, np.array(_CELL.tool.grasp_pose))
        touched.append(gripper_pose(_CELL, sample)[:3])
    places = np.array(touched)
    on_branch = places @ base[:3, :3].T + base[:3, 3]
    fit = fit_base(places, on_branch + _TOUCH_M * rng.standard_normal(on_branch.shape))
    frame, middle = matrices(fit.pose), np.r_[places.mean(axis=0), 1.0]
    off = ((frame - base) @ middle)[:3]
    turn = rotation_vector(frame[:3, :3] @ base[:3, :3].T)
    limit = np.sqrt(chi2.ppf(_LEVEL, 3))
    return _numbers(off, turn, np.mean([np.linalg.norm(off) <= limit * fit.position_sigma,
                                        np.linalg.norm(turn) <= limit * fit.rotation_sigma]))


def _by_pictures(camera_on: CameraOn, seed: int) -> dict[str, float]:
    """Fit camera and board to corners with noise; the interval is that of all twelve numbers."""
    rng = np.random.default_rng([seed, camera_on == "gripper"])
    fixed = np.r_[rng.uniform(-0.6, 0.6, 3), rng.uniform(-0.6, 0.6, 3)]
    carried = np.r_[rng.uniform(-0.05, 0.05, 3), rng.uniform(-0.3, 0.3, 3)]
    robot, views = [], []
    for number in range(_PICTURES):
        wanted = np.r_[rng.uniform([-0.1, -0.08, 0.45], [0.1, 0.08, 0.7]),
                       rng.uniform(-0.5, 0.5, 3)]
        board = matrices(wanted)
        flange = (matrices(fixed) @ board @ inverted(matrices(carried)) if camera_on == "stand"
                  else matrices(fixed) @ inverted(board) @ inverted(matrices(carried)))
        robot.append(pose_vectors(flange))
        seen = (_CORNERS @ board[:3, :3].T + board[:3, 3]) @ _LENS.T
        pixels = seen[:, :2] / seen[:, 2:] + _PIXEL * rng.standard_normal((len(_CORNERS), 2))
        rough = wanted + rng.standard_normal(6) * np.repeat([0.002, 0.01], 3)
        views.append(View(f"{number}.png", _CORNERS, pixels, rough))
    true = np.r_[fixed, carried] if camera_on == "stand" else np.r_[carried, fixed]
    fit, _ = fit_pictures(np.array(robot), views, _CAMERA, camera_on, largest_residual=0.05)
    off = np.r_[fit.camera, fit.board] - true
    turn = rotation_vector(matrices(fit.camera)[:3, :3] @ matrices(true[:6])[:3, :3].T)
    inside = off @ np.linalg.solve(fit.covariance, off) <= chi2.ppf(_LEVEL, len(off))
    return _numbers(off[:3], turn, float(inside))


def _numbers(off: np.ndarray, turn: np.ndarray, inside: float) -> dict[str, float]:
    return {"off_m": float(np.linalg.norm(off)),
            "turned_degrees": float(np.degrees(np.linalg.norm(turn))), "inside": float(inside)}
