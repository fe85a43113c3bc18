"""A camera found from a board or marker seen in several poses of the arm, and the base from it."""


import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.subjects.commands import robot_answer

from limber.cell.cell_file import Cell, read_cell, write_cell
from limber.core.errors import InputError
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.robot.calibration import base_from_camera, fit_camera
from limber.store import Branch

STANDING = np.array([1.2, -0.3, 0.6, -1.9, 0.4, 0.3])
CARRIED = np.array([0.02, -0.06, -0.05, 0.1, 0.05, 1.4])
BOARD = np.array([0.01, 0.03, 0.02, 0.2, -0.1, 0.4])
STANDING_BOARD = np.array([0.5, 0.3, 0.1, 0.1, 0.2, -0.7])


def poses(count: int, rng: np.random.Generator) -> np.ndarray:
    """Of the gripper, tilted about all axes."""
    return np.hstack([[0.4, 0.1, 0.4] + rng.uniform(-0.15, 0.15, (count, 3)),
                      rng.uniform(-0.6, 0.6, (count, 3))])


def views(count: int, camera_on: str, *, seed: int = 0, noise: float = 3e-4, turn: float = 2e-3,
          robot: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return poses of the robot, and the board's as a camera sees it that errs a little."""
    rng = np.random.default_rng(seed)
    robot = poses(count, rng) if robot is None else robot
    if camera_on == "stand":
        seen = inverted(matrices(STANDING)) @ matrices(robot) @ matrices(BOARD)
    else:
        seen = inverted(matrices(robot) @ matrices(CARRIED)) @ matrices(STANDING_BOARD)
    seen = pose_vectors(seen @ matrices(np.hstack([np.zeros((len(robot), 3)),
                                                   turn * rng.standard_normal((len(robot), 3))])))
    seen[:, :3] += noise * rng.standard_normal((len(robot), 3))
    return robot, seen


@pytest.mark.parametrize("camera_on, camera, board", [
    ("stand", STANDING, BOARD), ("gripper", CARRIED, STANDING_BOARD)])
def test_exact_views_give_the_frames_to_round_off(camera_on, camera, board):
    robot, seen = views(4, camera_on, noise=0.0, turn=0.0)
    fit = fit_camera(robot, seen, camera_on)
    assert fit.camera == pytest.approx(camera, abs=1e-7)
    assert fit.board == pytest.approx(board, abs=1e-7)
    # Without turns of the board its place alone tells the camera.
    marker = fit_camera(*[part[:, :width] for part, width in zip(
        views(6, camera_on, noise=0.0, turn=0.0), (6, 3), strict=True)], camera_on)
    assert marker.camera == pytest.approx(camera, abs=1e-7)
    assert marker.board[:3] == pytest.approx(board[:3], abs=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("camera_on", ["stand", "gripper"])
def test_the_base_is_off_by_about_what_is_said(camera_on):
    """Noise of 0.3 mm and 2 mrad in 10 views: over 12 draws, in deviations as they should be."""
    scan = matrices(np.array([0.1, 0.2, -0.3, 0.2, 0.1, -0.4]))
    near = np.array([0.0, 0.05, 0.3])
    scan_pose = None if camera_on == "stand" else np.array([0.45, 0.0, 0.5, 0.1, 0.2, 0.3])
    there = matrices(STANDING if camera_on == "stand" else scan_pose)
    truth = scan @ inverted(there if camera_on == "stand" else there @ matrices(CARRIED))
    off, turned = [], []
    for seed in range(12):
        robot, seen = views(10, camera_on, seed=seed)
        base, position, turn = base_from_camera(fit_camera(robot, seen, camera_on), scan,
                                                camera_on, scan_pose, near)
        difference = matrices(base) @ inverted(truth)
        place = (difference @ np.r_[near, 1.0])[:3] - near
        off.append(np.linalg.norm(place) / position)
        turned.append(Rotation.from_matrix(difference[:3, :3]).magnitude() / turn)
        assert position < 2e-3 and turn < 4e-3
    # The worst axis' deviation against a vector's length: about 1 to 1.7 of it at one deviation.
    assert 0.4 < np.median(off) < 2.0 and max(off) < 4.5
    assert 0.4 < np.median(turned) < 2.0 and max(turned) < 4.5


def test_what_cannot_be_told_is_refused():
    robot, seen = views(8, "stand")
    with pytest.raises(InputError, match="2 views of a board"):
        fit_camera(robot[:2], seen[:2], "stand")
    with pytest.raises(InputError, match="4 views of a marker"):
        fit_camera(robot[:4], seen[:4, :3], "stand")
    flat = robot.copy()
    flat[:, 3:5] = 0.0
    with pytest.raises(InputError, match="about a second axis"):
        fit_camera(*views(8, "stand", robot=flat), "stand")
    plane = robot.copy()
    plane[:, 2:4] = 0.3, 0.0
    with pytest.raises(InputError, match="lie in a plane"):
        fit_camera(plane, (plane[:, :3] @ matrices(STANDING)[:3, :3]) + 0.1, "stand")
    mixed = seen.copy()
    mixed[[2, 5]] = seen[[5, 2]]
    with pytest.raises(InputError, match=r"View \d has a residual of"):
        fit_camera(robot, mixed, "stand")
    carried = views(8, "gripper")
    with pytest.raises(InputError, match="has no axes"):
        base_from_camera(fit_camera(carried[0], carried[1][:, :3], "gripper"), np.eye(4),
                         "gripper", None, np.zeros(3))


def test_the_command_writes_the_base_and_the_camera(branch_folder, tmp_path, capfd):
    """The scan in the standing camera's frame: base and camera come into the branch's."""
    write_cell(tmp_path / "cell.toml", Cell(
        robot={"model": "ur5e"}, base={"pose": (0,) * 6}, camera={"pose": (0,) * 6}))
    robot, seen = views(10, "stand", seed=5)
    names = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
    header = ",".join([*(f"robot_{n}" for n in names), *(f"seen_{n}" for n in names)])
    np.savetxt(tmp_path / "views.csv", np.hstack([robot, seen]), delimiter=",", header=header,
               comments="")
    given = ["calibrate", tmp_path / "cell.toml", branch_folder]
    code, told = robot_answer(capfd, *given, "--views", tmp_path / "views.csv")
    assert code == 0
    cell, branch = read_cell(tmp_path / "cell.toml"), Branch.open(branch_folder)
    assert cell.branch == branch.uuid and told["residual_m"] < 1e-3
    assert cell.base.residual_m == pytest.approx(told["residual_m"], rel=1e-8)
    # The camera's own frame is the scan's: what it takes there is what the alignment does.
    point = np.array([[0.1, -0.2, 0.8]])
    there = matrices(np.array(cell.camera.pose)) @ np.r_[point[0], 1.0]
    assert there[:3] == pytest.approx(branch.manifest.alignment.apply(point)[0], abs=1e-6)
    assert cell.camera.mount == "branch"
    held = matrices(np.array(cell.base.pose)) @ matrices(STANDING)
    assert np.abs(held - matrices(np.array(cell.camera.pose))).max() < 5e-3
    code, told = robot_answer(capfd, *given)
    assert code == 2 and "Exactly one of --points, --views and --images" in told["error"]
