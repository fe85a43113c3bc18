"""A virtual controller stepped by hand, and one in a process with the real client on it."""

import gc
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import numpy as np
import psutil
import pytest

from benchmarks.machine_stalls import HELD_UP_SECONDS, Witness
from benchmarks.robot_cells import cell_file, sideways
from benchmarks.robot_faults import new_robot, restored
from benchmarks.robot_ros_stepped import HOME, ROS_CELL, SteppedRos
from benchmarks.robot_rosbridge import RosBridge
from benchmarks.robot_stepped import SteppedRobot
from limber.cell.cell_file import Cell
from limber.geometry.rigid_kernels import pose_between
from limber.mechanics.statics.result import Status
from limber.robot.driver.link import RobotLink
from limber.robot.driver.real_time import claim_real_time, may_use_two_processors
from limber.robot.virtual.controller import Controller
from limber.stages.paths.execute import ExecutePlan
from limber.store import Branch
from limber.store.loading import load_grasp_model, load_skeleton

FRACTION = 0.92  # of the main path, where the small branch is planned to be held


class Registers:
    """Writes commands into a controller's registers as ur-rtde does, and steps it."""

    def __init__(self, controller: Controller):
        self.controller = controller
        controller.load_script("def rtde_control():\nend\n")
        controller.step()

    def write(self, command: int, *numbers: float) -> None:
        values = {f"input_double_register_{k}": float(x) for k, x in enumerate(numbers)}
        self.controller.write_inputs(values)
        self.controller.write_inputs({"input_int_register_0": command})

    def run(self, command: int, *numbers: float, most_seconds: float = 20.0) -> list[np.ndarray]:
        """Do a command; returns the tool's poses at every step until the script says done."""
        self.write(command, *numbers)
        poses = [self.controller.pose]
        for _ in range(int(most_seconds / self.controller.seconds)):
            self.controller.step()
            poses.append(self.controller.pose)
            if self.controller.outputs_int[0] == 2:
                break
        else:
            raise AssertionError("the command did not end")
        self.controller.write_inputs({"input_int_register_0": 0})
        self.controller.step()
        return poses

    def servo(self, command: int, target: np.ndarray, lookahead: float = 0.1,
              gain: float = 300.0) -> None:
        """Send one target of a stream, as ur-rtde does, and step on."""
        self.write(command, *target, 0, 0, 0.002, lookahead, gain)
        self.controller.write_inputs({"input_int_register_0": 0})
        self.controller.step()

    def line(self, target: np.ndarray, speed: float = 0.1, settle: float = 1.5) -> np.ndarray:
        """Stream the tool's poses on a line to ``target`` [6]; returns those it took, [n, 6]."""
        start, poses = self.controller.pose, []
        count = int(np.linalg.norm(target[:3] - start[:3]) / speed / self.controller.seconds)
        for part in np.r_[np.linspace(0, 1, count), np.ones(int(settle / self.controller.seconds))]:
            self.servo(24, pose_between(start, target, part))
            poses.append(self.controller.pose)
        return np.array(poses)

    def wait(self, seconds: float) -> np.ndarray:
        """Step on; returns the tool's poses, shape [n, 6]."""
        poses = []
        for _ in range(round(seconds / self.controller.seconds)):
            self.controller.step()
            poses.append(self.controller.pose)
        return np.array(poses)


@pytest.fixture
def registers():
    """A UR5e that runs the control script, at its home pose."""
    return Registers(Controller("ur5e", seed=3))


@pytest.fixture(scope="module")
def robots(worker_address):
    """A virtual robot of each series in a process of its own; the CB3 has an FT300."""
    host = int(worker_address.split(".")[-1])
    with ExitStack() as stack, ThreadPoolExecutor() as both:
        started = [both.submit(new_robot, f"127.0.0.{host + beside}", model, seed)
                   for beside, model, seed in ((20, "ur5", 3), (40, "ur5e", 5))]
        yield {robot.model: stack.enter_context(robot) for robot in
               (each.result() for each in started)}


def planned_in(folder, force: float = 1.5) -> None:
    """Write the way on which a growing sideways force takes the branch: it stretches nothing."""
    from limber.mechanics import solve_static

    branch = Branch.open(folder)
    model = load_grasp_model(branch, gravity=True)
    direction = sideways(branch, FRACTION)
    state, positions = model.rest, []
    for part in np.linspace(0, force, 9):
        state = solve_static(model.model, grasp=model.grasp, grasp_force=part * direction,
                             start=state)
        assert state.converged
        positions.append(model.pose(state.displacement)[:3])
    results = model.follow(np.array(positions), model.rest.displacement)
    assert all(result.status == Status.converged for result in results)
    rows = [np.r_[k, model.pose(result.displacement), 0, np.linalg.norm(result.reaction_force), 0]
            for k, result in enumerate(results)]
    with branch.stage("plan:path") as stage:
        lines = ["s_m,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,energy_j,force_n,strain"]
        lines += [",".join(f"{x:.9g}" for x in row) for row in rows]
        stage.path("plans/path.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture(scope="package")
def planned_template(branch_template, tmp_path_factory):
    """The small branch with its true moduli in the mesh, and a plan."""
    from limber.estimation.simulated_pull import PullSpec
    from limber.mechanics.materials.materials import young_weights
    from limber.stages.pulls.virtual_pull import load_truth
    from limber.store.loading import load_mesh

    folder = shutil.copytree(branch_template, tmp_path_factory.mktemp("plans") / "planned.branch")
    branch = Branch.open(folder)
    truth = load_truth(branch, PullSpec())
    mesh = load_mesh(branch)
    young = young_weights(mesh, truth.control_points) @ np.asarray(truth.young, float)
    held = np.linalg.norm(mesh.nodes - load_skeleton(branch).point_at(FRACTION), axis=1) < 0.012
    with branch.stage("estimate") as stage:
        mesh.with_data(cell_data={**mesh.cell_data, "young": young},
                       point_data={**mesh.point_data, "grasp": held.astype(int)},
                       ).write(stage.path("mesh.vtu"))
    planned_in(folder)
    return folder


@pytest.fixture
def planned_folder(planned_template, tmp_path):
    return shutil.copytree(planned_template, tmp_path / "planned.branch")


@pytest.fixture
def cb3(robots):
    """The UR5, as a test before has not left it."""
    restored(robots["ur5"])
    return robots["ur5"]


@pytest.fixture
def e_series(robots):
    """The UR5e, as a test before has not left it."""
    restored(robots["ur5e"])
    return robots["ur5e"]


@pytest.fixture(params=["ur5", "ur5e"])
def robot(request, robots):
    """Each of the two."""
    return request.getfixturevalue({"ur5": "cb3", "ur5e": "e_series"}[request.param])


def _stepped(model: str):
    controller = Controller(model, seed=5, ft300=model == "ur5")
    with SteppedRobot(controller).here() as robot:
        yield robot


@pytest.fixture
def stepped_cb3():
    """A UR5 with an FT300 and its driver in this process, in the robot's own time."""
    yield from _stepped("ur5")


@pytest.fixture
def stepped():
    """A UR5e and its driver in this process, in the robot's own time."""
    yield from _stepped("ur5e")


@pytest.fixture
def stepped_ros():
    """Make a robot in ROS and a link to it, in the robot's time; ``plan(server, step)`` makes the
    faults, settings are of the server."""
    with ExitStack() as around:
        def made(plan=None, cell: Cell = ROS_CELL, **settings) -> tuple[SteppedRos, RobotLink]:
            server = RosBridge(HOME)
            vars(server).update(settings)
            robot = around.enter_context(SteppedRos(
                server, None if plan is None else lambda step: plan(robot, step)).here())
            link = around.enter_context(RobotLink(cell))
            link.wait_for_samples()
            link.tare()
            return robot, link
        yield made


@contextmanager
def let_go(*interfaces):
    """Interfaces of ur-rtde that are dropped afterwards, before their robot ends.

    Each disconnects then, in half a second; one that was asked to takes another half. Where a test
    fails its traceback keeps them.
    """
    try:
        yield
    except BaseException:
        for each in interfaces:
            each.disconnect()
        raise


@pytest.fixture(scope="session")
def own_address(worker_id) -> str:
    """A loopback address of this test process: the client knows no other ports."""
    # Alone it may run beside two workers, as the real-time tests of scripts/test do.
    number = int(worker_id.removeprefix("gw")) if worker_id.startswith("gw") else 9
    return f"127.0.0.{11 + number}"


@pytest.fixture(scope="session")
def worker_address(own_address) -> str:
    """The address of a robot that moves: who uses it is held to wall clocks."""
    return own_address


@pytest.fixture(scope="package", autouse=True)
def _state_folder(tmp_path_factory):
    """Ways that robots followed are kept in a folder of the tests' own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIMBER_STATE", str(tmp_path_factory.mktemp("state")))
        yield


class Watch:
    """The witness of this test process, and when the test that is run began."""

    witness: Witness | None = None
    began = 0.0

    @classmethod
    def saw_the_machine_stand_still(cls) -> bool:
        """Whether it did since the test began, for so long that a robot is stopped."""
        return cls.witness is not None and cls.witness.longest(cls.began) > HELD_UP_SECONDS


@pytest.fixture(autouse=True)
def _watched(request):
    """Look out for the machine's own stand-stills while a robot moves."""
    if request.node.get_closest_marker("real_time") is not None:
        Watch.witness = Watch.witness or Witness()
        Watch.began = time.monotonic()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item):
    """Say of a failed test that is held to a clock what the machine did meanwhile."""
    report = yield
    if report.failed and Watch.witness is not None and item.get_closest_marker("real_time"):
        longest = Watch.witness.longest(Watch.began)
        lost = Watch.witness.lost(Watch.began, time.monotonic())
        slow = "THE MACHINE WAS SLOW: " if longest > HELD_UP_SECONDS else ""
        report.sections.append(("machine", (
            f"{slow}while this test ran, the machine stood still for {1e3 * longest:.0f} ms at a "
            f"time and {lost:.2f} s in all; a robot's loop stops the arm after 50 ms. The load was "
            f"{psutil.getloadavg()[0]:.1f} on {os.cpu_count()} cores.")))
    return report


def pytest_sessionfinish() -> None:
    """End the witness."""
    if Watch.witness is not None:
        Watch.witness.close()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what moves a robot in a process: it is held to wall clocks, wants a core to itself.

    What fails while the machine itself stands still is done again: a stop is then the right answer,
    and another one than the test asks for.
    """
    for item in items:
        if "worker_address" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.real_time)
        if item.get_closest_marker("real_time") is not None:
            item.add_marker(pytest.mark.skipif(not may_use_two_processors(), reason="real time: a "
                                               "robot and its driver want a processor each"))
            item.add_marker(pytest.mark.flaky(
                reruns=4, condition=Watch.saw_the_machine_stand_still))


@pytest.fixture
def first_in_line():
    """This process before others, as the command claims it, and the server's threads with it."""
    claim_real_time()
    # A whole search for garbage through all that a test process holds takes longer than 50 ms.
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def dry_run(folder, cell: Cell, tmp_path) -> dict:
    """The result of a dry run; its table's joints bring the gripper to where the table has it."""
    result = ExecutePlan(branch_folder=folder, name="path", cell=cell_file(cell, tmp_path)).run()
    table = np.genfromtxt(folder / "executions" / "path-preview.csv", delimiter=",", names=True)
    joints = np.column_stack([table[f"q{number}_rad"] for number in range(1, 7)])
    assert cell.grasp_frames(cell.arm.forward(joints))[:, :3, 3].T == pytest.approx(
        np.array([table["x_m"], table["y_m"], table["z_m"]]), abs=1e-6)
    assert result["armed"] is False and result["robot"] == cell.arm.name
    return result
