"""The driver's loop on a virtual controller that is stepped by it: no process, no wall clock."""

import queue
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.numerics.rigid_kernels import crossed
from limber.robot.driver import control_loop
from limber.robot.interface import Sample
from limber.robot.virtual.controller import Braking, Controller, Servo, nearest_joints
from limber.robot.virtual.payload import Nothing

_LATE_STEPS = 2  # until a target that was sent moves the arm
_BRAKING = 8.0


class Wall(Nothing):
    """A stiff plane in the tool's way.

    Args:
        tool: Offset of the tool's centre from the flange [m], shape [3].
        normal: Out of the wall, base frame, shape [3].
        place: A point on it, shape [3].
        stiffness: [N/m].
    """

    def __init__(self, tool: np.ndarray, normal: np.ndarray, place: np.ndarray, stiffness: float):
        self._tool, self._normal, self._place = tool, normal, place
        self.stiffness, self.peak, self.now = stiffness, 0.0, 0.0

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        tip = flange[:3, :3] @ self._tool + flange[:3, 3]
        self.now = self.stiffness * max(float((self._place - tip) @ self._normal), 0.0)
        self.peak = max(self.peak, self.now)
        force = flange[:3, :3].T @ (self.now * self._normal)
        return np.concatenate((force, crossed(self._tool, force)))


class Spring(Nothing):
    """A held branch near its rest: a linear spring, stiff along its axis.

    Args:
        tool: Offset of the tool's centre from the flange [m], shape [3].
        rest: Where it is held without force, base frame, shape [3].
        stiffness: [N/m], shape [3, 3].
    """

    def __init__(self, tool: np.ndarray, rest: np.ndarray, stiffness: np.ndarray):
        self._tool, self._rest, self.stiffness = tool, rest, stiffness
        self.peak = self.now = 0.0

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        tip = flange[:3, :3] @ self._tool + flange[:3, 3]
        pull = self.stiffness @ (self._rest - tip)
        self.now = float(np.linalg.norm(pull))
        self.peak = max(self.peak, self.now)
        force = flange[:3, :3].T @ pull
        return np.concatenate((force, crossed(self._tool, force)))


class Patch(Protocol):
    """Replaces attributes for a while, as pytest's MonkeyPatch does."""

    def setattr(self, target: Any, name: str, value: Any) -> None:
        """Replace an attribute."""
        ...


class SteppedControl:
    """As limber.robot.interface.ArmControl asks for it; each read is one step of the robot.

    Attributes:
        after_step: Called with each sample, by a run.
        each_sample: The same, for its user.
    """

    lookahead, silence = 0.06, 0.1

    def __init__(self, controller: Controller):
        self.controller, self.rate = controller, 1.0 / controller.seconds
        self.facts: dict[str, Any] = {}
        self.after_step: Callable[[Sample], None] = lambda sample: None
        self.each_sample: Callable[[Sample], None] = lambda sample: None
        self._pending: deque = deque([None] * _LATE_STEPS)
        controller.load_script("def rtde_control():\nend\n")

    def read(self, timeout: float, beside=()) -> list[Sample]:
        import time

        self._pending.append(None)
        if (motion := self._pending.popleft()) is not None:
            motion()
        self.controller.step()
        told = self.controller.outputs()
        sample = Sample(
            told["timestamp"], time.monotonic(), told["actual_q"].copy(),
            told["actual_qd"].copy(), told["actual_TCP_pose"].copy(),
            told["actual_TCP_speed"].copy(), told["actual_TCP_force"].copy(), told["robot_mode"],
            told["safety_mode"], 2, 1.0, told["tcp_offset"], told["payload"],
            told["payload_cog"])
        self.each_sample(sample)
        self.after_step(sample)
        return [sample]

    def servo(self, pose: np.ndarray) -> bool:
        controller, pose = self.controller, pose.copy()
        self._pending[-1] = lambda: self._aim(nearest_joints(
            controller.arm, pose, controller.tool, controller.joints))
        return True

    def servo_joints(self, joints: np.ndarray) -> bool:
        self._pending[-1] = lambda: self._aim(joints.copy())
        return True

    def _aim(self, joints: np.ndarray) -> None:
        motion = self.controller.motion
        if not isinstance(motion, Servo):
            motion = self.controller.motion = Servo()
        motion.target, motion.lookahead, motion.gain = joints, self.lookahead, 900.0

    def end_motion(self) -> bool:
        def brake() -> None:
            self.controller.motion = Braking(self.controller.speeds, _BRAKING)
        self._pending[-1] = brake
        return True

    stop_at_once = end_motion

    def skip(self) -> None:
        """There is nothing old."""

    def connect(self) -> None:
        """It is connected."""

    def put_back(self) -> None:
        """Nothing was set."""

    watch = close = skip
    keep_alive = start_program = program_runs = lambda self: True


class Run:
    """One run of the loop: what it told, and the orders that follow from that.

    Attributes:
        told: Events in order.
        rows: Samples, as in limber.robot.driver.link.COLUMNS.
    """

    def __init__(self, cell: Cell, controller: Controller, patch: Patch):
        self.cell, self.told, self._batches = cell, [], []
        self.control = SteppedControl(controller)
        for name, value in (("control_of", lambda cell: self.control),
                            ("set_deadline", lambda *seconds: None),
                            ("claim_real_time", lambda *priority: True),
                            ("spare_what_is_loaded", lambda: True), ("keep_awake", lambda: True)):
            patch.setattr(control_loop, name, value)
        patch.setattr(control_loop.RenewedDeadline, "renew", lambda deadline: None)
        self.orders: queue.SimpleQueue = queue.SimpleQueue()
        self.driver = control_loop.Driver(cell, self)

    def tell(self, **content: Any) -> None:
        (self._batches if "samples" in content else self.told).append(content)

    @property
    def rows(self) -> np.ndarray:
        return np.concatenate([[[np.nan if x is None else x for x in row]
                                for row in batch["samples"]] for batch in self._batches])

    def follow(self, order: dict[str, Any], *, seconds: float = 20.0, after: float = 0.3,
               at_pause: Callable[[], str] | None = None,
               at_stop: Callable[[], str] | None = None,
               stop_at: float = float("inf")) -> dict[str, Any]:
        """Tare, follow, and run on ``after`` [s] of the robot's time; returns how it ended.

        Args:
            at_pause: Called at a pause; returns the order that follows. Else a pause ends it.
            at_stop: The same for a stop.
            stop_at: Time since the start at which a stop is ordered [s].
        """
        choices = {"paused": at_pause, "stopped": at_stop}
        begin = self.control.controller.clock
        state: dict[str, Any] = {"followed_at": None, "halted_at": None, "chosen": None,
                                 "ended_at": None}
        self.orders.put({"order": "tare", "seconds": 0.1})

        def ends() -> list[dict[str, Any]]:
            rest = self.told[state["chosen"] or 0:]
            first = state["chosen"] is None
            return [event for event in rest if event["event"] in ("reached", "refused", *(
                kind for kind, choice in choices.items() if choice is None or not first))]

        def step(sample: Sample) -> None:
            self.orders.put({"order": "alive"})
            kinds = [event["event"] for event in self.told]
            if "tared" in kinds and state["followed_at"] is None:
                state["followed_at"] = sample.clock
                self.orders.put(order)
            since = sample.clock - (state["followed_at"] or np.inf)
            if since > stop_at and state["halted_at"] is None:
                self.orders.put({"order": "stop"})
            halt = next((kind for kind in kinds if kind in choices), None)
            if halt is not None and state["chosen"] is None and choices[halt] is not None:
                state["halted_at"] = state["halted_at"] or sample.clock
                if sample.clock - state["halted_at"] > after:
                    state["chosen"] = len(self.told)
                    self.orders.put({"order": choices[halt]()})
            if state["ended_at"] is None and ends():
                state["ended_at"] = sample.clock
            over = sample.clock - begin > seconds
            if over or (state["ended_at"] is not None
                        and sample.clock - state["ended_at"] > after):
                self.control.after_step = lambda sample: None
                self.orders.put(None)
        self.control.after_step = step
        self.driver.run(self.orders)
        return ends()[0]
