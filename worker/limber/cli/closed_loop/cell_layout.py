"""Positions in the loop's cell: the robot, its gripper at the branch, touched marks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from limber.cell.arm import Arm
from limber.cell.cell_file import Cell, LimitsEntry
from limber.core.errors import NoPathError
from limber.core.files.tables import write_table
from limber.core.numerics.rigid import any_normal, inverted, matrices, pose_vectors
from limber.estimation.forward.observed_path import force_for_travel
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics import solve_static
from limber.recordings.recording import POSE_COLUMNS
from limber.robot.motion.execution import across
from limber.robot.motion.joint_path import JointPath, follow
from limber.robot.motion.trajectory import densely
from limber.store import Branch
from limber.store.loading import load_grasp_model

GRASP_FRACTION = 0.85
"""Position of the grasp on the branch's main path."""
_AROUND_M = 0.06  # the gripper must reach this far around the grasp
_RIM_M = 0.12  # radius of the pot's rim, which has marks to touch
_MARKS = 6
_SINGULARITY = 0.08

IsMet = Callable[[np.ndarray, np.ndarray], bool]
"""Whether flange frames [n, 4, 4] at joints [n, 6] meet something."""


def bending_modulus(skeleton: Skeleton, fraction: float, force: float, travel: float) -> float:
    """Return the modulus [Pa] with which ``force`` [N] across a branch, at a fraction of its main
    path, moves it by ``travel`` [m]: by slender beam theory of the straight branch, the virtual
    work of the force."""
    path = skeleton.main_path()
    along, radius = skeleton.arc_length[path], skeleton.radius[path]
    distance = fraction * along[-1]
    at = np.linspace(0.0, distance, 400)
    arms, radii = distance - at, np.interp(at, along, radius)
    return float(force / travel * scipy.integrate.trapezoid(arms**2 / (np.pi / 4 * radii**4), at))


def base_beside(arm: Arm, tool: np.ndarray, point: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the base pose [6] from which an upright arm best reaches a branch at ``point`` [m, 3]
    with its axis there [3], branch frame; ``tool``: the grasp's frame in the flange's, [4, 4].
    NoPathError if there is none around it."""
    best: tuple[float, np.ndarray] | None = None
    for turn in np.arange(6) * np.pi / 3:
        aside = np.array([np.cos(turn), np.sin(turn), 0.0])
        for distance in (0.6, 0.8):
            for below in (0.15, 0.3):
                pose = np.r_[point + distance * arm.reach * aside - [0, 0, below], 0, 0, turn]
                held = _held(arm, pose, tool, point, axis)
                if held is not None and (best is None or held[0].singularity > best[0]):
                    best = held[0].singularity, pose
    if best is None:
        raise NoPathError(f"A {arm.name} cannot reach the branch from any position around it.",
                          "The branch is too large, or grows where the arm cannot turn.",
                          "Use a larger arm.")
    return best[1]


def gripper_at(cell: Cell, point: np.ndarray, axis: np.ndarray, is_met: IsMet | None = None,
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return joints [rad, 6] and the gripper's rotation [rad, 3] with the gripper on the branch;
    NoPathError if it does not reach the surroundings of that point, or ``is_met`` there."""
    found = _held(cell.arm, np.array(cell.base.pose), matrices(np.array(cell.tool.grasp_pose)),
                  point, axis, is_met)
    if found is None:
        raise NoPathError("The arm cannot reach around the grasp.", "", "Move its base, or grasp "
                          "the branch elsewhere.")
    return found[0].joints[0], found[1]


def _held(arm: Arm, base: np.ndarray, tool: np.ndarray, point: np.ndarray, axis: np.ndarray,
          is_met: IsMet | None = None) -> tuple[JointPath, np.ndarray] | None:
    """The arm motion slightly around a grasp that stays farthest from singularities."""
    best: tuple[JointPath, np.ndarray] | None = None
    for rotation in across(axis):
        # To each side and back, then to a place before the branch.
        way = np.tile(matrices(np.r_[point, rotation]), (14, 1, 1))
        way[1:12:2, :3, 3] += _AROUND_M * np.vstack([np.eye(3), -np.eye(3)])
        way[13, :3, 3] -= 0.08 * way[13, :3, 2]
        frames = inverted(matrices(base)) @ way
        steps = matrices(densely(pose_vectors(frames), spacing=0.015)) @ inverted(tool)
        paths, _refusals = follow(arm, steps, singularity_margin=_SINGULARITY)
        if paths and (best is None or paths[0].singularity > best[0].singularity) and not (
                is_met and is_met(steps, paths[0].joints)):
            best = paths[0], rotation
    return best


def write_touched(path: Path, base: np.ndarray, moved: np.ndarray, axis_points: np.ndarray,
                  sigma: float, rng: np.random.Generator) -> None:
    """Write points for `limber robot calibrate`, on the branch and as touched with an error of
    ``sigma`` [m] per axis: ``axis_points`` [m], [n, 3], in the scan's frame, as ``base`` [m, rad],
    the robot's true one, is; ``moved`` [m], [3], leads to the branch's."""
    turn = np.arange(_MARKS) * 2 * np.pi / _MARKS
    rim = _RIM_M * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    points = np.vstack([rim, axis_points])
    touched = np.tile(np.zeros(6), (len(points), 1))
    touched[:, :3] = points @ matrices(base)[:3, :3] + inverted(matrices(base))[:3, 3]
    touched[:, :3] += sigma * rng.standard_normal((len(points), 3))
    names = [f"rim-{number + 1}" if number < _MARKS else f"branch-{number + 1 - _MARKS}"
             for number in range(len(points))]
    rows = zip(names, points + moved, touched, strict=True)
    write_table(path, ("name", "x_m", "y_m", "z_m", *(f"robot_{name}" for name in POSE_COLUMNS)),
                ((name, *point, *pose) for name, point, pose in rows), digits=7)


def grasp_of(skeleton: Skeleton, fraction: float = GRASP_FRACTION) -> tuple[np.ndarray, np.ndarray]:
    """A position on the main path [m] and the branch's axis there, shape [3] each."""
    point = skeleton.point_at(fraction)
    axis = point - skeleton.point_at(fraction - 0.05)
    return point, axis / np.linalg.norm(axis)


def sideways(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two directions across the line from the root, the origin, to ``point`` [3]."""
    axis = point / np.linalg.norm(point)
    first = any_normal(axis)
    return first, np.cross(axis, first)


# A task for the branch, in sizes that suit the estimated branch.

_FORCE_MARGIN = 2.0
"""Ratio of the largest force of a path to the force that holds the flower at its goal."""
_SOFT_MARGIN, _HARD_MARGIN = 1.3, 1.5
"""Ratio of the guard's pause force to a path's force, and of its stop force to the pause force: the
measured force of a stiff branch differs from its prediction."""
_BEYOND = 1.5
"""Reach of the sampled energy field as a multiple of the distance to the goal."""


@dataclass(frozen=True)
class TaskSizes:
    """A goal for the flower, branch frame [m], shape [3], and the effort to hold it there by the
    branch's model: force of the gripper [N], and displacement of the grasp over the branch's length
    up to it."""

    target: np.ndarray
    holding_force: float
    deflection: float

    @property
    def max_force(self) -> float:
        """Largest force of a path to it [N]."""
        return _FORCE_MARGIN * self.holding_force

    @property
    def sampled_deflection(self) -> float:
        """Required reach of the energy field, as a fraction of the length up to the grasp."""
        return min(_BEYOND * self.deflection, 1.0)

    def limited(self, cell: Cell) -> Cell:
        """Return a cell whose force limits suit the path."""
        soft = _SOFT_MARGIN * self.max_force
        limits = cell.limits.model_dump() | {"soft_force_n": soft,
                                             "hard_force_n": _HARD_MARGIN * soft}
        return cell.model_copy(update={"limits": LimitsEntry.model_validate(limits)})


def wish_for(branch: Branch, direction: np.ndarray, travel: float) -> TaskSizes:
    """Return a position for the branch's first target in which it is bent, neither stretched nor
    compressed: where a force along ``direction`` [3] that moves the grasp by ``travel`` [m] takes
    it. WorkError if no such force moves it so far."""
    model = load_grasp_model(branch, gravity=True)
    size = force_for_travel(model.model, model.grasp, direction, travel)
    state = solve_static(model.model, grasp=model.grasp, grasp_force=size * direction).require()
    gone = np.linalg.norm(model.pose(state.displacement)[:3] - model.rest_position)
    return TaskSizes(model.branch.target_positions(state.displacement)[0],
                     float(size * np.linalg.norm(direction)), float(gone / model.reach.arc_length))
