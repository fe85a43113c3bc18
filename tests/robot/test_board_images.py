"""The base from pictures of a board: in pixels, with an interval that holds; found by OpenCV."""


import numpy as np
import pytest
from tests.robot.test_hand_eye import BOARD, CARRIED, STANDING, STANDING_BOARD
from tests.subjects.commands import answer

from limber.cell.cell_file import CameraEntry, Cell, read_cell, write_cell
from limber.core.errors import InputError
from limber.core.numerics.rigid import inverted, matrices, pose_vectors, rotation_vector
from limber.robot.calibration import Board, View, find_board, fit_pictures

CAMERA = CameraEntry(pose=(0,) * 6, width=1280, height=960, focal_px=(1100.0, 1100.0),
                     centre_px=(640.0, 480.0))
CORNERS = np.array([[0.03 * (i - 2.5), 0.03 * (j - 1.5), 0.0] for j in range(4) for i in range(6)])
LENS = np.array([[1100.0, 0, 640], [0, 1100.0, 480], [0, 0, 1]])


def seen_from(frame: np.ndarray) -> np.ndarray:
    """Pixels [k, 2] of the corners of a board at ``frame`` in the camera's."""
    places = (CORNERS @ frame[:3, :3].T + frame[:3, 3]) @ LENS.T
    return places[:, :2] / places[:, 2:]


def pictures(count: int, camera_on: str, seed: int, noise: float = 0.3,
             ) -> tuple[np.ndarray, list[View]]:
    """Poses of the robot that keep the board before the camera, and what it sees."""
    rng = np.random.default_rng(seed)
    robot, views = [], []
    while len(views) < count:
        wanted = np.r_[rng.uniform([-0.1, -0.08, 0.45], [0.1, 0.08, 0.7]),
                       rng.uniform(-0.5, 0.5, 3)]
        board = matrices(wanted)
        if camera_on == "stand":
            flange = matrices(STANDING) @ board @ inverted(matrices(BOARD))
        else:
            flange = matrices(STANDING_BOARD) @ inverted(board) @ inverted(matrices(CARRIED))
        pixels = seen_from(board) + noise * rng.standard_normal((len(CORNERS), 2))
        rough = np.r_[wanted[:3] + 0.002 * rng.standard_normal(3),
                      rotation_vector(board[:3, :3] @ matrices(np.r_[
                          0, 0, 0, 0.01 * rng.standard_normal(3)])[:3, :3])]
        robot.append(pose_vectors(flange))
        views.append(View(f"{len(views)}.png", CORNERS, pixels, rough))
    return np.array(robot), views


@pytest.mark.parametrize("camera_on, true", [
    ("stand", np.r_[STANDING, BOARD]), ("gripper", np.r_[CARRIED, STANDING_BOARD])])
def test_a_third_of_a_pixel_leaves_a_millimetre_and_the_interval_holds(camera_on, true):
    """Twelve pictures, two draws: place, rotation, and how far they are off by their own word."""
    deviations = []
    for seed in range(2):
        robot, views = pictures(12, camera_on, seed)
        fit, pixels = fit_pictures(robot, views, CAMERA, camera_on, largest_residual=0.05)
        assert np.linalg.norm(fit.camera[:3] - true[:3]) < 1e-3
        turn = rotation_vector(matrices(fit.camera)[:3, :3] @ matrices(true[:6])[:3, :3].T)
        assert np.degrees(np.linalg.norm(turn)) < 0.1
        assert np.sqrt(np.mean(pixels**2)) == pytest.approx(0.3 * np.sqrt(2), rel=0.15)
        off = np.r_[fit.camera, fit.board] - true
        deviations.append(off @ np.linalg.solve(fit.covariance, off))
    # Squared deviations of twelve numbers, twice: 24 on average, 11 to 42 in 98 of 100 cases.
    assert 10.9 < sum(deviations) < 43.0


def test_a_picture_of_another_pose_is_named():
    robot, views = pictures(12, "stand", 3)
    views[4] = View("mixed.png", CORNERS, views[4].pixels + [8.0, 0], views[4].pose)
    with pytest.raises(InputError, match=r"mixed\.png has a residual of \d"):
        fit_pictures(robot, views, CAMERA, "stand", largest_residual=0.05)


def drawn(cv2, kind: str, frame: np.ndarray, path) -> None:
    """Write the picture of a printed board at ``frame`` in the camera's frame."""
    scale, margin = 8000.0, 0.01  # pixels a metre of the print, white around it
    if kind == "charuco":
        printed = cv2.aruco.CharucoBoard((7, 5), 0.03, 0.022, cv2.aruco.getPredefinedDictionary(
            cv2.aruco.DICT_5X5_100)).generateImage((1680, 1200))
        corner, size = np.zeros(2), np.array([0.21, 0.15])
    else:
        printed = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(
            cv2.aruco.DICT_APRILTAG_36h11), 3, 800)
        corner, size = np.array([-0.05, 0.05]), np.array([0.1, -0.1])
    border = round(margin * scale)
    printed = cv2.copyMakeBorder(printed, *[border] * 4, cv2.BORDER_CONSTANT, value=255)
    # From pixels of the print to its plane, and on to the picture.
    plane = np.array([[np.sign(size[0]) / scale, 0, corner[0] - np.sign(size[0]) * margin],
                      [0, np.sign(size[1]) / scale, corner[1] - np.sign(size[1]) * margin],
                      [0, 0, 1.0]])
    onto = LENS @ np.column_stack([frame[:3, 0], frame[:3, 1], frame[:3, 3]]) @ plane
    cv2.imwrite(str(path), cv2.warpPerspective(printed, onto, (1280, 960), borderValue=200))


@pytest.mark.parametrize("kind", ["charuco", "apriltag"])
def test_a_printed_board_is_found_where_it_is(kind, tmp_path):
    cv2 = pytest.importorskip("cv2")
    frame = matrices(np.array([-0.08, 0.05, 0.5, 0.2, -0.3, 0.1]) if kind == "charuco" else
                     np.array([0.02, -0.01, 0.4, np.pi - 0.2, 0.1, 0.1]))
    drawn(cv2, kind, frame, tmp_path / "a.png")
    board = Board(kind, (7, 5), 0.03 if kind == "charuco" else 0.1, 0.022,
                  "DICT_5X5_100" if kind == "charuco" else "DICT_APRILTAG_36h11")
    view = find_board(tmp_path / "a.png", board, CAMERA)
    assert len(view.corners) == (24 if kind == "charuco" else 4)
    assert matrices(view.pose)[:3, 3] == pytest.approx(frame[:3, 3], abs=2e-3)
    places = (view.corners @ frame[:3, :3].T + frame[:3, 3]) @ LENS.T
    assert np.abs(places[:, :2] / places[:, 2:] - view.pixels).max() < 1.5
    cv2.imwrite(str(tmp_path / "empty.png"), np.full((960, 1280), 200, np.uint8))
    assert find_board(tmp_path / "empty.png", board, CAMERA) is None
    with pytest.raises(InputError, match="640 x 480 pixels"):
        cv2.imwrite(str(tmp_path / "small.png"), np.zeros((480, 640), np.uint8))
        find_board(tmp_path / "small.png", board, CAMERA)


def test_the_command_calibrates_by_pictures(branch_folder, tmp_path):
    """From files to the cell: base, camera and residuals in pixels."""
    cv2 = pytest.importorskip("cv2")
    robot, views = pictures(6, "stand", 1)
    lines = ["image,robot_x_m,robot_y_m,robot_z_m,robot_rx_rad,robot_ry_rad,robot_rz_rad"]
    for pose, view in zip(robot, views, strict=True):
        board = inverted(matrices(STANDING)) @ matrices(pose) @ matrices(BOARD)
        # The corner of the print from the middle of its corners.
        board = board @ matrices(np.array([-0.105, -0.075, 0, 0, 0, 0.0]))
        drawn(cv2, "charuco", board, tmp_path / view.name)
        lines.append(",".join([view.name, *map(repr, map(float, pose))]))
    (tmp_path / "pictures.csv").write_text("\n".join(lines) + "\n")
    path = tmp_path / "cell.toml"
    write_cell(path, Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6}, camera=CAMERA))
    code, told = answer("robot", "calibrate", path, branch_folder, "--images",
                        tmp_path / "pictures.csv")
    assert code == 0, told
    assert told["residual_px"] < 1.0 and len(told["pictures"]) == 6
    assert read_cell(path).base.pose == pytest.approx(told["base_pose"])
