"""What drives a branch over time: grasps along poses or with forces, loads, gravity."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError
from limber.core.not_none import present
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.equations import Equations
from limber.mechanics.model import BranchModel, MotionState
from limber.mechanics.statics.equilibrium_path import checked_forces
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.solve import solve_static

# The motion of grasps between given poses: smooth, with velocity and acceleration.

_DIFFERENCE = 2e-5
"""Time difference [s] for velocity and acceleration of the patch's nodes."""


class PosePath:
    """Poses [frames, 6] or [frames, grasps, 6] [m, rad] over time: a cubic spline from standstill,
    rotation vectors unwrapped. InputError if shapes do not fit or values are not finite."""

    def __init__(self, grasps: Sequence[Grasp], rest: np.ndarray, times: np.ndarray,
                 poses: np.ndarray):
        from scipy.interpolate import CubicSpline

        expected = (len(times), len(grasps), 6)
        poses = np.asarray(poses, float)
        if poses.size != np.prod(expected) or not np.isfinite(poses).all():
            raise InputError(f"The poses have shape {poses.shape} or are not finite.",
                             f"{len(times)} times and {len(grasps)} grasps need shape {expected}.",
                             "Give x, y, z [m] and a rotation vector [rad] for each.")
        self.grasps, self._rest = list(grasps), rest
        self.poses = unwrapped(poses.reshape(expected))
        self.clamped = [g for g in self.grasps if g.mode == "rigid"]
        self.pinned = [g for g in self.grasps if g.mode == "point"]
        self._spline = None
        if len(times) > 1:
            self._spline = CubicSpline(times, self.poses, axis=0,
                                       bc_type=((1, np.zeros(expected[1:])),
                                                (2, np.zeros(expected[1:]))))

    def at(self, instant: float) -> tuple[list[list[np.ndarray]], list[np.ndarray]]:
        """Return displacement, velocity and acceleration at a time [s]: three lists of [k, 3] for
        the clamped grasps' nodes, and three arrays [pinned, 3] for the pinned means."""
        before, now, after = (self._placed(instant + shift)
                              for shift in (-_DIFFERENCE, 0.0, _DIFFERENCE))
        held = [now[0],
                [(b - a) / (2 * _DIFFERENCE) for a, b in zip(before[0], after[0], strict=True)],
                [(a - 2 * m + b) / _DIFFERENCE**2
                 for a, m, b in zip(before[0], now[0], after[0], strict=True)]]
        pins = [now[1], (after[1] - before[1]) / (2 * _DIFFERENCE),
                (before[1] - 2 * now[1] + after[1]) / _DIFFERENCE**2]
        return held, pins

    def _placed(self, instant: float) -> tuple[list[np.ndarray], np.ndarray]:
        poses = self.poses[0] if self._spline is None else self._spline(instant)
        held, pins = [], []
        for grasp, pose in zip(self.grasps, poses, strict=True):
            if grasp.mode == "rigid":
                held.append(grasp.displacement(self._rest, pose))
            else:
                pins.append(pose[:3] - grasp.centre)
        return held, np.reshape(pins, (-1, 3))


def unwrapped(poses: np.ndarray) -> np.ndarray:
    """Return poses [frames, grasps, 6] whose rotation vectors do not jump by a full turn."""
    result = poses.copy()
    for frame in range(1, len(result)):
        for number in range(result.shape[1]):
            vector, last = result[frame, number, 3:], result[frame - 1, number, 3:]
            angle = np.linalg.norm(vector)
            if angle < 1e-12:
                # A zero rotation has no unique axis: a full turn about the last axis may be nearer.
                size = np.linalg.norm(last)
                turns = np.round(size / (2 * np.pi))
                result[frame, number, 3:] = last / size * 2 * np.pi * turns if turns else 0.0
                continue
            axis = vector / angle
            turns = np.round((last @ axis - angle) / (2 * np.pi))
            result[frame, number, 3:] = vector + axis * 2 * np.pi * turns
    return result


class Drive:
    """Loads and constraints of a motion; arguments as for simulate_dynamics. ``path`` is None if no
    grasp follows poses. InputError if the arguments contradict each other."""

    def __init__(self, model: BranchModel, grasp: Grasp | Sequence[Grasp] | None,
                 poses: np.ndarray | None, grasp_forces: np.ndarray | None,
                 nodal_forces: np.ndarray | None, times: np.ndarray):
        self.model, self.times = model, _checked_times(times)
        self.single = isinstance(grasp, Grasp)
        self.grasps = ([] if grasp is None else [grasp] if isinstance(grasp, Grasp)
                       else list(grasp))
        self.path: PosePath | None = None
        if poses is not None:
            if not self.grasps or grasp_forces is not None:
                raise InputError("Poses are given without a grasp, or together with grasp forces.",
                                 "A grasp follows poses or exerts a force, not both.",
                                 "Omit one of them.")
            self.path = PosePath(self.grasps, model.mesh.nodes, self.times, poses)
        self._weight = model.weight_force
        self._nodal_forces = self._checked_nodal_forces(nodal_forces)
        self._grasp_forces = self._checked_grasp_forces(grasp_forces)
        self.equations: Equations = model.equations(self.grasps if self.path else ())
        self._known: tuple[float, tuple] | None = None

    def load_at(self, instant: float) -> np.ndarray:
        """Return nodal loads [N] at a time."""
        load = self._weight.copy()
        if self._nodal_forces is not None:
            load += self._between(self._nodal_forces, instant)
        if self._grasp_forces is None:
            return load
        for number, grasp in enumerate(self.grasps):
            force = self._between(self._grasp_forces[:, number], instant)
            load[grasp.nodes] += grasp.weights[:, None] * force
        return load

    def equilibrium(self) -> StaticResult:
        """Return the equilibrium under the pose and the loads of the first time. ConvergenceError
        if no equilibrium exists."""
        pose = self.path.poses[0] if self.path else None
        force = None if self._grasp_forces is None else self._grasp_forces[0]
        loads = None if self._nodal_forces is None else self._nodal_forces[0]
        return solve_static(self.model, grasp=self.grasps or None, pose=pose, grasp_force=force,
                            nodal_forces=loads).require()

    def moves(self, state: MotionState) -> tuple[np.ndarray | None, np.ndarray]:
        """Return how held nodes [node_count, 3] (None if they do not) and pinned means [pinned, 3]
        have to move to reach the path [m]."""
        if not self.path:
            return None, np.zeros((0, 3))
        held, means = self._at(state.time)
        moved = np.zeros_like(state.displacement)
        for grasp, patch in zip(self.path.clamped, held[0], strict=True):
            moved[grasp.nodes] = patch - state.displacement[grasp.nodes]
        now = np.array([g.weights @ state.displacement[g.nodes] for g in self.path.pinned])
        return (moved if moved.any() else None), means[0] - now.reshape(-1, 3)

    def hold(self, state: MotionState) -> None:
        """Set velocity and acceleration of held nodes to the path's."""
        if self.path:
            held, _ = self._at(state.time)
            for values, motion in zip((state.velocity, state.acceleration), held[1:],
                                      strict=True):
                for grasp, patch in zip(self.path.clamped, motion, strict=True):
                    values[grasp.nodes] = patch

    def impose(self, state: MotionState) -> None:
        """Set the motion of held nodes and of the means of pinned patches to the path's."""
        path = present(self.path, "path of the grasps")
        held, pins = self._at(state.time)
        fields = (state.displacement, state.velocity, state.acceleration)
        for field_, values, means in zip(fields, held, pins, strict=True):
            for grasp, patch in zip(path.clamped, values, strict=True):
                field_[grasp.nodes] = patch
            for grasp, mean in zip(path.pinned, means, strict=True):
                field_[grasp.nodes] += mean - grasp.weights @ field_[grasp.nodes]

    def _at(self, instant: float) -> tuple:
        if self._known is None or self._known[0] != instant:
            self._known = (instant, present(self.path, "path of the grasps").at(instant))
        return self._known[1]

    def _between(self, values: np.ndarray, instant: float) -> np.ndarray:
        """Return the values at a time, linear between frames of shape [frames or 1, ...]."""
        if len(values) == 1:
            return values[0]
        after = int(np.clip(np.searchsorted(self.times, instant), 1, len(self.times) - 1))
        first, last = self.times[after - 1:after + 1]
        part = np.clip((instant - first) / (last - first), 0.0, 1.0)
        return (1.0 - part) * values[after - 1] + part * values[after]

    def _checked_nodal_forces(self, forces: np.ndarray | None) -> np.ndarray | None:
        if forces is None:
            return None
        shape = (self.model.mesh.node_count, 3)
        forces = np.asarray(forces, float)
        if forces.ndim < 3:
            return checked_forces(forces, shape)[None]
        return checked_forces(forces, (len(self.times), *shape))

    def _checked_grasp_forces(self, forces: np.ndarray | None) -> np.ndarray | None:
        if forces is None:
            return None
        expected = (len(self.times), len(self.grasps), 3)
        values = np.asarray(forces, float)
        if not self.grasps or values.size != np.prod(expected) or not np.isfinite(values).all():
            raise InputError(f"The grasp forces have shape {values.shape}.",
                             f"{len(self.times)} times and {len(self.grasps)} grasps need shape "
                             f"{expected}.", "Give three numbers [N] for each.")
        return values.reshape(expected)


def _checked_times(times: np.ndarray) -> np.ndarray:
    times = np.asarray(times, float)
    if times.ndim != 1 or len(times) < 1 or not np.isfinite(times).all() or (
            np.diff(times) <= 0).any():
        raise InputError("The times are not ascending.", "Each frame must be later than the last.",
                         "Sort them and remove duplicates.")
    return times


# A gripper's path as a table of poses, from a recording or a plan.


@dataclass(frozen=True)
class PoseTable:
    """Poses [n, 6] [m, rad] of a gripper at ascending times [s]; only the motion relative to the
    first pose matters. InputError if under two poses, or values that are not finite."""

    times: np.ndarray
    poses: np.ndarray

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.times), 6) or len(self.times) < 2 or not (
                np.isfinite(self.poses).all() and np.isfinite(self.times).all()
                and np.all(np.diff(self.times) > 0)):
            raise InputError(f"The table has {len(self.times)} times and poses of shape "
                             f"{self.poses.shape}.",
                             "A path needs at least two finite poses at ascending times.",
                             "Give t_s, x_m, y_m, z_m, rx_rad, ry_rad, rz_rad in each row.")

    @property
    def duration(self) -> float:
        """Duration from the first pose to the last [s]."""
        return float(self.times[-1] - self.times[0])

    def changes(self, times: np.ndarray) -> np.ndarray:
        """Return displacement and rotation since the first pose [m, 6], at times [m] [s] since it;
        after the last pose the gripper stays there."""
        from scipy.spatial.transform import Rotation, Slerp

        since = self.times - self.times[0]
        at = np.clip(times, 0.0, since[-1])
        moved = np.column_stack([np.interp(at, since, column - column[0])
                                 for column in self.poses[:, :3].T])
        turns = Rotation.from_rotvec(self.poses[:, 3:].copy())
        turned = Slerp(since, turns * turns[0].inv())(at).as_rotvec()
        return np.hstack([moved, turned])

    def digest(self) -> str:
        """Key that distinguishes one path from another."""
        return hashlib.sha256(np.column_stack([self.times, self.poses]).tobytes()).hexdigest()
