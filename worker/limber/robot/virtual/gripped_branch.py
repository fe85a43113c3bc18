"""The branch in the virtual gripper: its reaction is what the virtual sensor feels.

A process of its own solves the branch, over and over, where the gripper is about to be when the
solution has come. Between two solutions the wrench is extrapolated by the tangent stiffness at the
last one and by how that changed since one before, so the arm's loop never waits: the reaction
is late by nothing and off by what is of third order in the way moved since. A branch held at an arm
of 0.3 m and moved across by 6 mm comes 60 micrometres nearer to its root: along its stiff axis the
tangent alone would be newtons off. How long a solution takes, and by how much the wrench was off
when one came, is part of the robot's state.
"""

import time
import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.numerics.rigid_kernels import crossed, frame_of, inverse_of, rotation_vector
from limber.robot.driver.real_time import claim_real_time, spare_what_is_loaded
from limber.robot.virtual.step_kernels import led_on

_SOLVER_PRIORITY = 10
_REST = 0.25  # of what a solution took: a process that never rests is held up by the system
_BLEND_SECONDS = 0.05
_LEAD = 1.5  # times what a solution takes: the middle of when it is used
_LONGEST_LEAD = 0.5  # s
_LEAST_WAY = 2e-3  # m between two solutions whose tangents are compared
_SAME_PLACE = 1e-6  # m, rad; over that the tangent leads on exactly
_TOLERANCE = 1e-5  # of the residual, relative to the forces: far below what a sensor tells
_MOST_WAYS = 2.0  # so many times the way between two solutions a change is led on
_PAST = 5  # solutions that are known still: the robot may go slowly
_TRIED_WAY = 3e-3  # m across the branch, when the gripper has closed


@dataclass(frozen=True)
class BranchSetting:
    """Which branch stands where beside the virtual robot.

    Attributes:
        mesh: File of the true branch: tetrahedra with ``young``, ``poisson``, ``density`` and
            ``fixed``, as it hangs.
        base_pose: The robot's base in the branch's frame [m, rad], shape [6].
        grasp_pose: The gripper's middle in the flange's frame [m, rad], shape [6].
        points: Points of the branch that are seen (markers), [m], shape [n, 3].
        gravity: In the branch's frame [m/s^2], or zeros for a branch without weight.
        jaw: Half width of what the gripper takes hold of along the branch [m].
        grip: Force that the grip bears before the branch slips out [N].
        break_strain: Greatest principal strain that the branch bears.
        compliance: What arm, fingers and bark give way by [m/N].
    """

    mesh: Path
    base_pose: tuple[float, ...]
    grasp_pose: tuple[float, ...]
    points: tuple[tuple[float, float, float], ...] = ()
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    jaw: float = 0.012
    grip: float = 80.0
    break_strain: float = 0.2
    compliance: float = 0.0

    @classmethod
    def of_truth(cls, truth: Any, cell: Any, path: Path, *, poisson: float = 0.35,
                 density: float = 900.0, wave: float = 0.0) -> "BranchSetting":
        """Return the setting of a :class:`~limber.estimation.simulated_pull.TrueBranch` in a cell.

        Its mesh is written to ``path``. The seen points are the control points and the tip.

        Args:
            wave: How far log E swings to and fro between the control points about the straight
                course that a fit takes it to have.
        """
        from limber.mechanics.materials.young_field import young_weights

        mesh, count = truth.mesh, truth.mesh.tet_count
        weights = young_weights(mesh, truth.control_points)
        # 0 at the control points, largest in the middle between two of them, by turns up and down.
        bumps = 4.0 * weights[:, :-1] * weights[:, 1:]
        swing = wave * bumps @ (-1.0) ** np.arange(bumps.shape[1])
        mesh.with_data(cell_data={
            "young": np.exp(swing) * (weights @ np.asarray(truth.young, float)),
            "poisson": np.full(count, poisson), "density": np.full(count, density)}).write(path)
        tip = truth.skeleton.nodes[truth.skeleton.main_path()[-1]]
        points = [*truth.control_points, tip]
        return cls(path, tuple(cell.base.pose), tuple(cell.tool.grasp_pose),
                   tuple(tuple(map(float, point)) for point in points),
                   tuple(map(float, truth.gravity)), compliance=cell.tool.compliance_m_per_n)


Bends = tuple[np.ndarray, np.ndarray]
"""Ways [m], shape [n, 3], and by how much the stiffness changes over each, shape [n, 6, 6]."""
_NO_BENDS: Bends = np.zeros((0, 3)), np.zeros((0, 6, 6))


def _joined(first: Bends, then: Bends) -> Bends:
    return np.concatenate((first[0], then[0])), np.concatenate((first[1], then[1]))


@dataclass
class Solution:
    """The branch at one pose of the held patch.

    Attributes:
        frame: Of the patch, branch frame, shape [4, 4].
        wrench: Of the gripper on the branch, about the patch's position, branch frame [N, N m].
        stiffness: Its derivative to position and rotation, shape [6, 6].
        points: Seen points [m], shape [n, 3].
        point_slopes: Their derivative to position and rotation, shape [3 n, 6].
        peak_strain: Greatest principal strain.
        seconds: What it took.
        converged: Whether it is an equilibrium; if not, the rest is of the last one.
        bends: Over the way from a solution before first, then over those that were tried when
            the gripper closed.
    """

    frame: np.ndarray
    wrench: np.ndarray
    stiffness: np.ndarray
    points: np.ndarray
    point_slopes: np.ndarray
    peak_strain: float
    seconds: float
    converged: bool
    bends: Bends = _NO_BENDS

    def wrench_at(self, patch: np.ndarray, compliance: float) -> np.ndarray:
        """Return the wrench [6] with the gripper where the patch's frame would be ``patch``.

        The patch stays behind by ``compliance`` [m/N] times the force; near the own frame.
        """
        return led_on(self.frame, self.wrench, self.stiffness, *self.bends, patch, compliance)

    def change_to(self, patch: np.ndarray) -> np.ndarray:
        """Return the way [m] and the turn [rad] to another frame of the patch, shape [6]."""
        return np.concatenate((patch[:3, 3] - self.frame[:3, 3],
                               rotation_vector(patch @ inverse_of(self.frame))))

    def bend_from(self, before: "Solution") -> Bends:
        """Return how the stiffness has changed on the way from another solution, if it tells."""
        way = self.frame[:3, 3] - before.frame[:3, 3]
        if not (self.converged and before.converged and np.linalg.norm(way) > _LEAST_WAY):
            return _NO_BENDS
        return way[None], (self.stiffness - before.stiffness)[None]

    def led_by(self, past: Sequence["Solution"], tried: Bends) -> None:
        """Note how it goes on from ``past`` solutions, the latest first, or else as that did."""
        for before in past:
            newest = self.bend_from(before)
            if len(newest[0]):
                self.bends = _joined(newest, tried)
                return
        # Where it hardly moved, what was known before still holds.
        self.bends = past[0].bends if past else tried


class HeldBranch:
    """What the gripper holds: a branch, once it is closed on it."""

    def __init__(self, setting: BranchSetting):
        self.setting = setting
        # Compiled before the robot's clock runs.
        led_on(np.eye(4), np.zeros(6), np.eye(6), *_NO_BENDS, np.eye(4), 0.0)
        self._base = frame_of(np.array(setting.base_pose, float))
        self._tool = frame_of(np.array(setting.grasp_pose, float))
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_solve_for_ever, args=(setting, theirs),
                                        name="branch", daemon=True)
        self._process.start()
        theirs.close()
        self.rest_points = self._receive("ready")["points"]
        self.state = "free"
        self._offset = np.eye(4)
        self._solution: Solution | None = None
        self._busy, self._asked, self._age = False, False, 0.0
        self._taken, self._asked_age = 0.0, 0.0
        self._jump = np.zeros(6)
        self._largest_jump = 0.0
        self._tried = _NO_BENDS
        self._past: deque[Solution] = deque(maxlen=_PAST)
        self._twist, self._last_patch = np.zeros(6), np.eye(4)
        self._gripper = self._closed_at = np.eye(4)
        self._view: dict[str, Any] | None = None
        self._is_looking = False
        self.picture: bytes | None = None

    @property
    def points(self) -> np.ndarray:
        """Where the seen points are [m], shape [n, 3]."""
        solution = self._solution
        if solution is None:
            return self.rest_points
        patch = self._gripper @ self._offset
        # The held piece stays behind the gripper by what gives way.
        felt = self._extrapolated(solution, patch)
        patch[:3, 3] -= self.setting.compliance * felt[:3]
        moved = solution.point_slopes @ solution.change_to(patch)
        return solution.points + moved.reshape(-1, 3)

    def wrench(self, flange: np.ndarray, seconds: float) -> np.ndarray:
        """Return what the branch exerts on the flange, flange frame, shape [6]."""
        self._gripper = self._base @ flange @ self._tool
        self._take_picture()
        if self.state == "closing" and not self._is_looking:
            self._close_jaws()
        if self.state != "held":
            return np.zeros(6)
        self._age += seconds
        self._asked_age += seconds
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
        """Close the gripper where it is; the arm's loop goes on while the branch is looked for.

        The state is ``closing``, then ``held``, or ``empty`` where no branch is between the jaws.
        """
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
                self._taken, self._tried = answer["solution"].seconds, _NO_BENDS
                self._past = deque([answer["solution"]], maxlen=_PAST)
                self._pipe.send(("try", None))
                self._busy = True
                return
        if not self._busy and not self._asked:
            self._pipe.send(("grasp", tuple(self._closed_at[:3, 3])))
            self._busy = self._asked = True

    def release(self) -> None:
        """Open the gripper: the branch goes back to rest."""
        self.lose("free")

    def lose(self, how: str) -> None:
        """The branch is no longer held: ``free``, ``slipped`` or ``broken``."""
        self.state, self._solution = how, None

    def slide(self, part: float) -> None:
        """Let the branch slide back in the grip by ``part`` of the way it was pulled."""
        if self._solution is None:
            return
        step = np.linalg.solve(self._solution.stiffness[:3, :3], self._solution.wrench[:3])
        moved = np.eye(4)
        moved[:3, 3] = -part * step
        self._offset = inverse_of(self._gripper) @ moved @ self._gripper @ self._offset

    def close(self) -> None:
        """End the solver."""
        self._process.kill()
        self._process.join()
        self._pipe.close()

    def seen(self) -> list[list[float]]:
        """Return where a tracker on the robot's base sees the points, base frame [m]."""
        return ((self.points - self._base[:3, 3]) @ self._base[:3, :3]).tolist()

    def look(self, camera: dict[str, Any]) -> None:
        """Ask for a depth image; it is in ``picture`` when the solver has found time for it.

        Args:
            camera: Content of a :class:`~limber.geometry.cloud.camera.Camera`.
        """
        self._view, self.picture = camera, None

    def _take_picture(self) -> None:
        if self._is_looking:
            # Asked once: an answer may come between two questions.
            if self._pipe.poll():
                self.picture = self._pipe.recv()[1]
                self._is_looking = self._busy = False
        elif self._busy and self.state not in ("held", "closing") and self._pipe.poll():
            # A solution for a branch that has been let go.
            self._pipe.recv()
            self._busy = False
        if self._view is not None and not self._busy:
            self._pipe.send(("look", (self._view, self._solution is not None)))
            self._view, self._is_looking, self._busy = None, True, True

    def report(self) -> dict[str, Any]:
        """Return its state as plain data."""
        solution = self._solution
        told: dict[str, Any] = {"branch": self.state, "solution_age_s": self._age,
                                "points": self.points.tolist(),
                                "extrapolation_error_n": self._largest_jump}
        if solution is not None:
            told |= {"solve_s": solution.seconds, "peak_strain": solution.peak_strain,
                     "converged": solution.converged, "true_wrench": solution.wrench.tolist()}
        return told

    def _follow_twist(self, patch: np.ndarray, seconds: float) -> None:
        """How fast the patch goes and turns, over the last hundredths of a second."""
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
                    self._solution.led_by(list(self._past)[1:], found)
                return
            before, self._age = self._solution, 0.0
            self._taken = self._asked_age
            found.led_by(self._past, self._tried)
            self._past.appendleft(found)
            if before is not None:
                # The wrench goes over to the new solution, a branch's force does not jump.
                jump = self._extrapolated(before, patch) - self._extrapolated(found, patch)
                self._jump += jump
                self._largest_jump = max(self._largest_jump, float(np.linalg.norm(jump[:3])))
            self._solution = found
        # A picture that is asked for has the next turn.
        if not self._busy and self._view is None:
            ahead = self._ahead(patch)
            if self._solution is not None:
                force = self._extrapolated(self._solution, ahead)[:3]
                ahead[:3, 3] -= self.setting.compliance * force
                if self._solution.converged and (
                        np.abs(self._solution.change_to(ahead)).max() < _SAME_PLACE):
                    # It stands still, and is solved there: the processor is others'.
                    self._asked_age = 0.0
                    return
            self._pipe.send(("solve", ahead))
            self._busy, self._asked_age = True, 0.0

    def _ahead(self, patch: np.ndarray) -> np.ndarray:
        """Where the patch will be in the middle of the time in which a solution is used."""
        way = min(_LEAD * self._taken, _LONGEST_LEAD) * self._twist
        ahead = frame_of(np.concatenate((np.zeros(3), way[3:]))) @ patch
        ahead[:3, 3] = patch[:3, 3] + way[:3]
        return ahead

    def _receive(self, kind: str) -> dict[str, Any]:
        try:
            got, content = self._pipe.recv()
        except EOFError as error:
            raise InputError(f"The branch {self.setting.mesh} cannot be held: its solver ended.",
                             "See what it printed.") from error
        assert got == kind
        return content

    def _extrapolated(self, solution: Solution, patch: np.ndarray) -> np.ndarray:
        return solution.wrench_at(patch, self.setting.compliance)

    def _at_flange(self, wrench: np.ndarray, patch: np.ndarray, flange: np.ndarray) -> np.ndarray:
        """A wrench at the patch, branch frame, as one at the flange in its frame."""
        rotation = (self._base[:3, :3] @ flange[:3, :3]).T
        force, torque = rotation @ wrench[:3], rotation @ wrench[3:]
        origin = self._base[:3, :3] @ flange[:3, 3] + self._base[:3, 3]
        lever = rotation @ (patch[:3, 3] - origin)
        return np.concatenate((force, torque + crossed(lever, force)))


def _solve_for_ever(setting: BranchSetting, pipe: Connection) -> None:
    solver = _Solver(setting)
    # Below the arm's own loop; above other programs, for which the branch's force would be late.
    claim_real_time(_SOLVER_PRIORITY)
    spare_what_is_loaded()
    try:
        pipe.send(("ready", {"points": solver.seen()}))
        while True:
            kind, content = pipe.recv()
            if kind == "grasp":
                pipe.send(("grasped", solver.grasp(np.array(content))))
            elif kind == "look":
                pipe.send(("seen", solver.look(*content)))
            elif kind == "try":
                pipe.send(("tried", solver.tried()))
            else:
                began = time.monotonic()
                pipe.send(("solved", solver.solve(content)))
                time.sleep(_REST * (time.monotonic() - began))
    except (EOFError, OSError):
        # The robot is gone, and nobody else asks.
        return


class _Solver:
    """The branch in its process."""

    def __init__(self, setting: BranchSetting):
        from limber.geometry.tets.tet_mesh import TetMesh
        from limber.mechanics.model import BranchModel
        from limber.mechanics.points import point_operator

        mesh = TetMesh.read(setting.mesh)
        data = mesh.cell_data
        model = BranchModel(mesh, young=data["young"], poisson=data["poisson"],
                            density=data["density"], gravity=setting.gravity)
        self._setting = setting
        self._model = model.as_scanned() if np.any(setting.gravity) else model
        self._points = np.asarray(setting.points, float).reshape(-1, 3)
        self._operator = point_operator(mesh, self._points) if len(self._points) else None
        self._grasp = None
        self._held = self._model
        self._state = np.zeros_like(mesh.nodes)
        self._last: Solution | None = None
        self._follows: np.ndarray | None = None
        # By how much that has changed since the solution before, and over which way.
        self._turning: tuple[np.ndarray, np.ndarray] | None = None
        self._faces: np.ndarray | None = None
        self._rng = np.random.default_rng(0)
        self._warm_up()

    def _warm_up(self) -> None:
        """Compile and factorise once before the robot's clock runs."""
        nodes = self._model.mesh.nodes
        root = nodes[self._model.fixed].mean(axis=0)
        far = np.linalg.norm(nodes - root, axis=1).argmax()
        self.grasp(nodes[far])
        self._grasp, self._last, self._state = None, None, np.zeros_like(nodes)

    def seen(self) -> np.ndarray:
        """Where the seen points are now [m], shape [n, 3]."""
        if self._operator is None:
            return self._points
        return self._points + (self._operator @ self._state.ravel()).reshape(-1, 3)

    def look(self, camera: dict[str, Any], is_held: bool) -> bytes:
        """Return what a depth camera sees of the branch, with its noise: 16 bits a pixel, packed.

        Unheld the branch is at rest.
        """
        from limber.geometry.cloud.camera import Camera
        from limber.perception.simulated_camera import render_depth, with_noise

        made = Camera.model_validate(camera)
        mesh = self._model.mesh
        if self._faces is None:
            self._faces = mesh.surface_faces()
        moved = self._state if is_held else np.zeros_like(self._state)
        depth = with_noise(made, render_depth(made, mesh.nodes + moved, self._faces), self._rng)
        steps = np.clip(np.round(depth * made.depth_scale), 0, 65535).astype("<u2")
        return zlib.compress(steps.tobytes(), 1)

    def grasp(self, position: np.ndarray) -> dict[str, Any]:
        from limber.mechanics.grasp import Grasp

        self._state = np.zeros_like(self._model.mesh.nodes)
        self._last = None
        try:
            self._grasp = Grasp.gripping(self._model.mesh, position, self._setting.jaw)
        except InputError as error:
            return {"error": error.seen}
        self._held = self._model.gripped(self._grasp)
        frame = np.eye(4)
        frame[:3, 3] = self._grasp.centre
        return {"centre": self._grasp.centre, "solution": self.solve(frame)}

    def tried(self) -> Bends:
        """How the stiffness changes both ways across the branch, turned as it turns by itself."""
        solution, state, follows = self._last, self._state, self._follows
        if solution is None:
            return _NO_BENDS
        stiffness = solution.stiffness
        axes = np.linalg.eigh(stiffness[:3, :3] + stiffness[:3, :3].T)[1]
        bends = _NO_BENDS
        for way in _TRIED_WAY * axes.T[:2]:
            turn = -np.linalg.solve(stiffness[3:, 3:], stiffness[3:, :3] @ way)
            there = self.solve(frame_of(np.r_[solution.frame[:3, 3] + way, turn]))
            bends = _joined(bends, there.bend_from(solution))
        self._state, self._last, self._follows, self._turning = state, solution, follows, None
        return bends

    def solve(self, patch: np.ndarray) -> Solution:
        """Return the solution at a frame of the patch; the last one where there is none."""
        from limber.mechanics.sensitivities import grasp_slopes
        from limber.mechanics.statics.result import StaticSettings
        from limber.mechanics.statics.solve import follow_poses
        from limber.mechanics.strain import peak_load

        pose = np.r_[patch[:3, 3], rotation_vector(patch)]
        result = follow_poses(self._held, self._grasp, pose[None], start=self._state,
                              guess=self._guessed(patch),
                              settings=StaticSettings(tolerance=_TOLERANCE))[0]
        if not result.converged and self._last is not None:
            self._last = replace(self._last, seconds=result.seconds, converged=False)
            return self._last
        self._state = result.displacement
        slopes = grasp_slopes(self._held, self._grasp, self._state)
        self._turning = None
        if self._last is not None and self._follows is not None:
            way = patch[:3, 3] - self._last.frame[:3, 3]
            if np.linalg.norm(way) > _SAME_PLACE:
                self._turning = way, slopes.displacement - self._follows
        self._follows = slopes.displacement
        points = (np.zeros((0, 6)) if self._operator is None
                  else self._operator @ slopes.displacement.reshape(-1, 6))
        self._last = Solution(
            patch, np.r_[result.reaction_force, result.reaction_torque], slopes.wrench,
            self.seen(), points, peak_load(self._held, self._state)[0], result.seconds,
            result.converged)
        return self._last

    def _guessed(self, patch: np.ndarray) -> np.ndarray | None:
        """Where the nodes nearly are at a frame of the patch, [node_count, 3].

        By the tangent of the solution before and how that changed.
        """
        if self._last is None or self._follows is None:
            return None
        change, follows = self._last.change_to(patch), self._follows
        if self._turning is not None:
            way, turning = self._turning
            part = float(np.clip(change[:3] @ way / (way @ way), -_MOST_WAYS, _MOST_WAYS))
            follows = follows + 0.5 * part * turning
        return self._state + follows @ change
