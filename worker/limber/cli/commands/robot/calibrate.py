"""Find where a robot stands beside a branch: `limber robot calibrate`."""

from __future__ import annotations

import re
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from limber.cli.cell_tool import CellTool
from limber.cli.terminal import table_text
from limber.core.errors import InputError, Option, Text, WorkError
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, argument, given

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.calibration import CameraFit
    from limber.store import Branch


class Calibrate(CellTool):
    """Write the robot's base in the branch's frame into the cell file, from points or views.

    Points are touched with the middle of the gripper while the robot is guided by hand; the
    controller's own pose is read when Enter is pressed. Four or more points that are not in one
    plane are needed: others fit a mirrored frame as well. Views are of a board or marker, found in
    the camera's pictures by another program (OpenCV's solvePnP gives such poses). The branch's scan
    is in the frame of that camera, so no points need to be touched.
    """

    about = About("robot calibrate", where="{cell_file}", found=(
        "The base's position is known to {position_sigma_m:m} (standard deviation); RMS residual "
        "{residual_m:m}.",), then="limber robot check {cell_file}")

    branch_folder: Path = argument("The branch folder.")
    points: Path | None = given(
        "CSV of points on the branch to touch: name,x_m,y_m,z_m in the branch's frame. With six "
        "more columns, robot_x_m to robot_rz_rad, the robot's pose is read from the file.")
    views: Path | None = given(
        "CSV of a board or marker seen by the camera that scanned the branch, one line for each "
        "pose of the arm: robot_x_m to robot_rz_rad of the gripper's middle, seen_x_m, seen_y_m, "
        "seen_z_m in the camera's frame, and seen_rx_rad, seen_ry_rad, seen_rz_rad for a board.")
    images: Path | None = given(
        "CSV of the camera's pictures of a board, one line for each pose of the arm: image (a "
        "file beside the table) and robot_x_m to robot_rz_rad. Needs OpenCV and [camera] in the "
        "cell file.")
    board: Literal["charuco", "apriltag"] = Field(
        "charuco", description="With --images: what is printed.")
    squares: tuple[int, int] = Field((7, 5), description=(
        "Squares of the ChArUco board along x and y."))
    square_m: float = Field(0.03, description=(
        "Edge length of its squares, or of the AprilTag [m]."))
    marker_m: float = Field(0.022, description="Edge length of its markers [m].")
    dictionary: str | None = Field(None, description=(
        "Of the markers, as OpenCV names it. Default: DICT_5X5_100 or DICT_APRILTAG_36h11."))
    camera_on: Literal["stand", "gripper"] = Field("stand", description=(
        "With --views and --images: what carries the camera. The other one carries the board."))
    scan_pose: tuple[float, float, float, float, float, float] | None = Field(
        None, description="With --camera-on gripper: pose of the gripper in the base frame [m, "
        "rad] when the camera scanned the branch. Default: the scan is in the board's frame.",
        json_schema_extra={"metavar": "X Y Z RX RY RZ"})
    largest_residual: float = Field(0.01, description=(
        "Largest residual of a point or view [m]; a larger one is refused."))

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.store import Branch

        cell, branch = self.cell(), Branch.read(self.branch_folder)
        if sum(file is not None for file in (self.points, self.views, self.images)) != 1:
            raise InputError(Text("Exactly one of ", Option("points"), ", ", Option("views"),
                                  " and ", Option("images"), " must be given."),
                             "The base is found from touched points or from a camera's views.",
                             "Give one of them.")
        if self.points is not None:
            return _by_touching(self, cell, branch, self.points, progress)
        if self.scan_pose is not None and self.camera_on == "stand":
            raise InputError(Text(Option("scan_pose"), " was given, but the camera is fixed."),
                             "The position of a fixed camera does not follow from a pose of the "
                             "arm.", "Omit it, or give ", Option("camera_on", "gripper"), ".")
        if self.views is not None:
            return _by_seeing(self, cell, branch, _views_of(self, self.views), progress)
        fit, summary = _pictures_of(self, cell, present(self.images, "images"), progress)
        return _by_seeing(self, cell, branch, fit, progress) | summary


def _views_of(asked: Calibrate, views_file: Path) -> CameraFit:
    """Fit the camera to a table of board poses that another program has found."""
    from limber.core.files.tables import read_columns
    from limber.recordings.recording import POSE_COLUMNS
    from limber.robot.calibration import fit_camera

    robot_columns = [f"robot_{name}" for name in POSE_COLUMNS]
    seen_columns = [f"seen_{name}" for name in POSE_COLUMNS]
    table = read_columns(views_file, [*robot_columns, *seen_columns[:3]],
                         "a table of views (robot_x_m .. robot_rz_rad, seen_x_m .. seen_rz_rad)")
    is_board = all(name in table for name in seen_columns)
    robot = np.column_stack([table[name] for name in robot_columns])
    seen = np.column_stack([table[name] for name in seen_columns[:6 if is_board else 3]])
    return fit_camera(robot, seen, asked.camera_on, largest_residual=asked.largest_residual)


def _pictures_of(asked: Calibrate, cell: Cell, images_file: Path, progress: Progress,
                 ) -> tuple[CameraFit, dict[str, Any]]:
    """Find a board in pictures and fit the camera to them."""
    from limber.robot.calibration import Board, find_board, fit_pictures

    if cell.camera is None:
        raise InputError("The cell file has no [camera].", "Focal length and size of the pictures "
                         "are unknown.", "Add [camera] with width, height, focal_px and "
                         "centre_px.")
    usual = "DICT_5X5_100" if asked.board == "charuco" else "DICT_APRILTAG_36h11"
    board = Board(asked.board, asked.squares, asked.square_m, asked.marker_m,
                  asked.dictionary or usual)
    names, poses = _pictures(images_file)
    found = [find_board(images_file.parent / name, board, cell.camera) for name in names]
    for name, view in zip(names, found, strict=True):
        if view is None:
            progress.warn(f"The board is not seen in {name}, which is omitted.")
    views = [view for view in found if view is not None]
    if not views:
        raise InputError("The board is seen in no picture.", "", "Check ", Option("board"), ", ",
                         Option("squares"), " and ", Option("dictionary"), " against what was "
                         "printed.")
    robot = poses[[view is not None for view in found]]
    fit, pixels = fit_pictures(robot, views, cell.camera, asked.camera_on, asked.largest_residual)
    return fit, {"residual_px": float(np.sqrt(np.mean(pixels**2))), "pictures": [
        {"name": view.name, "residual_px": float(off), "corners": len(view.corners)}
        for view, off in zip(views, pixels, strict=True)]}


def _pictures(path: Path) -> tuple[list[str], np.ndarray]:
    """Names and poses [n, 6] of a table of pictures."""
    from limber.core.files.tables import csv_records
    from limber.recordings.recording import POSE_COLUMNS

    columns = [f"robot_{name}" for name in POSE_COLUMNS]
    rows = csv_records(path, "a table of pictures")
    try:
        names = [row["image"] for row in rows]
        poses = np.array([[float(row[name]) for name in columns] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no table of pictures ({error}).",
                         f"Its columns are image and {', '.join(columns)}.", "Correct the file.",
                         ) from error
    return names, poses.reshape(-1, 6)


def _by_seeing(asked: Calibrate, cell: Cell, branch: Branch, fit: CameraFit, progress: Progress,
               ) -> dict[str, Any]:
    from limber.core.numerics.rigid import matrices, pose_vectors
    from limber.robot.calibration import base_from_camera
    from limber.store.loading import load_skeleton

    alignment = branch.manifest.alignment
    scan = np.eye(4)
    scan[:3, :3] = np.array(alignment.rotation)
    scan[:3, 3] = -scan[:3, :3] @ np.array(alignment.origin)
    pose, position_sigma, rotation_sigma = base_from_camera(
        fit, scan, asked.camera_on,
        None if asked.scan_pose is None else np.array(asked.scan_pose),
        load_skeleton(branch).nodes.mean(axis=0))
    camera = matrices(fit.camera)
    camera = (matrices(pose) if asked.camera_on == "stand"
              else matrices(np.array(cell.tool.grasp_pose))) @ camera
    mounted = {"pose": tuple(map(float, pose_vectors(camera))),
               "mount": "branch" if asked.camera_on == "stand" else "flange"}
    if cell.camera is not None:
        cell = cell.model_copy(update={"camera": cell.camera.model_copy(update=mounted)})
    _write_base(asked.cell_file, cell, branch.uuid, pose, position_sigma, rotation_sigma,
                fit.residual)
    progress.say(table_text("Views", [["view", "off [mm]"], *(
        [str(number + 1), f"{1000 * off:.2f}"] for number, off in enumerate(fit.residuals))]))
    return {"cell": str(asked.cell_file), "branch": branch.uuid, "base_pose": pose,
            "residual_m": fit.residual, "position_sigma_m": position_sigma,
            "rotation_sigma_rad": rotation_sigma, "camera_pose": mounted["pose"],
            "camera_mount": mounted["mount"]}


def _by_touching(asked: Calibrate, cell: Cell, branch: Branch, points_file: Path,
                 progress: Progress) -> dict[str, Any]:
    from limber.robot.calibration import fit_base, require_frame

    names, on_branch, touched = _points(points_file)
    # Before the user touches any points.
    require_frame(on_branch, names, "on the branch", asked.largest_residual)
    version = cell.robot.version
    if touched is None:
        if not sys.stdin.isatty():
            raise InputError("Touching points needs a terminal, and standard input is "
                             "none.", "", "Run it in a terminal, or give the robot's poses "
                             "in the points file.")
        touched, version = _touch(cell, names)
    fit = fit_base(touched, on_branch, largest_residual=asked.largest_residual, names=names)
    cell = cell.model_copy(update={"robot": cell.robot.model_copy(update={"version": version})})
    _write_base(asked.cell_file, cell, branch.uuid, fit.pose, fit.position_sigma,
                fit.rotation_sigma, fit.residual)
    progress.say(table_text("Touched points", [["point", "off [mm]"], *(
        [name, f"{1000 * off:.2f}"] for name, off in zip(names, fit.residuals, strict=True))]))
    return {"cell": str(asked.cell_file), "branch": branch.uuid, "base_pose": fit.pose,
            "residual_m": fit.residual,
            "points": [{"name": name, "residual_m": float(off)}
                       for name, off in zip(names, fit.residuals, strict=True)],
            "position_sigma_m": fit.position_sigma, "rotation_sigma_rad": fit.rotation_sigma}


def _write_base(cell_file: Path, cell: Cell, branch: str, pose: np.ndarray, position_sigma: float,
                rotation_sigma: float, residual: float) -> None:
    """Write a cell whose base is calibrated for a branch, with the branch's identity."""
    from limber.cell.cell_file import BaseEntry, write_cell

    base = BaseEntry(pose=tuple(map(float, pose)), position_sigma_m=max(position_sigma, 1e-4),
                     rotation_sigma_rad=max(rotation_sigma, 1e-4), residual_m=residual)
    write_cell(cell_file, cell.model_copy(update={
        "base": base, "branch": branch,
        "calibrated": datetime.now(UTC).isoformat(timespec="seconds")}))


def _points(path: Path) -> tuple[list[str], np.ndarray, np.ndarray | None]:
    from limber.core.files.tables import csv_rows

    try:
        rows = csv_rows(path, "a table of points")
        if rows and not re.match(r"\s*([-+.\d]|nan|inf)", rows[0][1], re.IGNORECASE):
            rows = rows[1:]  # a header
        names = [row[0] for row in rows]
        numbers = np.array([[float(part) for part in row[1:]] for row in rows])
    except (ValueError, IndexError) as error:
        raise InputError(f"{path} cannot be read as points ({error}).",
                         "A line has name,x_m,y_m,z_m.", "Correct the file.") from error
    if not np.isfinite(numbers).all():
        raise InputError(f"{path} contains a number that is not finite.",
                         "A position has three finite numbers.", "Correct the file.")
    if numbers.ndim != 2 or numbers.shape[1] not in (3, 9):
        raise InputError(f"{path} has {numbers.shape[-1]} numbers a line.",
                         "Three, or nine with the robot's pose, were expected.",
                         "Correct the file.")
    return names, numbers[:, :3], numbers[:, 3:6] if numbers.shape[1] == 9 else None


def _touch(cell: Cell, names: list[str]) -> tuple[np.ndarray, str]:
    """Read the tool's position at each point; the arm is guided by hand, no command is sent to it.
    """
    from limber.robot.calibration import gripper_pose
    from limber.robot.ur.rtde import SampleStream

    touched = []
    stream = SampleStream(cell.robot.address)
    try:
        version = ".".join(map(str, stream.version[:3]))
        for name in names:
            input(f"Touch {name} with the middle of the gripper, then press Enter ")
            stream.skip()
            samples = stream.read(1.0)
            if not samples:
                raise WorkError("The robot sends no data.", "", "Restart its controller.")
            touched.append(gripper_pose(cell, samples[-1])[:3])
    finally:
        stream.close()
    return np.array(touched), version
