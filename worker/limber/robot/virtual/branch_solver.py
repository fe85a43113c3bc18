"""The process that solves the branch in the virtual gripper, and its description."""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.errors import InputError
from limber.geometry.rigid_kernels import frame_of, inverse_of, rotation_vector
from limber.robot.driver.real_time import claim_real_time, spare_what_is_loaded
from limber.robot.virtual.step_kernels import steer

if TYPE_CHECKING:
    from limber.mechanics.grasp import Grasp

_LEAST_WAY = 2e-3  # m between two solutions whose tangents are compared

Bends = tuple[np.ndarray, np.ndarray]
"""Displacements [m], shape [n, 3], and the change of stiffness over each, shape [n, 6, 6]."""
NO_BENDS: Bends = np.zeros((0, 3)), np.zeros((0, 6, 6))


def joined(first: Bends, then: Bends) -> Bends:
    return np.concatenate((first[0], then[0])), np.concatenate((first[1], then[1]))


@dataclass
class Solution:
    """The branch at one pose of the held patch, branch frame [4, 4]: the gripper's wrench on it
    about the patch [N, N m], its derivative to position and rotation [6, 6], seen points [m], [n,
    3], with theirs [3 n, 6], and the greatest principal strain. If not ``converged``, these are of
    the last equilibrium. ``bends``: changes of the stiffness, first over the displacement from an
    earlier solution, then over those tried when the gripper closed."""

    frame: np.ndarray
    wrench: np.ndarray
    stiffness: np.ndarray
    points: np.ndarray
    point_slopes: np.ndarray
    peak_strain: float
    seconds: float
    converged: bool
    bends: Bends = NO_BENDS

    def wrench_at(self, patch: np.ndarray, compliance: float) -> np.ndarray:
        """Return the wrench [6] at the frame ``patch`` of a rigid gripper, near the solution's own;
        the patch stays behind by ``compliance`` [m/N] times the force."""
        return steer(self.frame, self.wrench, self.stiffness, *self.bends, patch, compliance)

    def change_to(self, patch: np.ndarray) -> np.ndarray:
        """Return the translation [m] and rotation [rad] to another frame of the patch, shape [6].
        """
        return np.concatenate((patch[:3, 3] - self.frame[:3, 3],
                               rotation_vector(patch @ inverse_of(self.frame))))

    def bend_from(self, before: Solution) -> Bends:
        """Return the change of stiffness from another solution; none if it is unknown."""
        offset = self.frame[:3, 3] - before.frame[:3, 3]
        if not (self.converged and before.converged and np.linalg.norm(offset) > _LEAST_WAY):
            return NO_BENDS
        return offset[None], (self.stiffness - before.stiffness)[None]

    def add_predictions(self, past: Sequence[Solution], tried: Bends) -> None:
        """Set the bends from ``past`` solutions, the latest first; else copy the latest's."""
        for before in past:
            newest = self.bend_from(before)
            if len(newest[0]):
                self.bends = joined(newest, tried)
                return
        # It hardly moved: the earlier bends still hold.
        self.bends = past[0].bends if past else tried


_SOLVER_PRIORITY = 10
_REST = 0.25  # fraction of a solution's time: a process that never rests is throttled by the system
SAME_PLACE = 1e-6  # m, rad; the tangent extrapolates exactly over it
_TOLERANCE = 1e-5  # of the residual relative to the forces: far below a sensor's resolution
_MOST_STEPS = 2.0  # distance between two solutions, over which a change is extrapolated
_TRIED_WAY = 3e-3  # m across the branch when the gripper has closed


@dataclass(frozen=True)
class BranchSetting:
    """A branch and its position beside the virtual robot.

    Attributes:
        mesh: File of the true branch: tetrahedra with ``young``, ``poisson``, ``density`` and
            ``fixed``, in the hanging shape.
        base_pose: The robot's base in the branch's frame [m, rad], shape [6].
        grasp_pose: The gripper's middle in the flange's frame [m, rad], shape [6].
        points: Visible points of the branch (markers), [m], shape [n, 3].
        gravity: In the branch's frame [m/s^2], or zeros for a branch without weight.
        jaw: Half width of the gripped section along the branch [m].
        grip: Force at which the branch slips out of the grip [N].
        break_strain: Greatest principal strain before the branch breaks.
        compliance: Compliance of arm, fingers and bark [m/N].
    """

    mesh: Path
    base_pose: tuple[float, ...]
    grasp_pose: tuple[float, ...]
    points: tuple[tuple[float, ...], ...] = ()
    gravity: tuple[float, ...] = (0.0, 0.0, 0.0)
    jaw: float = 0.012
    grip: float = 80.0
    break_strain: float = 0.2
    compliance: float = 0.0

    @classmethod
    def of_truth(cls, truth: Any, cell: Any, path: Path, *, poisson: float = 0.35,
                 density: float = 900.0, wave: float = 0.0) -> BranchSetting:
        """Return the setting of a :class:`~limber.estimation.simulated_pull.TrueBranch` in a cell,
        its mesh at ``path``, control points and tip seen; ``wave``: deviation of log E between the
        control points from the linear course that a fit assumes."""
        from limber.mechanics.materials.materials import young_weights

        mesh, count = truth.mesh, truth.mesh.tet_count
        weights = young_weights(mesh, truth.control_points)
        # 0 at the control points, largest in the middle between two of them, alternately up and
        # down.
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


class BranchSolver:
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
        self._grasp: Grasp | None = None
        self._held = self._model
        self._state = np.zeros_like(mesh.nodes)
        self._last: Solution | None = None
        self._follows: np.ndarray | None = None
        # Change of that since the solution before, and the displacement over which it changed.
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
        """Present positions of the seen points [m], shape [n, 3]."""
        if self._operator is None:
            return self._points
        return self._points + (self._operator @ self._state.ravel()).reshape(-1, 3)

    def look(self, camera: dict[str, Any], is_held: bool) -> bytes:
        """Return a depth camera's noisy image of the branch, at rest if not held: 16 bits a pixel,
        packed."""
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
        """Change of stiffness in two directions across the branch, with its free rotation."""
        solution, state, follows = self._last, self._state, self._follows
        if solution is None:
            return NO_BENDS
        stiffness = solution.stiffness
        axes = np.linalg.eigh(stiffness[:3, :3] + stiffness[:3, :3].T)[1]
        bends = NO_BENDS
        for offset in _TRIED_WAY * axes.T[:2]:
            turn = -np.linalg.solve(stiffness[3:, 3:], stiffness[3:, :3] @ offset)
            moved = self.solve(frame_of(np.r_[solution.frame[:3, 3] + offset, turn]))
            bends = joined(bends, moved.bend_from(solution))
        self._state, self._last, self._follows, self._turning = state, solution, follows, None
        return bends

    def solve(self, patch: np.ndarray) -> Solution:
        """Return the solution at a frame of the patch; the last one if there is none."""
        from limber.mechanics.sensitivities import grasp_slopes
        from limber.mechanics.statics.result import StaticSettings
        from limber.mechanics.statics.solve import follow_poses
        from limber.mechanics.strain import peak_load

        assert self._grasp is not None
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
            offset = patch[:3, 3] - self._last.frame[:3, 3]
            if np.linalg.norm(offset) > SAME_PLACE:
                self._turning = offset, slopes.displacement - self._follows
        self._follows = slopes.displacement
        points = (np.zeros((0, 6)) if self._operator is None
                  else self._operator @ slopes.displacement.reshape(-1, 6))
        self._last = Solution(
            patch, np.r_[result.reaction_force, result.reaction_torque], slopes.wrench,
            self.seen(), points, peak_load(self._held, self._state)[0], result.seconds,
            result.converged)
        return self._last

    def _guessed(self, patch: np.ndarray) -> np.ndarray | None:
        """Approximate positions of the nodes at a frame of the patch, [node_count, 3], from the
        tangent of the solution before and its change."""
        if self._last is None or self._follows is None:
            return None
        change, follows = self._last.change_to(patch), self._follows
        if self._turning is not None:
            axis, turning = self._turning
            part = float(np.clip(change[:3] @ axis / (axis @ axis), -_MOST_STEPS, _MOST_STEPS))
            follows = follows + 0.5 * part * turning
        return self._state + follows @ change


def solve_for_ever(setting: BranchSetting, pipe: Connection) -> None:
    solver = BranchSolver(setting)
    # Below the arm's own loop; above other programs, which would delay the branch's force.
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
        # The robot has ended, and no other process asks.
        return
