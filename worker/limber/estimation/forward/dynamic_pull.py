"""A fast pull, simulated over time with inertia and damping."""

from dataclasses import replace

import numpy as np

from limber.core.errors import InputError, Option
from limber.core.not_none import present
from limber.estimation.forward.forward_model import (
    Forward,
    Response,
    Simulated,
    carries_its_weight,
    motion_response,
    nodal_loads,
    under_its_weight,
)
from limber.estimation.parameters import Values, YoungField, mechanics_names
from limber.mechanics.dynamics.integration import simulate_dynamics
from limber.mechanics.dynamics.motion import NewmarkSettings
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import ParameterSet
from limber.recordings.recording import PullEntry, grasp_on, pose_on
from limber.recordings.synchronisation import Frames


class DynamicForward(Forward):
    """Simulates one pull by Newmark steps. Arguments as for
    :class:`limber.estimation.forward.quasi_static.QuasiStaticForward`. Every frame is simulated."""

    is_dynamic = True

    def __init__(self, name: str, model: BranchModel, weights: np.ndarray, entry: PullEntry,
                 frames: Frames, rest_points: np.ndarray, *, field: YoungField | None = None):
        super().__init__(name, entry, frames, rest_points)
        measured = np.isfinite(frames.wrenches[:, :3]).all(axis=1)
        if entry.drive == "force" and not measured.all():
            raise InputError(f"{name}: {np.sum(~measured)} frames have no force.",
                             "A force-driven motion needs the force in every frame.",
                             "Use ", Option("drive", "pose"), ".")
        if self.drive == "force" and entry.grasp.mode == "rigid":
            raise InputError(
                f"{name}: the force of a clamped gripper drives a dynamic simulation.",
                "A clamped gripper also bends the branch by a torque, but only a force can drive "
                "a dynamic simulation.",
                "Use ", Option("drive", "pose"), ". If the branch could turn in the gripper, set "
                'mode = "point" under [grasp] in pull.toml.')
        self._forces = frames.wrenches[:, :3]
        self._arguments = (name, model, weights, entry)
        self.weights = weights
        self.field = field or YoungField(weights)
        self.grasp = grasp_on(model.mesh, entry.grasp)
        self._model = under_its_weight(model, entry).gripped(self.grasp)
        self._operator = point_operator(model.mesh, self.rest_points)
        self._directions = self._directions_on(model.mesh)
        # Only the nodes that determine the observed points need derivatives.
        self._nodes = np.unique(self._operator.indices // 3)
        columns = (3 * self._nodes[:, None] + np.arange(3)).ravel()
        self._near = self._operator[:, columns]

    @property
    def has_force_unknowns(self) -> bool:
        return self.drive == "force"

    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        model = self._model_with(values)
        frames, by_pose = self.frames, self.drive == "pose"
        drive = ({"poses": np.array([pose_on(self.grasp, self.entry.grasp, pose)
                                     for pose in frames.poses])} if by_pose
                 else {"grasp_forces": self._forces})
        parameters = ParameterSet(mechanics_names(extra), shares=self.field.shares(values, extra))
        asked = {"sensitivities": parameters,
                 "sensitivity_nodes": self._nodes} if sensitivities else {}
        # The same scheme with and without derivatives: one loss, one minimum.
        result = simulate_dynamics(model, grasp=self.grasp, times=frames.times,
                                   settings=NewmarkSettings(), **drive, **asked)
        if not result.converged:
            return None
        moved = (self._operator @ result.displacement.reshape(len(frames), -1).T).T
        positions = self.rest_points + moved.reshape(len(frames), -1, 3)
        if self._directions is not None:
            self.point_directions = np.array([self._directions.bent(each)
                                              for each in result.displacement])
        forces = result.reaction_force if by_pose else self._forces
        if not sensitivities:
            return Simulated(positions, forces)
        if self.response is None and not by_pose:
            self.response = self._response(model)
        slopes = present(result.sensitivities, "derivative of the motion")
        count = slopes.displacement.shape[-1]
        # Damping enters the fit by its logarithm.
        scale = np.array([*np.ones(len(values.young)), *(
            {"alpha": values.damping[0], "beta": values.damping[1]}.get(name, 1.0)
            for name in extra)])
        flat = slopes.displacement.reshape(len(frames), -1, count)
        d_positions = np.stack([(self._near @ frame).reshape(-1, 3, count) for frame in flat])
        d_forces = slopes.reaction_force if by_pose else np.zeros((len(frames), 3, count))
        return Simulated(positions, forces, d_positions * scale, d_forces * scale)

    def _model_with(self, values: Values) -> BranchModel:
        return self._model.with_parameters(
            young=self.field.young(values), poisson=values.poisson, density=values.density,
            damping=RayleighDamping(*values.damping))

    def stands(self, values: Values) -> bool:
        return carries_its_weight(self._model_with(values))

    def until(self, count: int) -> "DynamicForward":
        """Return the first frames, driven by force if known: on a prescribed path wrong moduli give
        a thousandfold force, under a force the branch merely moves too far."""
        name, model, weights, entry = self._arguments
        measured = np.isfinite(self.frames.wrenches[:, :3]).all()
        if measured and entry.grasp.mode == "point":
            entry = entry.model_copy(update={"drive": "force"})
        return DynamicForward(name, model, weights, entry, self.frames[:count], self.rest_points,
                              field=self.field)

    def with_prescribed_poses(self, poses: np.ndarray) -> "DynamicForward":
        name, model, weights, entry = self._arguments
        return DynamicForward(name, model, weights, entry, replace(self.frames, poses=poses),
                              self.rest_points, field=self.field)

    def shift_force(self, change: np.ndarray) -> None:
        self._forces = self._forces + change.reshape(-1, 3)
        self.response = None

    def under_readings(self, simulated: Simulated) -> Simulated:
        if self.response is None:
            return simulated
        change = (self.frames.wrenches[:, :3] - self._forces).ravel()
        return replace(simulated, positions=simulated.positions + self.response.points @ change,
                       forces=np.full_like(simulated.forces, np.nan))

    def _response(self, model: BranchModel) -> Response:
        loads = nodal_loads(self.grasp, self.entry.grasp, self.frames.poses[0],
                            model.mesh.nodes, 3)
        count = len(self.frames)
        points = motion_response(model, loads, self._operator, self.frames.times)
        return Response(points, np.eye(3 * count).reshape(count, 3, 3 * count))
