"""The closed loop's own parts; the whole of it takes minutes and is a row of `scripts/bench robot`.
"""

from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.cell.known_arms import arm_named
from limber.cli import main
from limber.cli.closed_loop import loop
from limber.cli.closed_loop.cell_layout import (
    base_beside,
    bending_modulus,
    gripper_at,
    write_touched,
)
from limber.cli.closed_loop.comparison import Planned, Watch, compared, comparison
from limber.cli.closed_loop.loop import ClosedLoop
from limber.cli.commands.robot.calibrate import _points
from limber.core.errors import InputError, NoPathError, SafetyStop, WorkError
from limber.core.numerics.rigid import matrices
from limber.core.progress import Progress
from limber.geometry.skeleton.skeleton import Skeleton
from limber.planning.path_problem import UNPROVEN
from limber.robot.calibration import fit_base

TOOL = (0.0, 0.0, 0.15, 0.0, 0.0, 0.0)


def test_the_bending_modulus_is_the_cantilevers():
    """F L^3 / (3 E I) of a round rod, held at three quarters of it."""
    nodes = np.zeros((41, 3))
    nodes[:, 2] = np.linspace(0, 0.4, 41)
    rod = Skeleton.from_edges(nodes, np.arange(41) - 1, np.full(41, 0.005))
    young = bending_modulus(rod, 0.75, 6.0, 0.04)
    moment = np.pi / 4 * 0.005**4
    assert 6.0 * 0.3**3 / (3 * young * moment) == pytest.approx(0.04, rel=1e-4)


@pytest.mark.slow
def test_the_arm_stands_beside_the_branch_and_its_gripper_on_it():
    point, axis = np.array([0.05, -0.02, 0.34]), np.array([0.2, -0.1, 0.97])
    arm = arm_named("ur5e")
    base = base_beside(arm, matrices(np.array(TOOL)), point, axis)
    assert base[3:5] == pytest.approx([0, 0]), "it stands upright"
    cell = Cell(robot={"model": "ur5e"}, base={"pose": tuple(base)}, tool={"grasp_pose": TOOL})
    joints, rotation = gripper_at(cell, point, axis)
    grasp = cell.grasp_frames(arm.forward(joints))
    assert grasp == pytest.approx(matrices(np.r_[point, rotation]), abs=1e-9)
    away = cell.model_copy(update={"base": cell.base.model_copy(
        update={"pose": (3.0, 0, 0, 0, 0, 0)})})
    with pytest.raises(NoPathError, match="cannot reach"):
        gripper_at(away, point, axis)


def test_touched_marks_tell_where_the_base_stands(tmp_path):
    base, moved = np.array([0.6, -0.2, 0.1, 0, 0, 1.2]), np.array([0.01, 0.0, -0.02])
    on_axis = np.array([[0.02, 0.01, 0.2], [0.05, 0.0, 0.35]])
    write_touched(tmp_path / "touched.csv", base, moved, on_axis, 1e-4, np.random.default_rng(2))
    names, on_branch, touched = _points(tmp_path / "touched.csv")
    assert names[0] == "rim-1" and names[-1] == "branch-2"
    fit = fit_base(touched, on_branch)
    # Known best where it was touched, farther off by what the turn is off.
    middle = np.r_[touched.mean(axis=0), 1.0]
    off = matrices(fit.pose) @ middle - (matrices(base) @ middle + np.r_[moved, 0])
    assert np.linalg.norm(off) < 3e-4
    assert np.abs(fit.pose[3:] - base[3:]).max() < 3e-3


@pytest.mark.parametrize("proven", [False, True])
def test_more_poses_are_sampled_where_a_path_is_neither_found_nor_excluded(
        proven, monkeypatch, tmp_path):
    """As the planner advises, once; where it has proven that there is none the loop ends."""
    wish = SimpleNamespace(target=np.zeros(3), sampled_deflection=0.1, max_force=9.0,
                           limited=lambda cell: cell)
    for name, value in (("Branch", SimpleNamespace(open=lambda _folder: None)),
                        ("load_skeleton", lambda _branch: None),
                        ("grasp_of", lambda *_: (np.array([0.0, 0.0, 0.3]), np.eye(3)[2])),
                        ("wish_for", lambda *_: wish), ("read_cell", lambda _path: None),
                        ("write_cell", lambda *_: None)):
        monkeypatch.setattr(loop, name, value)
    parts = []

    def part(_self, name, _title, *arguments):
        parts.append((name, "--samples" in arguments))
        if parts.count(("plan", False)) == 1 and name == "plan":
            raise WorkError("No path: none exists." if proven else f"None, {UNPROVEN}.")
        return {}

    monkeypatch.setattr(ClosedLoop, "_part", part)
    if proven:
        with pytest.raises(WorkError, match="none exists"):
            ClosedLoop(tmp_path)._planned()
        assert [name for name, _ in parts] == ["estimate", "energy", "plan"]
    else:
        assert ClosedLoop(tmp_path)._planned().goal is wish.target
        assert parts == [("estimate", False), ("energy", False), ("plan", False),
                         ("energy", True), ("plan", False)]


class Beside:
    """A robot whose states are told one after the other."""

    def __init__(self, states):
        self._states, self._last = iter(states), states[-1]
        self.asked: list[str] = []

    @property
    def state(self):
        return next(self._states, self._last)

    def ask(self, action, **_values):
        self.asked.append(action)
        return self._last


def told(branch, place, speed=0.0, flower=0.0):
    return {"branch": branch, "flange": [place, 0, 0], "tool_speed": [speed] + [0] * 5,
            "points": [[0, 0, 0], [flower, 0, 0.4]], "extrapolation_error_n": 0.1 * flower}


def test_the_flower_is_where_it_was_held_still_farthest_away():
    states = [told("free", 0.0), told("held", 0.1), told("held", 0.12, 0.03, 0.02),
              told("held", 0.15, 0.0, 0.05), told("held", 0.15, 0.0, 0.06),
              told("held", 0.12, 0.03, 0.02), told("held", 0.1), told("free", 0.1)]
    watch = Watch(Beside(states))
    assert watch.at_the_end() is None
    watch.states = states
    assert watch.at_the_end()[-1] == pytest.approx([0.055, 0, 0.4])
    assert watch.extrapolation_error == pytest.approx(0.006)


def test_the_overload_comes_while_the_branch_is_led_and_is_taken_away():
    states = [told("held", 0.0), told("held", 0.01, 0.03), told("held", 0.02, 0.03),
              told("held", 0.021, 0.03), told("held", 0.022)]
    robot = Beside(states)
    with Watch(robot, overload=np.array([0, 0, 60.0, 0, 0, 0])) as watch:
        for _ in range(200):
            if watch.overloaded is not None:
                break
            watch._ended.wait(0.02)
    assert robot.asked == ["added_wrench", "added_wrench"]
    assert watch.overloaded.travel == pytest.approx(0.0)


def test_a_loop_writes_over_nothing(tmp_path):
    (tmp_path / "loop.branch").mkdir()
    with pytest.raises(InputError, match="already exists"):
        ClosedLoop(tmp_path).run()


def test_the_demo_takes_a_scan_or_a_robot(tmp_path):
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n")
    assert main.call(["demo", str(scan), "--robot"]) == 2


def test_an_estimate_at_other_control_points_is_compared_with_the_truth_there():
    """The truth's moduli are arrays; two control points lie on its own first and last."""
    truth = SimpleNamespace(young=np.array([4e9, 3e9, 2e9, 1e9]), fractions=(0.2, 0.4, 0.6, 0.8))
    estimated = {"young_pa": [4.1e9, 2e9], "young_interval_pa": [[3.5e9, 4.5e9], [2e9, 3e9]],
                 "fractions": [0.2, 0.8]}
    watch = SimpleNamespace(at_the_end=lambda: None, extrapolation_error=0.0, overloaded=None)
    planned = Planned(estimated, np.zeros(3), SimpleNamespace(holding_force=1.0, max_force=2.0), {})
    found = compared(truth, np.zeros(3), planned, defaultdict(float), watch, ("", watch), 10.0)
    assert found["young_true_pa"] == pytest.approx([4e9, 1e9], rel=1e-6)
    assert found["covered"] == [True, False]


def test_what_is_compared_fits_a_terminal():
    result = {"young_pa": [1e9], "young_interval_pa": [[8e8, 1.2e9]], "young_true_pa": [1.1e9],
              "predicted_peak_force_n": 6.0, "peak_force_n": 6.1, "force_within_share": 0.97,
              "force_error_of_peak": 0.03, "extrapolation_error_n": 0.1,
              "flower_goal_m": [0.1, 0, 0.4], "flower_planned_m": None, "flower_m": [0.1, 0, 0.4],
              "overload_way_m": 0.002, "overload_standstill_s": 0.08, "overload_reason": "limit",
              "pull_count": 2, "open_factor": 2.61, "no_further_pull": "enough for this plan",
              "holding_force_n": 4.2, "max_force_n": 8.4}
    tables = dict(comparison(result))
    assert tables["Young's modulus"][1][-1] == "yes"
    assert ["pulls", "2"] in tables["Sufficient?"]
    assert ["distance after it", "2.0 mm"] in tables["Safety"]
    assert [row[0] for row in tables["The flower"]] == ["", "flower's goal", "final position"]


def test_a_stop_tells_how_long_the_virtual_robot_was_held_up(tmp_path, monkeypatch):
    """A real controller never is: what stopped the arm may have been that."""
    class Robot:
        process = SimpleNamespace(poll=lambda: None)

        def __init__(self, *_arguments, **_settings):
            self.state = {"lost_seconds": 0.072}

        def __enter__(self):
            return self

        def __exit__(self, *_exception):
            pass

    def stopped(*_arguments):
        raise SafetyStop("no data from the robot")

    warned = []
    progress = Progress()
    monkeypatch.setattr(progress, "warn", warned.append)
    monkeypatch.setattr("limber.cli.closed_loop.loop.VirtualRobot", Robot)
    for name in ("_grown", "_cell", "_setting"):
        monkeypatch.setattr(ClosedLoop, name, lambda *_: None)
    monkeypatch.setattr(ClosedLoop, "_reconstructed", stopped)
    with pytest.raises(SafetyStop, match="no data"):
        ClosedLoop(tmp_path / "loop", progress=progress).run()
    assert warned == ["stopped; until then the virtual robot itself was delayed by 72 ms in total."]


@pytest.mark.parametrize("reason", ["hard force limit [N]", None])
def test_a_stop_before_the_overload_is_not_taken_for_its_work(tmp_path, monkeypatch, reason):
    """The branch folder then still holds the result of the way before, which nothing stopped."""
    around = ClosedLoop(tmp_path)

    def stopped(*_arguments):
        raise SafetyStop("no data from the robot")

    class Watching:
        def __init__(self, *_arguments, **_options):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_exception):
            pass

    told = SimpleNamespace(result={"stop_reason": reason})
    monkeypatch.setattr(around, "_part", stopped)
    monkeypatch.setattr(around, "_armed", lambda executed: [])
    monkeypatch.setattr(loop, "Watch", Watching)
    monkeypatch.setattr(loop, "read_cell", lambda file: SimpleNamespace(
        limits=SimpleNamespace(hard_force_n=30.0)))
    monkeypatch.setattr(loop.Branch, "open", lambda folder: SimpleNamespace(
        manifest=SimpleNamespace(stages={f"execute:{loop.PLAN}": told})))
    robot = SimpleNamespace(ask=lambda *_arguments, **_values: {})
    if reason is None:
        with pytest.raises(SafetyStop, match="no data"):
            around._overloaded(robot, {"start_joints_rad": []})
    else:
        assert around._overloaded(robot, {"start_joints_rad": []})[0] == reason
