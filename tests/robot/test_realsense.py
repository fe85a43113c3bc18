"""A RealSense camera: the small part of its package that is used, from a fake of it."""

import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from tests.subjects.commands import robot_answer

from limber.cell.cell_file import Cell, write_cell
from limber.core.numerics.rigid import matrices
from limber.core.progress import Progress
from limber.geometry.cloud.camera import Camera
from limber.geometry.io.clouds import read_cloud
from limber.robot.depth_camera import RealSense, camera_differences, look, seen_points
from limber.stages.paths.plan_cell import cell_positions

WIDTH, HEIGHT, SCALE = 12, 8, 0.001
SMALL = Camera(width=WIDTH, height=HEIGHT, fx=10.0, fy=10.0, cx=6.0, cy=4.0)
CELL = Cell(robot={"model": "ur5e"}, base={"pose": (0.5, 0.1, 0, 0, 0, 1.2)},
            camera={"pose": (0.05, 0, 0.02, 0, 0, 0.1), "range_m": (0.2, 0.9)})


class Library:
    """As pyrealsense2: a pipeline of depth frames in units of a millimetre.

    Attributes:
        frames: Image of each frame, in turn.
        fails: Raised where the pipeline starts or waits.
        age: Of a frame when it comes [s]; by the clock named by ``domain``.
    """

    stream = SimpleNamespace(depth="depth")
    timestamp_domain = SimpleNamespace(global_time="global", system_time="system",
                                       hardware_clock="hardware")

    def __init__(self, camera: Camera = SMALL, scale: float = SCALE):
        self.seen, self.scale = camera, scale
        row = np.full((HEIGHT, WIDTH), 500, np.uint16)
        row[0, 0], row[0, 1] = 0, 1500
        self.frames, self.count, self.stopped = [row], 0, False
        self.fails = {}
        self.age, self.domain = 0.03, "global"

    def config(self):
        return SimpleNamespace(enable_stream=lambda kind: None)

    def pipeline(self):
        return self

    def start(self, config):
        if "start" in self.fails:
            raise RuntimeError(self.fails["start"])
        seen = SimpleNamespace(**vars(self.seen), ppx=self.seen.cx, ppy=self.seen.cy)
        video = SimpleNamespace(get_intrinsics=lambda: seen)
        sensor = SimpleNamespace(get_depth_scale=lambda: self.scale)
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
            get_stream=lambda kind: SimpleNamespace(as_video_stream_profile=lambda: video))

    def wait_for_frames(self, milliseconds):
        if "wait" in self.fails:
            raise RuntimeError(self.fails["wait"])
        self.count += 1
        return self.frame(self.frames[self.count % len(self.frames)],
                          1e3 * (time.time() - self.age))

    def frame(self, image, stamp):
        return SimpleNamespace(get_depth_frame=lambda: SimpleNamespace(
            get_data=lambda: image, get_timestamp=lambda: stamp,
            get_frame_timestamp_domain=lambda: self.domain))

    def stop(self):
        self.stopped = True


@pytest.fixture
def library(monkeypatch) -> Library:
    found = Library()
    monkeypatch.setitem(sys.modules, "pyrealsense2", found)
    return found


def test_an_image_is_the_median_of_frames_and_holes_are_none(library):
    """Every third frame misses a pixel, another has noise; a pixel that most miss has no depth."""
    first = library.frames[0]
    missing, noisy = first.copy(), first.copy()
    missing[3, 3] = 0
    noisy[4, 4] = 900
    library.frames = [first, missing, noisy]
    with RealSense() as camera:
        depth = camera.depth()
    assert library.stopped
    assert depth[3, 3] == depth[4, 4] == 0.5 and np.isnan(depth[0, 0]) and depth[0, 1] == 1.5


@pytest.mark.parametrize("mount", ["branch", "flange"])
def test_points_are_in_the_branchs_frame(library, mount):
    cell = CELL.model_copy(update={"camera": CELL.camera.model_copy(update={"mount": mount})})
    flange = cell.arm.forward(np.array(cell.arm.home)) if mount == "flange" else None
    with RealSense() as camera:
        points = seen_points(cell, camera, flange)
    # The hole and what is beyond the range are left out.
    assert len(points) == WIDTH * HEIGHT - 2
    frame = matrices(np.array(cell.camera.pose))
    if flange is not None:
        frame = matrices(np.array(cell.base.pose)) @ flange @ frame
    pixel = frame @ [0.5 * (11 - 6) / 10, 0.5 * (7 - 4) / 10, 0.5, 1.0]
    assert points[-1] == pytest.approx(pixel[:3])


def run(arguments: list[str], capfd) -> tuple[int, dict]:
    return robot_answer(capfd, "scan", *arguments)


def test_the_command_writes_a_cloud_and_names_what_is_missing(library, tmp_path, capfd,
                                                              monkeypatch):
    path, out = tmp_path / "cell.toml", tmp_path / "scan.ply"
    write_cell(path, CELL)
    code, told = run(["--realsense", str(path), "-o", str(out)], capfd)
    assert code == 0 and told["point_count"] == WIDTH * HEIGHT - 2
    assert len(read_cloud(out).points) == WIDTH * HEIGHT - 2
    for name in ("start", "wait"):
        library.fails = {name: "no device"}
        code, told = run(["--realsense", str(path), "-o", str(out)], capfd)
        assert code == 3 and "no device" in told["error"]
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    code, told = run(["--realsense", str(path), "-o", str(out)], capfd)
    assert code != 0 and "pip install pyrealsense2" in told["error"]
    code, told = run(["-o", str(out)], capfd)
    assert code == 2 and "Neither --middle nor --realsense" in told["error"]


@pytest.mark.parametrize("domain, age", [("global", 0.03), ("hardware", 0.0)])
def test_a_frame_tells_when_it_was_taken(library, domain, age):
    """By its own stamp where that is this computer's clock; else by its arrival."""
    library.domain = domain
    with RealSense() as camera:
        before = time.monotonic()
        depth, taken = camera.frame()
    assert depth[0, 1] == 1.5 and np.isnan(depth[0, 0])
    assert before - 1e-3 < taken + age < time.monotonic() + 1e-3


def test_a_cells_camera_is_compared_with_the_connected_one(library):
    """Goals in its view are planned with the cell's intrinsics."""
    right = CELL.model_copy(update={"camera": CELL.camera.model_copy(update={
        "width": WIDTH, "height": HEIGHT, "focal_px": (10.05, 10.0), "centre_px": (6.5, 4.0)})})
    with RealSense() as camera:
        assert camera_differences(right, camera.camera) == []
        size, focal, centre = camera_differences(CELL, camera.camera)
    assert "(12, 8) pixels in the connected camera, (640, 480) in the cell file" in size
    assert "camera.focal_px" in focal and "camera.centre_px" in centre


def test_what_stands_before_the_camera_hides_a_goal(library):
    """A wall at .5 m fills the image; the part of it that is the branch hides nothing."""
    told = []
    progress = Progress(on_warning=told.append)
    camera = matrices(np.array(CELL.camera.pose))

    def at(column: float, row: float, depth: float) -> np.ndarray:
        return (camera @ [depth * (column - 6) / 10, depth * (row - 4) / 10, depth, 1.0])[:3]
    branch = np.array([at(8.0, 5.0, 0.5)])
    seen = look(CELL, branch, progress)
    assert "something 0.50 m before the camera" in seen.hiding(at(3.0, 2.0, 0.7))
    assert seen.hiding(at(3.0, 2.0, 0.45)) == seen.hiding(at(3.0, 2.0, -0.5)) == ""
    assert seen.hiding(at(40.0, 2.0, 0.7)) == ""
    assert np.isnan(seen.depth[5, 8]) and seen.depth[2, 3] == 0.5
    # Its own intrinsics are the view, and the cell's are named.
    assert sum("The connected camera's own view is taken" in text for text in told) == 3
    place = cell_positions(CELL, (), seen)["view"]
    assert place.blocked(at(3.0, 2.0, 0.7), None) == seen.hiding(at(3.0, 2.0, 0.7))
    assert place.region.distance(at(3.0, 2.0, 0.7)[None])[0] <= 0.0
    assert place.region.distance(at(13.0, 2.0, 0.7)[None])[0] > 0.0
    told.clear()
    library.fails = {"start": "no device"}
    assert look(CELL, branch, progress) is None
    assert "No connected camera was asked" in told[0] and "no device" in told[0]
