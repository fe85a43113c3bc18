"""What drives a branch over time: grasps along poses or with forces, loads, gravity."""

from collections.abc import Sequence

import numpy as np

from limber.core.errors import InputError
from limber.core.not_none import present
from limber.mechanics.dynamics.pose_path import PosePath
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.equations import Equations
from limber.mechanics.model import BranchModel
from limber.mechanics.motion_state import MotionState
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.solve import solve_static
from limber.mechanics.statics.static_problem import checked_forces


class Drive:
    """Loads and constraints of a motion; arguments as for simulate_dynamics.

    Attributes:
        times: Times of the frames [s].
        grasps: All grasps; single: whether one was given by itself.
        path: The grasps' motion; None if they do not follow poses.
        equations: Those with pose-driven grasps held.

    Raises:
        InputError: the arguments contradict each other.
    """

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
        """Return the equilibrium under the pose and the loads of the first time.

        Raises:
            ConvergenceError: no equilibrium exists.
        """
        pose = self.path.poses[0] if self.path else None
        force = None if self._grasp_forces is None else self._grasp_forces[0]
        loads = None if self._nodal_forces is None else self._nodal_forces[0]
        return solve_static(self.model, grasp=self.grasps or None, pose=pose, grasp_force=force,
                            nodal_forces=loads).require()

    def moves(self, state: MotionState) -> tuple[np.ndarray | None, np.ndarray]:
        """Return how held nodes and pinned means have to move to reach the path.

        Returns:
            [m], shape [node_count, 3], or None if they do not, and shape [pinned, 3].
        """
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
