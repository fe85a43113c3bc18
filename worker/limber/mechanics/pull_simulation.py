"""A pull as described by settings: the loaded branch, the grasp and its motion."""


from collections.abc import Sequence
from typing import Literal

import numpy as np

from limber.core.errors import InputError
from limber.core.not_none import present
from limber.core.numerics.rigid import composed
from limber.core.progress import SILENT, Progress
from limber.mechanics.added_masses import PointMass
from limber.mechanics.dynamics.load_case import (
    LoadCase,
    SimulatedMotion,
    dynamic_motion,
    static_motion,
)
from limber.mechanics.dynamics.motion import EnergyMomentumSettings, MotionSettings, NewmarkSettings
from limber.mechanics.dynamics.pose_table import PoseTable
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.settings import Point, SimulateSettings
from limber.mechanics.statics.solve import solve_static

_PROBE = 1e-6
"""Force [N] small enough that the branch responds linearly."""
_DEFAULT_BEND = 0.2
"""Default bending, as a fraction of the distance from base to grasp. Chosen, not measured."""


def bending_force(model: BranchModel, grasp: Grasp) -> np.ndarray:
    """Return the transverse force that bends the branch by a fifth of its reach [N], shape [3].

    From the stiffness at rest. A motion along an arbitrary line in space would buckle or stretch a
    branch, whose length is fixed; under a force it moves where it can.
    """
    axis = grasp.centre - model.mesh.nodes[model.fixed].mean(axis=0)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    weightless = model.with_parameters(gravity=(0.0, 0.0, 0.0))
    probe = solve_static(weightless, grasp=grasp, grasp_force=_PROBE * across).require()
    moved = np.linalg.norm(grasp.weights @ probe.displacement[grasp.nodes])
    return _PROBE * _DEFAULT_BEND * np.linalg.norm(axis) / moved * across


def load_case_of(model: BranchModel, settings: SimulateSettings, along: PoseTable | None = None,
                 grasp_point: np.ndarray | Sequence[float] | None = None) -> LoadCase:
    """Return the load case that settings request.

    Args:
        model: Model of the scan, on which positions are given.
        settings: Settings of the pull.
        along: The grasp's path instead of a motion of the settings.
        grasp_point: The position of the marked grasp [m]; None: the patch's centre.

    Raises:
        InputError: options do not fit. ConvergenceError: no equilibrium of the branch was found.
    """
    def patch(point: Point, mode: Literal["rigid", "point"]) -> Grasp:
        if mode == "rigid" and settings.grasp_radius > 0:
            return Grasp.gripping(model.mesh, np.array(point), settings.grasp_radius)
        return Grasp.at(model.mesh, np.array(point), settings.grasp_radius, mode)

    grasp = (Grasp.from_mesh(model.mesh, settings.grasp_mode, grasp_point)
             if settings.grasp_point is None else patch(settings.grasp_point, settings.grasp_mode))
    holds = tuple(patch(point, settings.grasp_mode) for point in settings.hold_at)
    model = model.gripped(grasp, *holds)
    loads = np.zeros_like(model.mesh.nodes)
    for point in settings.load_at:
        loaded = patch(point[:3], "point")
        loads[loaded.nodes] += loaded.weights[:, None] * np.array(point[3:])
    follows_pose = along is not None or settings.move is not None or settings.turn is not None
    force = np.array(settings.grasp_force or (0.0, 0.0, 0.0))
    if not (follows_pose or settings.grasp_force is not None or settings.load_at):
        force = bending_force(model, grasp)
    start = solve_static(model, grasp=[grasp, *holds],
                         grasp_force=np.zeros((1 + len(holds), 3))).require()
    times, part = _ramp(settings, along.duration if along else settings.duration)
    changes = along.changes(times) if along else part[:, None] * np.concatenate(
        [settings.move or (0.0, 0, 0), settings.turn or (0.0, 0, 0)])
    first = present(start.pose, "pose of the grasps")[0]
    return LoadCase(model, start, grasp, follows_pose, holds,
                    _prescribed_path(first, changes, settings.grasp_mode), force, loads, times,
                    part)


def with_masses(model: BranchModel, settings: SimulateSettings) -> BranchModel:
    """Return the model with the added masses of the settings."""
    return model.with_point_masses([PointMass(entry[:3], entry[3]) for entry in settings.mass_at])


def require_one_drive(settings: SimulateSettings, along: PoseTable | None) -> None:
    """Reject more than one of a motion, a path and a force.

    Raises:
        InputError: there are more.
    """
    moves = settings.move is not None or settings.turn is not None
    if (settings.grasp_force is not None) + moves + (along is not None) > 1:
        raise InputError("More than one of a motion, a path and a force is given.",
                         "A grasp follows poses or exerts a force.",
                         "Give --move and --turn, or --along, or --grasp-force.")


def motion_of(case: LoadCase, settings: SimulateSettings,
              progress: Progress = SILENT) -> SimulatedMotion:
    """Pull, quasi-statically or in time."""
    if settings.kind == "static":
        return static_motion(case, progress)
    scheme: MotionSettings = EnergyMomentumSettings(max_step=settings.step)
    if settings.scheme == "newmark":
        scheme = NewmarkSettings(max_step=settings.step, beta=settings.newmark_beta,
                                 gamma=settings.newmark_gamma)
    return dynamic_motion(case, scheme, progress)


def _ramp(settings: SimulateSettings, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and the fraction of the pull at each.

    In motion it starts and ends at rest, and the end pose is held.
    """
    hold = settings.hold if settings.kind == "dynamic" else 0.0
    count = max(2, round((duration + hold) * settings.frame_rate) + 1)
    times = np.arange(count) / settings.frame_rate
    part = np.clip(times / duration, 0, 1)
    return times, part**2 * (3 - 2 * part) if settings.kind == "dynamic" else part


def _prescribed_path(pose: np.ndarray, changes: np.ndarray, mode: str) -> np.ndarray:
    """Return the grasp's poses [frames, 6], starting at its pose on the loaded branch."""
    if mode == "point":
        pose = np.concatenate([pose[:3], np.zeros(3)])
    return np.hstack([pose[:3] + changes[:, :3], composed(changes[:, 3:], pose[3:])])
