"""Slips of frame, clock, markers and unit are named at import; clean pulls raise no word.

Pulls are those of a rod, which shares no code with the beam that judges them.
"""

import re
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from limber.core.alignment import Alignment
from limber.core.errors import InputError
from limber.core.files.tables import write_table
from limber.core.numerics.rigid import rotation_matrix
from limber.core.progress import Progress
from limber.estimation.forward.observed_path import MotionWanted
from limber.estimation.rod import Rod, RodMotion
from limber.geometry.skeleton.skeleton import Skeleton, control_points
from limber.recordings.import_request import BranchFrame, ImportRequest
from limber.recordings.importing import import_recording
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS, read_pull
from limber.recordings.settings import ImportSpec
from limber.recordings.slips import AXES, Cantilever, slips_of

TURN = rotation_matrix(np.array([0.3, 1.0, 0.2]))
SCAN = Alignment(origin=(0.2, -0.1, 0.4), rotation=tuple(map(tuple, TURN.tolist())))


@cache
def branch(number: int) -> BranchFrame:
    """Curved axes, one leaning, one lying, one upright; with control points."""
    along = np.linspace(0, 1, 60)[:, None]
    lean = np.array([[0.4, 0.2, 0.9], [0.9, 0.3, -0.1], [0.02, 0.05, 1.0]])[number]
    nodes = (0.4 + 0.2 * number) * along * (lean + 0.2 * along * [-0.5, 1.0, 0.2])
    skeleton = Skeleton.from_edges(nodes, np.arange(-1, 59), np.linspace(7e-3, 4e-3, 60))
    return BranchFrame(SCAN, nodes=nodes, skeleton=skeleton,
                       control_points=control_points(skeleton))


def bent(skeleton: Skeleton, young: float, travel: float, phase: float, count: int) -> RodMotion:
    """The motion of a rod of these axes, pulled by a fraction of its length."""
    rod = Rod.of(skeleton, lambda points: np.full(len(points), young), 0.35, 900.0, np.zeros(3),
                 0.92, as_scanned=True)
    return rod.pulled(MotionWanted(
        kind="pull", point=rod.axis[-1], axis=rod.axis[-1], travel=travel * rod.along[-1],
        turn=2.0, phase=phase, times=np.linspace(0, 1, count), weight=np.zeros(3)))


@cache
def pulled(number: int, young: float = 5e8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [s], gripper's poses and wrenches [n, 12], and markers [n, 4, 3], with noise; out and
    partly round, at rest first."""
    frame = branch(number)
    made = bent(frame.skeleton, young, 0.2, 1.0 + number, 25)
    times = np.linspace(0.0, 8.0, 161)
    # Slower at first: a start by which clocks are told.
    at = np.clip((times - 1.0) / 6.0, 0, 1)**1.5 * 24
    rng = np.random.default_rng(number)

    def course(values):
        flat = values.reshape(len(values), -1)
        return CubicSpline(np.arange(25), flat)(at)
    robot = course(np.hstack([made.poses, made.wrenches]))
    peak = np.abs(robot[:, 6:9]).max()
    robot[:, 6:9] += 0.01 * peak * rng.standard_normal((len(times), 3))
    seen = course(made.seen(frame.control_points))
    return times, robot, seen.reshape(-1, 4, 3) + 5e-4 * rng.standard_normal((len(times), 4, 3))


CASES = [(part, case) for part, cases in tomllib.loads(
    Path(__file__).with_name("slips.toml").read_text(encoding="utf-8")).items() for case in cases]
COLUMNS = {"place": slice(0, 3), "turn": slice(3, 6), "force": slice(6, 9)}


def slipped(part, case, times, robot, at, markers):
    """The parts of a pull with a slip of slips.toml."""
    parts = {"times": times, "robot": robot, "seen": at, "markers": markers}
    name = case.get("axes")
    if "started" in case:
        # Both tables count from zero, but the markers' began later.
        parts["seen"] = times[:-1]
        parts["markers"] = CubicSpline(at, markers)(np.clip(times[:-1] + case["started"], at[0],
                                                            at[-1]))
    elif name == "tool":
        # The gripper holds the branch askew.
        held = Rotation.from_rotvec(robot[:, 3:6]) * Rotation.from_rotvec([2.2, -1.0, 0.4])
        robot[:, 3:6], robot[:, 6:9] = held.as_rotvec(), held.apply(robot[:, 6:9], inverse=True)
    elif "order" in case:
        markers[case.get("from", 0):] = markers[case.get("from", 0):, case["order"]]
    else:
        values = robot[:, COLUMNS[part]] if part in COLUMNS else parts[part]
        turn = None if name is None else TURN if name == "scan" else AXES[name]
        values[...] = (case.get("factor", 1.0) * values + case.get("offset", 0.0)
                       if turn is None else values @ turn)
    return list(parts.values())


def imported(folder, number, part="", case=None, **settings):
    """Import the tables with a slip; the warnings, and what was written."""
    times, robot, seen = (part.copy() for part in pulled(number))
    at = times[:-1] + 0.0137
    parts = (times, robot, at, CubicSpline(times, seen)(at))
    times, robot, at, markers = slipped(part, case, *parts) if case else parts
    titles = [title.removesuffix("_n") if case and case.get("untitled") else title
              for title in POSE_COLUMNS + WRENCH_COLUMNS]
    write_table(folder / "robot.csv", ("t_s", *titles), np.column_stack([times, robot]))
    write_table(folder / "markers.csv", ("t_s", *(f"m{k}_{a}_m" for k in range(4) for a in "xyz")),
                np.column_stack([at, markers.reshape(len(at), -1)]))
    (folder / "pull.toml").write_text("[calibration]\nforce_drift_sigma_n = 0.1\n")
    heard: list[str] = []
    spec = ImportSpec(
        robot=folder / "robot.csv", pull_toml=folder / "pull.toml", grasp_mode="point",
        force_sigma=0.05, grasp_point=tuple(branch(number).skeleton.point_at(0.92).tolist()),
        **settings)
    import_recording("markers", ImportRequest(
        folder / "markers.csv", folder / "p", "p", spec, branch(number),
        progress=Progress().keeping(heard, silently=True)))
    return heard, read_pull(folder / "p")


@pytest.mark.parametrize(("part", "case"), CASES)
def test_a_slip_is_named_with_its_remedy(tmp_path, part, case):
    try:
        said = " ".join(imported(tmp_path, case["pull"], part, case)[0])
    except InputError as error:
        said = str(error)
    assert re.search(case.get("told", f"--force-frame {case.get('axes')}"), said), said


@pytest.mark.parametrize("number", range(3))
def test_a_clean_pull_is_taken_as_it_is(tmp_path, number):
    """With equal stamps too."""
    for case in (None, {"started": 0.0}):
        heard, pull = imported(tmp_path, number, "seen", case)
        assert len(heard) == 1 and "clock" in heard[0]
        assert np.allclose(pull.wrenches[:, :3], pulled(number)[1][:, 6:9], atol=1e-6)


def test_a_beam_bent_far_goes_where_a_rod_goes():
    """Its end comes nearer to the base, which a small rotation alone does not say: 22 % off."""
    made = bent(branch(0).skeleton, 5e8, 0.35, 1.0, 5)
    beam = Cantilever.of(branch(0).skeleton, branch(0).skeleton.point_at(0.92))
    went = made.seen(beam.middles) - beam.middles
    off = np.linalg.norm(went - beam.bent(made.poses[:, :3])[1], axis=2).max()
    assert off < 0.02 * np.linalg.norm(went, axis=2).max()


@pytest.mark.parametrize(("number", "case", "remedy"), [
    (0, {"axes": "tool"}, {"force_frame": "tool"}), (0, CASES[0][1], {"force_frame": "y,-x,z"}),
    (1, {"axes": "scan"}, {"force_frame": "scan"}), (2, {"started": 0.5}, {"time_offset": 0.5})])
def test_the_remedy_puts_it_right(tmp_path, number, case, remedy):
    heard, pull = imported(tmp_path, number, "force", case, **remedy)
    assert not [each for each in heard if "would fit" in each]
    assert np.allclose(pull.wrenches[:, :3], pulled(number)[1][:, 6:9], atol=1e-6)


def test_what_the_user_states_is_believed(tmp_path):
    """The force's frame, though another fits better; slips of a branch's own pulls are told."""
    _, pull = imported(tmp_path, 0, *CASES[0], force_frame="poses")
    told = slips_of(pull, branch(0).skeleton)
    assert len(told) == 1 and "--force-frame y,-x,z" in told[0]
    assert not slips_of(replace(pull, wrenches=pulled(0)[1][:, 6:]), branch(0).skeleton)
