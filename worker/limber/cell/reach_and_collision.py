"""Reach and collision of an arm with its gripper: their rods against obstacles, branch, itself."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from limber.cell.arm import Arm, Rods
from limber.cell.cell_file import Cell, SecondArmEntry
from limber.cell.known_arms import arm_named
from limber.cell.obstacles import Limbs, Obstacle, closest
from limber.core.errors import NoPathError
from limber.core.numerics.rigid import inverted, matrices
from limber.geometry.skeleton.skeleton import Skeleton

GRIPPER = "gripper"
"""Name of the gripper's rods."""
CLEAR_M = 0.02
"""Distance kept between an arm that moves alone and everything else [m]."""
_SPACING_M, _FINE_M = 0.03, 0.005  # m between points along a rod; where its distance is reported
_ROD_SPACING = 0.02  # [m] between points along a rod that follows a planned path
_POSE_SPACING = 0.01  # [m] largest step of a rod between checked poses
_BETWEEN = 0.006  # [m] added to the rods' radii for the motion between poses
_TURNS = 200  # directions from which a second arm may approach a target
_DEVIATIONS = 2.0  # standard deviations of the branch's position that a clearance covers
_AT_REST = 0.9  # fraction of the clearance at rest that is kept at most if none was requested

Blocked = Callable[[np.ndarray, np.ndarray], NoPathError | None]
"""Obstacles to flange frames [n, 4, 4] at joint angles [n, joints]; None if there are none."""


def rods_of(cell: Cell, joints: np.ndarray, flange: np.ndarray | None = None) -> Rods:
    """Return the rods of arm and gripper at joint angles [n, joints], base frame; ``flange``: its
    frames there, if known, [n, 4, 4]."""
    flange = cell.arm.forward(joints) if flange is None else flange
    return cell.arm.rods(joints).joined(_stated_gripper(cell, flange))


def drawn_arm(arm: Arm, joints: np.ndarray, base: np.ndarray) -> Rods:
    """Return the rods of an arm's foot and links at joint angles [n, joints]; ``base``: its frame
    in theirs, [4, 4]."""
    links = arm.rods(joints).placed(base)
    first = links.starts[:, :1]
    foot = np.broadcast_to(base[:3, 3], first.shape)
    return Rods(("foot",), foot, first, links.radii[:1]).joined(links)


def drawn_gripper(cell: Cell, flange: np.ndarray) -> Rods:
    """Return the stated shape of the gripper, or a rod from the flange to the grasp, with the
    flange at frames [n, 4, 4].
    """
    if cell.tool.parts:
        return _stated_gripper(cell, flange)
    grasp = (flange @ matrices(np.array(cell.tool.grasp_pose)))[:, None, :3, 3]
    return Rods((GRIPPER,), flange[:, None, :3, 3], grasp, np.array([0.5 * cell.arm.link_radius]))


def _stated_gripper(cell: Cell, flange: np.ndarray) -> Rods:
    parts = cell.tool.parts
    starts, ends = (
        np.array([flange[:, :3, :3] @ np.array(end) + flange[:, :3, 3] for end in each]).reshape(
            len(parts), len(flange), 3).swapaxes(0, 1)
        for each in ([part.start_m for part in parts], [part.end_m for part in parts]))
    return Rods((GRIPPER,) * len(parts), starts, ends, np.array([part.radius_m for part in parts]))


class ArmSurroundings:
    """Computes the distance of a cell's arm with its gripper from all obstacles, branch frame, and
    from the branch, if there is one."""

    def __init__(self, cell: Cell, obstacles: tuple[Obstacle, ...], branch: Skeleton | None):
        self._cell, self._obstacles = cell, obstacles
        self._base = matrices(np.array(cell.base.pose))
        self._branch = None if branch is None else Limbs.of(branch)
        rods = rods_of(cell, np.array(cell.arm.home)[None])
        # Neighbours overlap by their shape; so do links that touch in the home pose.
        self._pairs = [pair for pair in combinations(range(len(rods.radii)), 2)
                       if pair[1] - pair[0] > 1 and _apart(rods, *pair)[0] > 0.0]

    def free(self, joints: np.ndarray) -> np.ndarray:
        """Return whether joint angles [n, joints] keep the clearance :data:`CLEAR_M`, shape [n].
        """
        return self.clearance(joints) > CLEAR_M

    def clearance(self, joints: np.ndarray) -> np.ndarray:
        """Return the smallest distance to any obstacle at joint angles [n, joints] [m], shape [n].
        """
        rods = rods_of(self._cell, joints)
        # Links of one arm may come closer to each other than to objects with uncertain positions.
        found = np.minimum(self._from_itself(rods) + CLEAR_M, self._from_obstacles(rods))
        return np.minimum(found, self.from_branch(joints))

    def least_distances(self, joints: np.ndarray) -> dict[str, float | None]:
        """Return the smallest distances at joint angles [n, joints] of the arm with its gripper
        from itself and from obstacles [m], as plain data; None: there is nothing.
        """
        rods = rods_of(self._cell, joints)
        found = {"self_distance_m": self._from_itself(rods),
                 "obstacle_distance_m": self._from_obstacles(rods, _FINE_M)}
        return {name: float(least) if np.isfinite(least := far.min()) else None
                for name, far in found.items()}

    def links_from(self, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the smallest distance of the arm's links, without the gripper, from ``points``
        [n, k, 3] of the branch frame at joint angles [n, joints] [m], shape [n].
        """
        arm, found = self._cell.arm.rods(joints), np.full(len(joints), np.inf)
        for n, own in enumerate((points - self._base[:3, 3]) @ self._base[:3, :3]):
            links = Limbs(arm.starts[n], arm.ends[n], np.asarray(arm.radii, float))
            found[n] = links.clearance(own).min()
        return found

    def _from_itself(self, rods: Rods) -> np.ndarray:
        found = np.full(len(rods.starts), np.inf)
        for pair in self._pairs:
            found = np.minimum(found, _apart(rods, *pair))
        return found

    def _from_obstacles(self, rods: Rods,
                        spacing: float = _SPACING_M) -> np.ndarray:
        found = np.full(len(rods.starts), np.inf)
        places, radii = self._rod_points(rods, spacing)
        for obstacle in self._obstacles:
            far = obstacle.clearance(places.reshape(-1, 3)).reshape(len(found), -1) - radii
            found = np.minimum(found, far.min(axis=1))
        return found

    def from_branch(self, joints: np.ndarray) -> np.ndarray:
        """Return the smallest distance to the branch at joint angles [n, joints] [m], shape [n]."""
        if self._branch is None:
            return np.full(len(joints), np.inf)
        points, radii = self._rod_points(rods_of(self._cell, joints))
        far = self._branch.clearance(points.reshape(-1, 3)).reshape(len(joints), -1) - radii
        return far.min(axis=1)

    def _rod_points(self, rods: Rods,
                    spacing: float = _SPACING_M) -> tuple[np.ndarray, np.ndarray]:
        """Points along the rods, branch frame, shape [n, k, 3], and the radius at each, [k]; larger
        by half the ``spacing`` [m] for what is between them.
        """
        starts, ends = rods.starts, rods.ends
        points, thick = [], []
        for k, radius in enumerate(rods.radii):
            length = float(np.linalg.norm(ends[0, k] - starts[0, k]))
            share = np.linspace(0.0, 1.0, int(np.ceil(length / spacing)) + 1)[:, None]
            points.append(starts[:, None, k] + share * (ends[:, None, k] - starts[:, None, k]))
            thick.append(np.full(len(share), radius + 0.5 * spacing))
        found = np.concatenate(points, axis=1) @ self._base[:3, :3].T + self._base[:3, 3]
        return found, np.concatenate(thick)


def _apart(rods: Rods, first: int, second: int) -> np.ndarray:
    """Distance of two rods [m], shape [n], from points along one to the other."""
    starts, ends, radii = rods.starts, rods.ends, rods.radii
    vectors = ends[:, second] - starts[:, second]
    square = np.maximum((vectors**2).sum(axis=1), 1e-18)
    found = np.full(len(vectors), np.inf)
    for share in np.linspace(0.0, 1.0, 9):
        off = (starts[:, first] + share * (ends[:, first] - starts[:, first])) - starts[:, second]
        part = np.clip((off * vectors).sum(axis=1) / square, 0.0, 1.0)
        found = np.minimum(found, np.linalg.norm(off - part[:, None] * vectors, axis=1))
    return found - radii[first] - radii[second]


def clearance_in(cell: Cell, asked: float | None, obstacles: tuple[Obstacle, ...],
                 grasp: np.ndarray, nodes: np.ndarray) -> float:
    """Return the clearance from obstacles [m]: ``asked`` if given, else what covers the uncertainty
    of the grasp position, limited to nearly the clearance at rest; grasp and nodes of the branch
    there, branch frame [m], shapes [3] and [n, 3]."""
    if asked is not None or not obstacles:
        return asked or 0.0
    base, arm = cell.base, float(np.linalg.norm(grasp - np.array(cell.base.pose[:3])))
    sigma = float(np.linalg.norm([base.position_sigma_m, base.rotation_sigma_rad * arm,
                                  cell.robot.pose_sigma_m]))
    own = min(float(body.clearance(nodes).min()) for body in obstacles)
    return max(min(_DEVIATIONS * sigma, _AT_REST * own), 0.0)


def blocked_by(cell: Cell, obstacles: tuple[Obstacle, ...], clearance: float = 0.0) -> Blocked:
    """Return a test of whether gripper or arm is nearer to an obstacle than ``clearance`` [m].
    """
    def blocked(flange: np.ndarray, joints: np.ndarray) -> NoPathError | None:
        return None if not obstacles else _obstructing(cell, obstacles, flange, joints, clearance)
    return blocked


def _obstructing(cell: Cell, obstacles: tuple[Obstacle, ...], flange: np.ndarray,
                 joints: np.ndarray, clearance: float) -> NoPathError | None:
    """Return the error for the deepest point in an obstacle or its ``clearance`` [m], or None, of
    flange frames in the robot's base, [n, 4, 4], that are joint angles [rad], [n, joints]."""
    base = matrices(np.array(cell.base.pose))
    rods = rods_of(cell, joints, flange)
    ends = np.stack([rods.starts, rods.ends], axis=2).reshape(len(joints), -1, 3)
    looked = _distances(ends)
    worst: tuple[float, str, str, np.ndarray] | None = None
    for k, name in enumerate(rods.names):
        what = "The gripper" if name == GRIPPER else f"The arm's {name}"
        start, vector = rods.starts[:, k], rods.ends[:, k] - rods.starts[:, k]
        length = float(np.linalg.norm(vector[0]))
        share = np.linspace(0.0, 1.0, int(np.ceil(length / _ROD_SPACING)) + 1)[:, None]
        points = start[looked, None] + share * vector[looked, None]
        points = points.reshape(-1, 3) @ base[:3, :3].T + base[:3, 3]
        hit = closest(obstacles, points, float(rods.radii[k]) + _BETWEEN + clearance)
        if hit and (worst is None or hit[1] > worst[0]):
            worst = hit[1], what, hit[0], hit[2]
    if worst is None:
        return None
    depth, what, name, where = worst
    return NoPathError(
        f"{what} would be "
        + (f"inside {name}, by up to {1e3 * (depth - clearance):.1f} mm, at " if depth >= clearance
           else f"{1e3 * (clearance - depth):.1f} mm from {name}, nearer than the clearance of "
                f"{1e3 * clearance:.1f} mm, at ") +
        f"({', '.join(f'{x:.3f}' for x in where)}) m.",
        "This is the gripper direction farthest from singularities. Every other direction that "
        "was tried is blocked as well.",
        "Choose another path or another position of the robot's base, or correct the obstacle in "
        "the cell file.").at(where)


def _distances(points: np.ndarray) -> np.ndarray:
    """Return indices of poses between which points [n, k, 3] move at most the spacing."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1)
    gone = np.r_[0.0, np.cumsum(steps)]
    chosen = np.searchsorted(gone, np.arange(0.0, gone[-1], _POSE_SPACING))
    return np.unique(np.r_[0, chosen, len(points) - 1])


def outer_reach(arm: Arm, entry: SecondArmEntry) -> float:
    """Return the largest distance of an arm's grasp from its shoulder [m]: all links in line plus
    the tool."""
    joints = np.array(arm.home, float)
    points = np.vstack([arm.shoulder, arm.link_frames(joints)[:, :3, 3],
                        arm.forward(joints)[:3, 3]])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
                 + np.linalg.norm(entry.grasp_pose[:3]))


def untaken(entry: SecondArmEntry, place: np.ndarray, _surface: object) -> str:
    """Return in words that an arm cannot grasp a target at ``place`` [3] from any side; "" if it
    can."""
    arm = arm_named(entry.model)
    turns = Rotation.random(_TURNS, rng=np.random.default_rng(0)).as_matrix()
    frames = np.tile(np.eye(4), (_TURNS, 1, 1))
    frames[:, :3, :3], frames[:, :3, 3] = turns, place
    flange = inverted(matrices(np.array(entry.base_pose))) @ frames @ inverted(
        matrices(np.array(entry.grasp_pose)))
    if np.isnan(arm.inverse(flange)).any(axis=-1).all():
        return f"its inverse kinematics has no solution from any of {_TURNS} directions"
    return ""
