"""The branch in the virtual gripper: its reaction is the load of the virtual sensor.

A separate process solves the branch repeatedly, at the gripper's predicted pose when the solution
arrives. Between two solutions the wrench is extrapolated with the tangent stiffness at the last one
and its change since an earlier one, so the arm's loop never waits. The reaction has no delay, and
its error is of third order in the displacement since. A branch held at an arm of 0.3 m and moved
across by 6 mm comes 60 micrometres nearer to its root: along its stiff axis the tangent alone would
have an error of newtons. The time of a solution, and the error of the wrench when one arrived, are
part of the robot's state.
"""

from collections import deque
from multiprocessing import get_context
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.geometry.rigid_kernels import crossed, frame_of, inverse_of, rotation_vector
from limber.robot.virtual.branch_solver import (
    NO_BENDS,
    SAME_PLACE,
    BranchSetting,
    Solution,
    solve_for_ever,
)
from limber.robot.virtual.payload import Load
from limber.robot.virtual.step_kernels import steer

_BLEND_SECONDS = 0.05
_LEAD = 1.5  # times a solution's duration: the middle of the time in which it is used
_LONGEST_LEAD = 0.5  # s
_PAST = 5  # past solutions kept: the robot may move slowly


class HeldBranch(Load):
    """The gripper's load: a branch, once the gripper is closed on it."""

    def __init__(self, setting: BranchSetting):
        self.setting = setting
        # Compiled before the robot's clock runs.
        steer(np.eye(4), np.zeros(6), np.eye(6), *NO_BENDS, np.eye(4), 0.0)
        self._base = frame_of(np.array(setting.base_pose, float))
        self._tool = frame_of(np.array(setting.grasp_pose, float))
        self._start()
        self.rest_points = self._receive("ready")["points"]
        self.state = "free"
        self._offset = np.eye(4)
        self._solution: Solution | None = None
        self._busy, self._asked, self._age = False, False, 0.0
        self._taken, self._asked_age = 0.0, 0.0
        self._jump = np.zeros(6)
        self._largest_jump = 0.0
        self._tried = NO_BENDS
        self._past: deque[Solution] = deque(maxlen=_PAST)
        self._twist, self._last_patch = np.zeros(6), np.eye(4)
        self._gripper = self._closed_at = np.eye(4)
        self.creep = 0.0
        """Part of the gripper's motion by which the branch slides back in the jaws: slow slip."""
        self._view: dict[str, Any] | None = None
        self._is_looking = False
        self.picture: bytes | None = None

    def _start(self) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=solve_for_ever, args=(self.setting, theirs),
                                        name="branch", daemon=True)
        self._process.start()
        theirs.close()

    @property
    def points(self) -> np.ndarray:
        """Positions of the seen points [m], shape [n, 3]."""
        solution = self._solution
        if solution is None:
            return self.rest_points
        patch = self._gripper @ self._offset
        # The held piece stays behind the gripper by the compliance.
        felt = self._extrapolated(solution, patch)
        patch[:3, 3] -= self.setting.compliance * felt[:3]
        moved = solution.point_slopes @ solution.change_to(patch)
        return solution.points + moved.reshape(-1, 3)

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        """Return the wrench of the branch on the flange, flange frame, shape [6]."""
        before, self._gripper = self._gripper, self._base @ flange @ self._tool
        self._take_picture()
        if self.state == "closing" and not self._is_looking:
            self._close_jaws()
        if self.state != "held":
            return np.zeros(6)
        self._age += seconds
        self._asked_age += seconds
        if self.creep > 0.0:
            self._move_in_jaws(-self.creep * (self._gripper[:3, 3] - before[:3, 3]))
        patch = self._gripper @ self._offset
        self._follow_twist(patch, seconds)
        if not self._is_looking:
            self._exchange(patch)
        solution = self._solution
        if solution is None:
            return np.zeros(6)
        if solution.peak_strain > self.setting.break_strain:
            self.lose("broken")
            return np.zeros(6)
        self._jump *= np.exp(-seconds / _BLEND_SECONDS)
        on_branch = self._extrapolated(solution, patch) + self._jump
        if np.linalg.norm(on_branch[:3]) > self.setting.grip:
            self.lose("slipped")
            return np.zeros(6)
        return self._at_flange(-on_branch, patch, flange)

    def grasp(self) -> None:
        """Close the gripper at its present pose, without waiting for the solver: ``closing``, then
        ``held``, or ``empty`` if no branch is between the jaws."""
        self.state, self._solution = "closing", None
        self._closed_at = self._gripper
        self._asked = False

    def _close_jaws(self) -> None:
        if self._busy and self._pipe.poll():
            kind, answer = self._pipe.recv()
            self._busy = False
            if kind == "grasped":
                if "error" in answer:
                    self.state = "empty"
                    return
                rest = np.eye(4)
                rest[:3, 3] = answer["centre"]
                self._offset = inverse_of(self._closed_at) @ rest
                self._solution, self._age, self.state = answer["solution"], 0.0, "held"
                self._jump, self._largest_jump = np.zeros(6), 0.0
                self._twist, self._last_patch = np.zeros(6), rest
                self._taken, self._tried = answer["solution"].seconds, NO_BENDS
                self._past = deque([answer["solution"]], maxlen=_PAST)
                self._pipe.send(("try", None))
                self._busy = True
                return
        if not self._busy and not self._asked:
            self._pipe.send(("grasp", tuple(self._closed_at[:3, 3])))
            self._busy = self._asked = True

    def release(self) -> None:
        """Open the gripper: the branch returns to rest."""
        self.creep = 0.0
        self.lose("free")

    def lose(self, how: str) -> None:
        """The branch is no longer held: ``free``, ``slipped`` or ``broken``."""
        self.state, self._solution = how, None

    def slide(self, part: float) -> None:
        """Let the branch slide back in the grip by ``part`` of its displacement."""
        if self._solution is None:
            return
        step = np.linalg.solve(self._solution.stiffness[:3, :3], self._solution.wrench[:3])
        self._move_in_jaws(-part * step)

    def _move_in_jaws(self, shift: np.ndarray) -> None:
        """Move the branch by ``shift`` [m], shape [3], while the gripper stays."""
        moved = np.eye(4)
        moved[:3, 3] = shift
        self._offset = inverse_of(self._gripper) @ moved @ self._gripper @ self._offset

    def close(self) -> None:
        """End the solver."""
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def seen(self) -> list[list[float]]:
        """Return the points as a tracker on the robot's base sees them, base frame [m]."""
        return ((self.points - self._base[:3, 3]) @ self._base[:3, :3]).tolist()

    def look(self, camera: dict[str, Any]) -> None:
        """Ask for a depth image of a :class:`~limber.geometry.cloud.camera.Camera`; it is in
        ``picture`` when the solver has computed it."""
        self._view, self.picture = camera, None

    def _take_picture(self) -> None:
        if self._is_looking:
            # Asked once: an answer may arrive between two questions.
            if self._pipe.poll():
                self.picture = self._pipe.recv()[1]
                self._is_looking = self._busy = False
        elif self._busy and self.state not in ("held", "closing") and self._pipe.poll():
            # A solution for a branch that has been released.
            self._pipe.recv()
            self._busy = False
        if self._view is not None and not self._busy:
            self._pipe.send(("look", (self._view, self._solution is not None)))
            self._view, self._is_looking, self._busy = None, True, True

    def report(self) -> dict[str, Any]:
        """Return its state as plain data."""
        solution = self._solution
        state: dict[str, Any] = {"branch": self.state, "solution_age_s": self._age,
                                 "points": self.points.tolist(),
                                 "extrapolation_error_n": self._largest_jump}
        if solution is not None:
            state |= {"solve_s": solution.seconds, "peak_strain": solution.peak_strain,
                      "converged": solution.converged, "true_wrench": solution.wrench.tolist()}
        return state

    def _follow_twist(self, patch: np.ndarray, seconds: float) -> None:
        """Velocity and angular velocity of the patch, over the last hundredths of a second."""
        change = np.concatenate((patch[:3, 3] - self._last_patch[:3, 3],
                                 rotation_vector(patch @ inverse_of(self._last_patch))))
        kept = np.exp(-seconds / 0.02)
        self._twist = kept * self._twist + (1.0 - kept) * change / seconds
        self._last_patch = patch

    def _exchange(self, patch: np.ndarray) -> None:
        if self._busy and self._pipe.poll():
            kind, found = self._pipe.recv()
            self._busy = False
            if kind == "tried":
                self._tried = found
                if self._solution is not None:
                    self._solution.add_predictions(list(self._past)[1:], found)
                return
            before, self._age = self._solution, 0.0
            self._taken = self._asked_age
            found.add_predictions(self._past, self._tried)
            self._past.appendleft(found)
            if before is not None:
                # The wrench blends to the new solution: a branch's force does not jump.
                jump = self._extrapolated(before, patch) - self._extrapolated(found, patch)
                self._jump += jump
                self._largest_jump = max(self._largest_jump, float(np.linalg.norm(jump[:3])))
            self._solution = found
        # A requested picture has the next turn.
        if not self._busy and self._view is None:
            ahead = self._ahead(patch)
            if self._solution is not None:
                force = self._extrapolated(self._solution, ahead)[:3]
                ahead[:3, 3] -= self.setting.compliance * force
                if self._solution.converged and (
                        np.abs(self._solution.change_to(ahead)).max() < SAME_PLACE):
                    # It is at rest, and is solved there: the processor is free for others.
                    self._asked_age = 0.0
                    return
            self._pipe.send(("solve", ahead))
            self._busy, self._asked_age = True, 0.0

    def _ahead(self, patch: np.ndarray) -> np.ndarray:
        """Pose of the patch in the middle of the time in which a solution is used."""
        step = min(_LEAD * self._taken, _LONGEST_LEAD) * self._twist
        ahead = frame_of(np.concatenate((np.zeros(3), step[3:]))) @ patch
        ahead[:3, 3] = patch[:3, 3] + step[:3]
        return ahead

    def _receive(self, kind: str) -> dict[str, Any]:
        try:
            got, content = self._pipe.recv()
        except EOFError as error:
            raise InputError(f"The branch {self.setting.mesh} cannot be held because its solver "
                             "ended.", "See its output.") from error
        assert got == kind
        return content

    def _extrapolated(self, solution: Solution, patch: np.ndarray) -> np.ndarray:
        return solution.wrench_at(patch, self.setting.compliance)

    def _at_flange(self, wrench: np.ndarray, patch: np.ndarray, flange: np.ndarray) -> np.ndarray:
        """Transform a wrench at the patch, branch frame, to the flange, in its frame."""
        rotation = (self._base[:3, :3] @ flange[:3, :3]).T
        force, torque = rotation @ wrench[:3], rotation @ wrench[3:]
        origin = self._base[:3, :3] @ flange[:3, 3] + self._base[:3, 3]
        lever = rotation @ (patch[:3, 3] - origin)
        return np.concatenate((force, torque + crossed(lever, force)))
