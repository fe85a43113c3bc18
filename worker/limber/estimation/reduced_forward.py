"""A slow pull on the reduced model: a millisecond or so a frame, every frame simulated."""

import numpy as np

from limber.errors import InputError
from limber.estimation.alignment import Frames
from limber.estimation.grasping import pose_on
from limber.estimation.objective import Simulated
from limber.estimation.parameters import Values
from limber.estimation.points import point_operator
from limber.estimation.recording import PullEntry
from limber.geometry.tet_mesh import TetMesh
from limber.mechanics.reduced import ReducedModel, ReducedState


class ReducedForward:
    """Simulates one pose-driven pull; see :class:`limber.estimation.objective.Forward`.

    Args:
        name: The pull's name.
        reduced: Reduced model of the branch held at the recorded grasp.
        mesh: Its mesh.
        entry: The pull's settings.
        frames: Aligned frames.
        rest_points: Observed points at rest [m], shape [m, 3].

    Raises:
        InputError: the pull is driven by force; a reduced model is held at poses.
    """

    def __init__(self, name: str, reduced: ReducedModel, mesh: TetMesh, entry: PullEntry,
                 frames: Frames, rest_points: np.ndarray):
        if entry.drive != "pose" or entry.motion != "quasi_static":
            raise InputError(f"{name} is {entry.drive}-driven and {entry.motion}.",
                             "The reduced model is held at poses, slowly.",
                             "Use the full model for this pull.")
        self.name, self.frames, self.entry = name, frames, entry
        self.uses_force = bool(np.isfinite(frames.wrenches[:, :3]).all(axis=1).any())
        self.rest_points = np.asarray(rest_points, float)
        self._reduced = reduced
        columns = reduced.basis.columns.reshape(reduced.size, -1)
        self._observe = np.asarray(point_operator(mesh, self.rest_points) @ columns.T)
        self._poses = [pose_on(reduced.grasp, entry.grasp, pose) for pose in frames.poses]
        self._states: list[ReducedState | None] = [None] * len(self._poses)
        self.untrusted_count = 0

    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        """Return the pull under ``values``; None where a frame finds no equilibrium."""
        if extra:
            raise InputError(f"{', '.join(extra)} cannot be fitted on the reduced model.",
                             "It knows derivatives to Young's modulus alone.",
                             "Use the full model.")
        model = self._reduced.with_young(values.young)
        shape, count = (len(self._poses), len(self.rest_points), 3), len(values.young)
        positions, forces = np.empty(shape), np.empty((len(self._poses), 3))
        d_positions = np.empty((*shape, count)) if sensitivities else None
        d_forces = np.empty((len(self._poses), 3, count)) if sensitivities else None
        before, untrusted = None, 0
        for index, pose in enumerate(self._poses):
            state = model.solve_static(pose, start=self._states[index] or before)
            if not state.converged:
                return None
            untrusted += not state.trusted
            self._states[index] = before = state
            positions[index] = self.rest_points + (self._observe @ state.coordinates
                                                   ).reshape(-1, 3)
            forces[index] = state.reaction_force
            if sensitivities:
                slopes = model.sensitivities(state)
                d_positions[index] = (self._observe @ slopes.coordinates).reshape(*shape[1:],
                                                                                  count)
                d_forces[index] = slopes.reaction_force
        self.untrusted_count = untrusted
        return Simulated(positions, forces, d_positions, d_forces)
