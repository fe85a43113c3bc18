"""The branch in the virtual gripper: its stiffness by differences, its force by statics."""

import itertools
import time
import zlib
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.cell.cell_file import Cell
from limber.cli.virtual_camera import scanned, views_around
from limber.core.numerics.rigid import inverted, matrices
from limber.geometry.cloud.camera import Camera, depth_to_cloud
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import BranchModel, Grasp, solve_static
from limber.mechanics.sensitivities import grasp_slopes
from limber.robot.virtual.branch_solver import BranchSetting, BranchSolver
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.gripped_branch import HeldBranch
from limber.robot.virtual.launch import VirtualRobot

TIP = np.array([0.0, 0.0, 0.3])


@pytest.fixture(scope="module")
def beam():
    """A square beam of 10 mm, 0.32 m long, upright."""
    mesh = box_mesh((0.010, 0.010, 0.32), (1, 1, 24))
    count = mesh.tet_count
    return mesh.with_data(cell_data={"young": np.full(count, 5e7), "poisson": np.full(count, 0.3),
                                     "density": np.full(count, 900.0)})


@pytest.fixture(scope="module")
def setting(beam, tmp_path_factory) -> BranchSetting:
    """The home pose of a UR5e holds its gripper at the beam's tip."""
    path = tmp_path_factory.mktemp("truth") / "beam.vtu"
    middle = beam.nodes[:, :2].mean(axis=0)
    beam.write(path)
    grasp = (0.0, 0.0, 0.15, 0.0, 0.0, 0.0)
    gripper = Controller("ur5e").flange @ matrices(np.array(grasp))
    base = np.zeros(6)
    base[:3] = np.r_[middle, TIP[2]] - gripper[:3, 3]
    point = (float(middle[0]), float(middle[1]), 0.2)
    return BranchSetting(path, tuple(base), grasp, points=(point,), compliance=0.0)


def test_a_true_modulus_swings_between_the_control_points(beam, tmp_path):
    """It keeps to what is given at them and is off by turns between them."""
    places = np.array([[0.005, 0.005, z] for z in (0.05, 0.15, 0.25)])
    axis = SimpleNamespace(nodes=np.array([[0, 0, 0], [0, 0, 0.32]]), main_path=lambda: [0, 1])
    truth = SimpleNamespace(mesh=beam, control_points=places, young=[8e7, 4e7, 2e7],
                            skeleton=axis, gravity=(0.0, 0.0, 0.0))
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0,) * 6})
    young = []
    for wave in (0.0, 0.2):
        BranchSetting.of_truth(truth, cell, tmp_path / "truth.vtu", wave=wave)
        young.append(TetMesh.read(tmp_path / "truth.vtu").cell_data["young"])
    swing = np.log(young[1] / young[0])
    heights = beam.centroids[:, 2]
    assert np.abs(swing).max() < 0.21
    for place, least, most in ((0.05, -0.05, 0.05), (0.1, 0.1, 0.2), (0.15, -0.05, 0.05),
                               (0.2, -0.2, -0.1), (0.25, -0.05, 0.05)):
        near = swing[np.abs(heights - place) < 0.006]
        assert len(near) and least < near.mean() < most


def model_of(beam) -> BranchModel:
    data = beam.cell_data
    return BranchModel(beam, young=data["young"], poisson=data["poisson"], density=data["density"],
                       gravity=(0.0, 0.0, 0.0))


def test_stiffness_is_the_slope_of_the_wrench(beam):
    """Against central differences, at a bent and turned pose."""
    from scipy.spatial.transform import Rotation

    model = model_of(beam)
    middle = np.r_[beam.nodes[:, :2].mean(axis=0), TIP[2]]
    grasp = Grasp.at(beam, middle, 0.012)
    pose = grasp.rest_pose + [0.04, 0.02, -0.005, 0.05, 0.1, 0.02]
    bent = solve_static(model, grasp=grasp, pose=pose).require()
    stiffness = grasp_slopes(model, grasp, bent.displacement).wrench
    for k in range(6):
        step = 1e-5
        wrenches = []
        for sign in (-1, 1):
            moved = pose.copy()
            if k < 3:
                moved[k] += sign * step
            else:
                turn = Rotation.from_rotvec(sign * step * np.eye(3)[k - 3])
                moved[3:] = (turn * Rotation.from_rotvec(pose[3:])).as_rotvec()
            result = solve_static(model, grasp=grasp, pose=moved, start=bent.displacement).require()
            wrenches.append(np.r_[result.reaction_force, result.reaction_torque])
        slope = (wrenches[1] - wrenches[0]) / (2 * step)
        assert stiffness[:, k] == pytest.approx(slope, abs=2e-3 * np.abs(stiffness[:, k]).max())


def on_an_arc(beam, way: float) -> np.ndarray:
    """The frame of the tip of a branch that turns as it goes by ``way`` [m], shape [4, 4]."""
    angle = way / 0.25
    place = matrices(np.array([0, 0, 0, -angle, 0, 0]))
    middle = np.r_[beam.nodes[:, :2].mean(axis=0), TIP[2]]
    place[:3, 3] = middle + 0.25 * np.array([0, np.sin(angle), np.cos(angle) - 1])
    return place


def test_a_solution_leads_along_the_bend_of_the_branch(setting, beam):
    """8 mm on, where the branch is stiff along itself: with how its stiffness changed since the
    solution before, or when the gripper closed, at most a fifth of the tangent's error is left."""
    solver, frame = BranchSolver(setting), partial(on_an_arc, beam)
    middle = frame(0.0)[:3, 3]
    solver.grasp(middle)
    tried = solver.tried()
    before, at = solver.solve(frame(0.004)), solver.solve(frame(0.010))
    true = solver.solve(frame(0.018)).wrench
    errors = []
    both = tuple(map(np.concatenate, zip(at.bend_from(before), tried, strict=True)))
    for known in (at.bends, both, tried):
        at.bends = known
        errors.append(np.linalg.norm(at.wrench_at(frame(0.018), 0.0)[:3] - true[:3]))
    assert errors[0] > 0.3 and max(errors[1:]) < 0.2 * errors[0]


def test_a_slow_robot_is_led_by_a_solution_farther_back(setting, beam):
    """Solutions 1 mm apart tell too little of how the stiffness changes: two of them do."""
    solver, frame = BranchSolver(setting), partial(on_an_arc, beam)
    solver.grasp(frame(0.0)[:3, 3])
    past = [solver.solve(frame(0.001 * k)) for k in range(10, 6, -1)]
    at = solver.solve(frame(0.011))
    at.add_predictions(past, (np.zeros((0, 3)), np.zeros((0, 6, 6))))
    assert 0.002 < np.linalg.norm(at.bends[0][0]) < 0.0031


@pytest.fixture(scope="module")
def holder(setting):
    """A solver's process that the tests share: its start takes longer than most of them."""
    branch = HeldBranch(setting)
    yield branch
    branch.close()


@pytest.fixture
def held(holder, setting):
    """A gripper that holds nothing."""
    yield holder
    holder.setting = setting
    holder.release()


def closed(held, flange) -> str:
    """Close the gripper and wait for what it holds."""
    held.grasp()
    for _ in range(200):
        held.wrench(flange, 0.002)
        if held.state != "closing":
            break
        held._pipe.poll(0.1)
    return held.state


def settled(held, flange) -> None:
    """Stand still until the branch is solved there, and nothing more is asked."""
    for _ in range(10):
        # Its speed dies down first: else it would be solved where the gripper does not go.
        held.wrench(flange, 0.05)
    for _ in range(20):
        was_busy = held._busy
        if was_busy:
            held._pipe.poll(5.0)
        held.wrench(flange, 0.05)
        # An answer of another kind came in a step that asks for nothing; the next one does.
        if not was_busy and not held._busy:
            return
    raise AssertionError("the branch was solved again and again")


def pulled_aside(held, flange):
    """Move the flange by 10 mm in a second and wait for the branch; where it is then."""
    moved = flange.copy()
    for part in np.linspace(0, 1, 20):
        moved[1, 3] = flange[1, 3] + 0.01 * part
        held.wrench(moved, 0.05)
    settled(held, moved)
    return moved


@pytest.mark.slow
def test_the_flange_feels_the_reaction_of_statics(held, setting, beam):
    """After a way of 30 mm the wrench at the flange is that of an own solution there."""
    flange = Controller("ur5e").flange
    assert held.wrench(flange, 0.002) == pytest.approx(np.zeros(6))
    closed(held, flange)
    assert held.wrench(flange, 0.002) == pytest.approx(np.zeros(6), abs=1e-6)
    moved = flange.copy()
    for part in np.linspace(0, 1, 40):
        moved[:3, 3] = flange[:3, 3] + part * np.array([0.0, 0.03, 0.0])
        held.wrench(moved, 0.002)
    for _ in range(200):
        felt = held.wrench(moved, 0.002)
        if np.allclose(held._solution.frame[:3, 3], (held._gripper @ held._offset)[:3, 3]):
            break
        held._pipe.poll(0.05)
    for _ in range(400):
        # What was left of the way from one solution to the next dies down.
        felt = held.wrench(moved, 0.002)
    model = model_of(beam)
    base = matrices(np.array(setting.base_pose))
    gripper = base @ moved @ matrices(np.array(setting.grasp_pose))
    grasp = Grasp.gripping(beam, np.array([*beam.nodes[:, :2].mean(axis=0), TIP[2]]), setting.jaw)
    pose = grasp.rest_pose + [0, 0.03, 0, 0, 0, 0]
    result = solve_static(model.gripped(grasp), grasp=grasp, pose=pose).require()
    # By hand: the opposite wrench, taken to the flange and its axes.
    rotation = (base @ moved)[:3, :3]
    force = -rotation.T @ result.reaction_force
    lever = inverted(base @ moved) @ np.r_[pose[:3], 1.0]
    torque = -rotation.T @ result.reaction_torque + np.cross(lever[:3], force)
    assert felt == pytest.approx(np.r_[force, torque], rel=1e-4, abs=1e-5)
    assert np.linalg.norm(result.reaction_force) > 0.5
    assert gripper[:3, 3] == pytest.approx(pose[:3], abs=2e-3)
    assert held.points[0, 1] > held.rest_points[0, 1] + 0.01
    held.lose("broken")
    assert held.wrench(moved, 0.002) == pytest.approx(np.zeros(6))


def test_the_camera_sees_the_bent_branch(held, beam):
    """Between solutions it takes a picture: at rest the beam's own surface, then one moved."""
    flange = Controller("ur5e").flange
    middle = np.r_[beam.nodes[:, :2].mean(axis=0), 0.16]
    camera = Camera(width=120, height=160, fx=200.0, fy=200.0, cx=60.0, cy=80.0).looking(
        eye=middle + [0.5, 0.0, 0.0], target=middle)

    def picture(at) -> np.ndarray:
        held.look(camera.model_dump())
        for _ in range(200):
            held.wrench(at, 0.002)
            if held.picture is not None:
                break
            held._pipe.poll(0.05)
        steps = np.frombuffer(zlib.decompress(held.picture), "<u2").reshape(160, 120)
        return steps / camera.depth_scale

    still = depth_to_cloud(camera, picture(flange), None).points
    # The near side of a beam of 10 mm; few pixels fly off.
    off = np.abs(still[:, 0] - beam.nodes[:, 0].max())
    assert len(still) > 300 and np.median(off) < 1e-3
    assert closed(held, flange) == "held"
    moved = flange.copy()
    for part in np.linspace(0, 0.03, 40):
        moved[1, 3] = flange[1, 3] + part
        held.wrench(moved, 0.002)
        held._pipe.poll(0.05)
    bent = depth_to_cloud(camera, picture(moved), None).points
    top = bent[bent[:, 2] > 0.29]
    assert np.median(top[:, 1]) - middle[1] == pytest.approx(0.03, abs=6e-3)


def test_views_stand_around_and_look_at_the_middle():
    middle = np.array([0.1, -0.2, 0.4])
    for camera in views_around(middle, 0.6, 6):
        assert np.linalg.norm(camera.origin - middle) == pytest.approx(0.6)
        assert camera.to_camera(middle[None])[0] == pytest.approx([0, 0, 0.6], abs=1e-12)


def test_sliding_in_the_grip_lets_the_force_fall(held):
    flange = Controller("ur5e").flange
    held.wrench(flange, 0.002)
    assert closed(held, flange) == "held"
    moved = pulled_aside(held, flange)
    before = np.linalg.norm(held.wrench(moved, 0.002)[:3])
    held.slide(0.5)
    after = np.linalg.norm(held.wrench(moved, 0.002)[:3])
    assert 0.3 * before < after < 0.7 * before


def test_a_picture_that_comes_between_two_questions_is_not_lost(held, monkeypatch):
    """It was thrown away as a late solution, one scan in ten, and the camera waited for ever."""
    flange, asked = Controller("ur5e").flange, itertools.count()
    pipe = held._pipe
    monkeypatch.setattr(held, "_pipe", SimpleNamespace(
        send=pipe.send, recv=pipe.recv, poll=lambda: next(asked) % 2 == 1 and pipe.poll(5.0),
        close=pipe.close))
    camera = Camera(width=120, height=160, fx=200.0, fy=200.0, cx=60.0, cy=80.0).looking(
        eye=np.array([0.5, 0.0, 0.1]), target=np.array([0.0, 0.0, 0.1]))
    held.look(camera.model_dump())
    for _ in range(4):
        held.wrench(flange, 0.002)
    assert held.picture is not None


def test_what_gives_way_is_in_series_with_the_branch(held):
    """A wrench F at compliance C is that of the branch C F nearer to its rest."""
    flange = Controller("ur5e").flange
    held.wrench(flange, 0.002)
    assert closed(held, flange) == "held"
    solution, patch = held._solution, held._gripper @ held._offset
    patch = patch.copy()
    patch[:3, 3] += [0.001, -0.002, 0.0005]
    felt = solution.wrench_at(patch, 1e-4)
    back = patch.copy()
    back[:3, 3] -= 1e-4 * felt[:3]
    assert felt == pytest.approx(solution.wrench_at(back, 0.0), rel=1e-4, abs=1e-6)
    assert np.linalg.norm(felt) < np.linalg.norm(solution.wrench_at(patch, 0.0))


def test_what_is_seen_stays_behind_by_what_gives_way(held):
    """Solved with the piece C F behind the gripper, the points are seen where they were solved."""
    flange = Controller("ur5e").flange
    held.setting = replace(held.setting, compliance=1e-2)
    held.wrench(flange, 0.002)
    assert closed(held, flange) == "held"
    pulled_aside(held, flange)
    solution = held._solution
    behind = (held._gripper @ held._offset)[:3, 3] - solution.frame[:3, 3]
    assert behind == pytest.approx(1e-2 * solution.wrench[:3], abs=5e-5)
    assert np.linalg.norm(behind) > 5e-4
    assert held.points == pytest.approx(solution.points, abs=1e-4)


def test_closing_on_nothing_is_told(held):
    far = Controller("ur5e").flange.copy()
    far[2, 3] += 0.3
    held.wrench(far, 0.002)
    assert closed(held, far) == "empty"
    assert held.wrench(far, 0.002) == pytest.approx(np.zeros(6))


def soon(robot, holds) -> dict:
    """The robot's first state for which it holds; within 10 s."""
    end = time.monotonic() + 10
    while not holds(state := robot.state):
        assert time.monotonic() < end, state
        time.sleep(0.02)
    return state


@pytest.mark.slow
def test_the_real_client_feels_the_branch(setting, own_address):
    """Closed by a digital output, pulled by servoL, felt in the TCP force, opened again."""
    rtde_control = pytest.importorskip("rtde_control")
    import rtde_io
    import rtde_receive

    with VirtualRobot("ur5e", own_address, setting) as robot:
        receive = rtde_receive.RTDEReceiveInterface(own_address)
        control = rtde_control.RTDEControlInterface(own_address)
        io = rtde_io.RTDEIOInterface(own_address)
        try:
            empty = np.mean([receive.getActualTCPForce() for _ in range(40)
                             if time.sleep(0.005) is None], axis=0)
            assert io.setStandardDigitalOut(0, True)
            soon(robot, lambda state: state["branch"] == "held")
            start = receive.getActualTCPPose()
            for part in np.linspace(0, 1, 75):
                assert control.servoL([start[0], start[1] + 0.03 * part, *start[2:]], 0.1, 0.1,
                                      0.008, 0.1, 600)
                time.sleep(0.008)
            # It stands, and nothing is solved any more.
            state = soon(robot, lambda state: state["solution_age_s"] > 0.2)
            force = np.mean([receive.getActualTCPForce() for _ in range(20)
                             if time.sleep(0.005) is None], axis=0)
            # The branch pulls back; the robot's base is not turned against the branch here.
            felt = state["sensor_gain"] * np.array(state["true_wrench"])[:3]
            force = force - empty
            assert force[:3] == pytest.approx(-felt, abs=0.3)
            assert abs(force[1]) > 0.5 and state["solve_s"] < 1.0
            assert io.setStandardDigitalOut(0, False)
            soon(robot, lambda state: state["branch"] == "free")
            time.sleep(0.1)
            assert np.linalg.norm(receive.getActualTCPForce()[:3] - empty[:3]) < 1.5
            # Seen from four sides over its own port: points of the beam's surface, all around.
            data = TetMesh.read(setting.mesh)
            middle = data.nodes.mean(axis=0)
            points = scanned(own_address, views_around(middle, 0.5, 4))
            off = np.abs(points[:, :2] - middle[:2]).max(axis=1) - 0.005
            assert len(points) > 3000 and np.median(np.abs(off)) < 1.5e-3
            assert np.ptp(points[:, 2]) == pytest.approx(np.ptp(data.nodes[:, 2]), abs=0.02)
        finally:
            io.disconnect()
            control.disconnect()
            receive.disconnect()
