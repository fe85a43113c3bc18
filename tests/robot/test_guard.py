"""The guard as a state machine: every fault stops it, nothing starts it again by itself."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from limber.cell.cell_file import LimitsEntry, WorkspaceEntry
from limber.cell.ur_arms import ARMS
from limber.core.errors import SafetyStop
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot.driver.guard import Guard, GuardSettings, State, Verdict
from limber.robot.interface import Sample

ARM = ARMS["ur5e"]
JOINTS = np.array([0.1, -1.57, 1.57, -1.57, -1.57, 0.0])
LIMITS = LimitsEntry(soft_force_n=10, hard_force_n=20, hard_torque_nm=3, unexpected_force_n=3)
BOX = WorkspaceEntry(low_m=(-0.5, -0.5, 0), high_m=(0.5, 0.5, 1))
INSIDE = np.array([0.0, 0.0, 0.5])


class Bench:
    """A guard and a stream of good samples with a little noise."""

    def __init__(self, rate: float = 500.0, **changes):
        self.guard = Guard(ARM, GuardSettings(LIMITS, ARM.joint_limits, BOX, **changes), rate)
        self.guard.tared()
        self.rng = np.random.default_rng(1)
        self.step, self.clock = 1 / rate, 10.0

    def sample(self, **changes) -> Sample:
        self.clock += self.step
        joints = changes.get("joints", JOINTS)
        pose = pose_vectors(ARM.forward(joints if np.isfinite(joints).all() else JOINTS))
        return replace(Sample(self.clock, self.clock, JOINTS, np.zeros(6), pose, np.zeros(6),
                              np.zeros(6), 7, 1, 2, 1.0), **changes)

    def noise(self) -> np.ndarray:
        return 0.05 * self.rng.standard_normal(6)

    def look(self, force=(0, 0, 0), torque=(0, 0, 0), expected=None, grasp=INSIDE, sent=None,
             uncertainty=None, **changes):
        wrench = np.r_[force, torque].astype(float) + self.noise()
        return self.guard.look(
            self.sample(**changes),
            wrench=wrench,
            raw=np.stack([wrench, wrench]),
            grasp=grasp,
            sent=sent,
            uncertainty=uncertainty,
            expected=None if expected is None else np.r_[expected, 0, 0, 0],
        )

    def run(self, count: int = 30, **changes):
        for _ in range(count):
            decision = self.look(**changes)
            if decision.verdict != Verdict.GO:
                return decision
        return decision


@pytest.fixture
def bench():
    bench = Bench()
    bench.guard.begin()
    assert bench.run().verdict == Verdict.GO
    return bench


ONE_SAMPLE = {
    "force": {"force": (0, 25, 0)}, "torque": {"torque": (0, 0, 4)},
    "infinite force": {"force": (np.inf, 0, 0)},
    "nan force": {"force": (np.nan, 0, 0)}, "nan pose": {"pose": np.full(6, np.nan)},
    "nan joints": {"joints": np.full(6, np.nan)},
    "protective stop": {"safety_mode": 3}, "safeguard": {"safety_mode": 5},
    "emergency stop": {"safety_mode": 7}, "violation": {"safety_mode": 8},
    "power off": {"robot_mode": 3}, "program stopped": {"runtime_state": 1},
    "program paused": {"runtime_state": 4}, "clock forward": {"clock": 99.0},
    "clock back": {"clock": 1.0}, "clock stands": {"clock": None},
    "clock nan": {"clock": np.nan}, "too fast": {"speed": np.array([0.2, 0, 0, 0, 0, 0])},
    "joint limit": {"joints": np.array([6.27, -1.57, 1.57, -1.57, -1.57, 0])},
    "wrist singularity": {"joints": np.array([0.1, -1.57, 1.57, -1.57, 0.01, 0])},
    "elbow singularity": {"joints": np.array([0.1, -1.57, 0.01, -1.57, -1.57, 0])},
    "outside": {"grasp": np.array([0.6, 0, 0.5])},
    "off path": {"sent": np.array([0.4, 0.12, 0.5])},
}


@pytest.mark.parametrize("name", ONE_SAMPLE)
def test_one_bad_sample_stops_and_says_why(bench, name):
    changes = dict(ONE_SAMPLE[name])
    if "clock" in changes and changes["clock"] is None:
        changes["clock"] = bench.clock
    decision = bench.look(**changes)
    assert decision.verdict == Verdict.STOP and decision.reason
    assert bench.guard.state == State.STOPPED and bench.guard.reason == str(decision)


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=() if name in ("force", "protective stop") or "clock" in name
                 else pytest.mark.slow) for name in ONE_SAMPLE])
def test_after_a_stop_nothing_goes_on_by_itself(bench, name):
    """A thousand good samples do not start it; nor does begin or resume; a person does."""
    changes = dict(ONE_SAMPLE[name])
    if "clock" in changes and changes["clock"] is None:
        changes["clock"] = bench.clock
    bench.look(**changes)
    if "clock" not in changes:
        bench.run(1000)
    assert bench.guard.state == State.STOPPED
    for attempt in (bench.guard.begin, bench.guard.resume):
        with pytest.raises(SafetyStop):
            attempt()
    with pytest.raises(SafetyStop):
        bench.guard.permit(np.zeros(6), np.zeros(6), 0.002)
    bench.guard.end()
    assert bench.guard.state == State.STOPPED
    bench.guard.acknowledge()
    assert bench.guard.state == State.IDLE
    bench.guard.begin()
    assert bench.guard.state == State.MOVING


def test_before_the_tare_the_bias_is_no_force_and_nothing_moves():
    guard = Guard(ARM, GuardSettings(LIMITS, ARM.joint_limits, BOX), 500.0)
    bench = Bench()
    bias = np.array([30.0, 0, 0, 0, 0, 0])
    assert guard.look(bench.sample(), wrench=bias, raw=np.stack([bias, bias])).verdict == Verdict.GO
    with pytest.raises(SafetyStop, match="not tared"):
        guard.begin()
    guard.tared()
    assert guard.look(bench.sample(), wrench=bias, raw=np.stack([bias, bias])
                      ).verdict == Verdict.STOP


def test_silence_stops_after_50_ms(bench):
    assert bench.guard.silence(0.049).verdict == Verdict.GO
    assert bench.guard.silence(0.051).verdict == Verdict.STOP


def test_the_soft_limit_pauses_until_a_person_resumes(bench):
    decision = bench.run(force=(12, 0, 0))
    assert decision.verdict == Verdict.PAUSE and bench.guard.state == State.PAUSED
    assert bench.run(200).verdict == Verdict.PAUSE
    with pytest.raises(SafetyStop):
        bench.guard.permit(np.zeros(6), np.zeros(6), 0.002)
    with pytest.raises(SafetyStop):
        bench.guard.begin()
    for force in np.linspace(12, 0, 2000):
        assert bench.look(force=(force, 0, 0)).verdict == Verdict.PAUSE
    bench.guard.resume()
    assert bench.run().verdict == Verdict.GO


def test_a_hard_fault_stops_while_paused(bench):
    bench.run(force=(12, 0, 0))
    assert bench.look(force=(25, 0, 0)).verdict == Verdict.STOP


@pytest.mark.parametrize("wrench, told", [
    ((0, 25, 0, 0, 0, 0), "hard force limit"), ((0, 0, 0, 0, 4, 0), "hard torque limit"),
    ((np.nan, 0, 0, 0, 0, 0), "no number")])
def test_a_force_between_two_samples_stops_by_the_hard_limits(bench, wrench, told):
    assert bench.guard.feel(np.array([0.0, 15, 0, 0, 0, 0])).verdict == Verdict.GO
    decision = bench.guard.feel(np.array(wrench, float))
    assert decision.verdict == Verdict.STOP and told in decision.reason
    assert bench.guard.state == State.STOPPED


@pytest.mark.parametrize("rate", [125.0, 500.0])
@pytest.mark.parametrize("row", [0, 1])
def test_a_frozen_sensor_is_seen_in_its_time(rate, row):
    """Frozen as it came or in the flange's axes: the other one turns with the robot."""
    bench = Bench(rate)
    bench.guard.begin()
    bench.run()
    frozen, begin, verdict = bench.noise(), bench.clock, Verdict.GO
    while verdict == Verdict.GO:
        raw = np.stack([bench.noise(), bench.noise()])
        raw[row] = frozen + 1e-14 * bench.noise()
        verdict = bench.guard.look(bench.sample(), wrench=raw[1 - row], raw=raw).verdict
        assert bench.clock - begin < 0.07
    assert "frozen" in bench.guard.reason


@pytest.mark.parametrize("force, told", [
    ((6.5, 4, 0), "something else pushes"), ((0.1, 0.1, 0), "it slip"),
    ((3.5, 0, 0), "it slip")])
def test_a_force_that_changes_otherwise_than_predicted_stops_long_before_the_limit(force, told):
    """At once, from one that was as predicted."""
    bench = Bench()
    bench.guard.begin()
    assert bench.run(400, force=(6.2, 0, 0), expected=(6.5, 0, 0)).verdict == Verdict.GO
    decision = bench.run(40, force=force, expected=(6.5, 0, 0))
    assert decision.verdict == Verdict.STOP and told in decision.reason
    assert "predicted were 6.5 N" in decision.reason


@pytest.mark.parametrize("off, sigma, verdict", [
    ((0, 0, 3.0), 2.0, Verdict.GO), ((0, 3.0, 0), 2.0, Verdict.STOP),
    ((0, 0, 7.0), 0.5, Verdict.STOP)])
def test_more_is_allowed_where_the_prediction_is_unsure(off, sigma, verdict):
    bench = Bench()
    bench.guard.begin()
    uncertainty = np.diag([0, 0, sigma**2, 0, 0, 0])
    assert bench.run(200, force=np.array(off) + [6, 0, 0], expected=(6, 0, 0),
                     uncertainty=uncertainty).verdict == verdict


def test_slip_is_told_without_a_prediction_by_a_sudden_fall(bench):
    for force in np.linspace(0, 5, 1000):
        bench.look(force=(force, 0, 0))
    decision = bench.run(200, force=(1, 0, 0))
    assert decision.verdict == Verdict.STOP and "slip or break" in decision.reason


def test_a_slow_return_is_no_slip(bench):
    for force in np.linspace(6, 0, 3000):
        assert bench.look(force=(force, 0, 0)).verdict == Verdict.GO


def test_letting_the_branch_back_quickly_is_no_slip_but_losing_it_on_the_way_out_is(bench):
    """Out 40 mm and back in half a second each, force as the way; then a loss while going out."""
    out = np.linspace(0, 0.04, 250)
    for way in np.r_[out, out[::-1]]:
        verdict = bench.look(force=(150 * way, 0, 0), grasp=INSIDE + [way, 0, 0]).verdict
        assert verdict == Verdict.GO
    for way in out:
        bench.look(force=(150 * way, 0, 0), grasp=INSIDE + [way, 0, 0])
    lost = [bench.look(force=(0.5, 0, 0), grasp=INSIDE + [0.04 + way, 0, 0]).verdict
            for way in out[1:50]]
    assert Verdict.STOP in lost


def test_idle_allows_rest_near_a_singularity_but_no_force():
    bench = Bench()
    folded = np.array([0.1, -1.57, 0.0, -1.57, 0.0, 0])
    assert bench.run(joints=folded).verdict == Verdict.GO
    assert bench.look(force=(25, 0, 0)).verdict == Verdict.STOP


@given(st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6), st.floats(1e-4, 0.02))
@settings(max_examples=200, deadline=None)
def test_no_target_is_ever_faster_than_allowed(change, seconds):
    bench = Bench()
    bench.guard.begin()
    current = np.array([0.4, 0.1, 0.5, 0.2, -0.1, 0.3])
    target = bench.guard.permit(current, current + np.array(change), seconds)
    assert np.linalg.norm(target[:3] - current[:3]) <= LIMITS.speed_m_s * seconds * (1 + 1e-9)
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(target[3:]) * Rotation.from_rotvec(current[3:]).inv()
    assert turn.magnitude() <= LIMITS.turn_speed_rad_s * seconds * (1 + 1e-6) + 1e-9


@pytest.mark.parametrize("target", [np.full(6, np.nan), np.zeros(3)])
def test_a_target_that_is_no_pose_stops(bench, target):
    with pytest.raises(SafetyStop):
        bench.guard.permit(np.zeros(6), target, 0.002)
    assert bench.guard.state == State.STOPPED


@pytest.mark.slow
@given(st.lists(st.sampled_from(["good", "bad", "soft", "begin", "end", "resume", "acknowledge",
                                 "silence", "event"]), max_size=30))
@settings(max_examples=200, deadline=None)
def test_motion_after_a_stop_needs_acknowledge_and_begin_in_any_order_of_events(events):
    """Whatever happens in whatever order: from STOPPED only `acknowledge` leads away."""
    bench = Bench()
    for event in events:
        before = bench.guard.state
        if event in ("begin", "resume"):
            try:
                getattr(bench.guard, event)()
            except SafetyStop:
                assert bench.guard.state == before
        elif event in ("end", "acknowledge"):
            getattr(bench.guard, event)()
        elif event == "silence":
            bench.guard.silence(1.0)
        elif event == "event":
            bench.guard.event("lost")
        else:
            force = {"good": 0, "bad": 30, "soft": 12}[event]
            bench.look(force=(force, 0, 0))
        if before == State.STOPPED and event != "acknowledge":
            assert bench.guard.state == State.STOPPED
        if before == State.PAUSED and bench.guard.state == State.MOVING:
            assert event == "resume"
        if before == State.IDLE and bench.guard.state == State.MOVING:
            assert event == "begin"


def wrench_of(force: float) -> np.ndarray:
    return np.array([0.0, force, 0.0, 0.0, 0.0, 0.0])


def going_back(bench: Bench, forces: np.ndarray, way: float = 0.03):
    """Give samples of a retreat, 800 over ``way`` [m]; return what ended it, and at which."""
    for number, force in enumerate(forces):
        grasp = INSIDE + [0, -way * number / 800, 0]
        decision = bench.look(force=(0, force, 0), grasp=grasp)
        if decision.verdict != Verdict.GO:
            return decision, number
    return decision, len(forces)


@pytest.mark.parametrize("start", [14.0, 38.0])
def test_a_retreat_goes_on_while_the_force_falls(start):
    """Over the soft or the hard limit; the pause or stop that led to it does not hold it back."""
    bench = Bench()
    bench.guard.begin()
    assert bench.look(force=(0, start, 0)).verdict != Verdict.GO
    bench.guard.begin_retreat(wrench_of(start))
    assert bench.guard.feel(wrench_of(start)).verdict == Verdict.GO
    assert going_back(bench, np.linspace(start, 0, 800))[0].verdict == Verdict.GO
    bench.guard.end()
    assert bench.guard.state == State.IDLE
    # Afterwards the limits hold as ever.
    bench.guard.begin()
    assert bench.look(force=(0, 14, 0)).verdict == Verdict.PAUSE


@pytest.mark.parametrize("forces, told, before", [
    (np.linspace(38, 60, 800), "the force rises during the return", 200),
    (np.r_[np.linspace(38, 20, 400), np.linspace(20, 38, 400)], "the force rises", 500),
    (np.full(800, 38.0), "the force does not fall during the return", 600),
    (np.r_[np.linspace(38, 2, 400), np.full(400, 12.0)], "the force rises", 410),
    (np.r_[np.full(50, 38.0), 60.0], "the force rises", 51),
    (np.r_[np.full(50, 38.0), np.nan], "no number", 51)])
def test_a_retreat_stops_where_the_force_rises_or_stays(forces, told, before):
    bench = Bench()
    bench.guard.begin()
    bench.look(force=(0, 38, 0))
    bench.guard.begin_retreat(wrench_of(38.0))
    decision, number = going_back(bench, forces)
    assert decision.verdict == Verdict.STOP and told in str(decision) and number < before
    assert bench.guard.state == State.STOPPED


def test_a_retreat_leads_out_of_a_place_over_its_limit_and_no_farther_in():
    """A joint at its limit, a singularity, outside of the workspace: each while it gets better."""
    for good, bad, name in (
            ({"joints": JOINTS}, {"joints": JOINTS + [6.165, 0, 0, 0, 0, 0]}, "joint 1"),
            ({"joints": JOINTS}, {"joints": JOINTS * [1, 1, 1, 1, 0.012, 1]}, "singularity"),
            ({"grasp": INSIDE}, {"grasp": INSIDE + [0.51, 0, 0]}, "workspace")):
        key = next(iter(good))
        parts = [(1 - part) * bad[key] + part * good[key] for part in np.linspace(-0.01, 0.05, 60)]
        for order, stops in ((parts[10:], False), (parts[10::-1], True)):
            bench = Bench()
            bench.guard.begin()
            stopped = bench.look(**bad)
            assert stopped.verdict == Verdict.STOP and name in str(stopped)
            bench.guard.begin_retreat(np.zeros(6))
            seen = [bench.look(**{key: value}).verdict for value in order]
            assert seen[0] == Verdict.GO and (Verdict.STOP in seen) == stops


def test_a_retreat_needs_a_force_that_is_known_and_an_arm_that_stands():
    bench = Bench()
    bench.guard.begin()
    with pytest.raises(SafetyStop, match="moving"):
        bench.guard.begin_retreat(np.zeros(6))
    bench.guard.event("test")
    with pytest.raises(SafetyStop, match="unknown"):
        bench.guard.begin_retreat(np.r_[np.inf, np.zeros(5)])


@pytest.mark.parametrize("name", ["ur3e", "ur5e", "ur10", "ur16e"])
def test_the_guard_keeps_to_the_arms_table(name):
    """Limits that passed no check of a file, as of a program, are none: the arm's own hold."""
    arm = ARMS[name]
    wild = LIMITS.model_copy(update={
        "soft_force_n": 1e4, "hard_force_n": 1e4, "hard_torque_nm": 3000.0,
        "unexpected_force_n": 1e4, "speed_m_s": 50.0, "turn_speed_rad_s": 30.0})
    bench = Bench()
    bench.guard = Guard(arm, GuardSettings(wild, np.tile([-900.0, 900.0], (6, 1))), 500.0)
    bench.guard.tared()
    bench.guard.begin()
    target = bench.guard.permit(np.zeros(6), np.array([1.0, 0, 0, 0, 0, 0]), 0.1)
    assert target[0] == pytest.approx(0.025)
    turned = bench.guard.permit(np.zeros(6), np.array([0, 0, 0, 3.0, 0, 0]), 0.1)
    assert turned[3] == pytest.approx(0.15)
    assert bench.run().verdict == Verdict.GO
    force = min(140.0, 2 * 9.81 * arm.payload)
    assert bench.look(force=(0, 0, force - 1)).verdict == Verdict.GO
    assert "hard force limit" in bench.look(force=(0, 0, force + 1)).reason
    for changed, reason in (({"torque": (0, 0, 0.15 * force + 1)}, "hard torque limit"),
                            ({"joints": np.r_[7.0, JOINTS[1:]]}, "joint 1 at its limit"),
                            ({"speed": np.r_[0.5, np.zeros(5)]}, "speed")):
        bench.guard.acknowledge()
        bench.guard.begin()
        assert reason in bench.look(**changed).reason


@pytest.mark.parametrize("offset, told", [((0.005, 0, 0, 0, 0, 0), "5.0 mm and 0.0 degrees"),
                                          ((0, 0, 0, 0, 0.05, 0), "0.0 mm and 2.9 degrees")])
def test_a_tool_that_is_changed_in_the_controller_stops_at_the_next_sample(bench, offset, told):
    """No joint moves, the reported pose does; nominal dimensions that are off do not matter."""
    tool = matrices(np.array(offset))
    poses = [pose_vectors(ARM.forward(JOINTS + [0.001 * k, 0, 0, 0, 0, 0]) @ part)
             for k, part in enumerate([np.eye(4)] * 20 + [tool])]
    seen = [bench.look(joints=JOINTS + [0.001 * k, 0, 0, 0, 0, 0], pose=pose)
            for k, pose in enumerate(poses)]
    assert [one.verdict for one in seen[:-1]] == [Verdict.GO] * 20
    assert seen[-1].verdict == Verdict.STOP and told in str(seen[-1])
