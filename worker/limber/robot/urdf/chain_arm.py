"""An arm of a URDF file: like any other, with iterative inverse kinematics."""

import functools
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.numerics.compiled import for_kernels
from limber.robot.interface import Rods
from limber.robot.urdf.chain_kernels import chain_frames, chain_jacobian, solved
from limber.robot.urdf.urdf_file import Chain, read_chain

ENDING = ".urdf"
_STARTS = 96
_MOST = 8  # stored configurations
_APART = 0.2  # rad between two configurations
_THICK = 0.07  # radius of a link without a simple shape over the arm's reach, rounded up
_DRAWN = 0.05  # the same for drawn links


@dataclass(frozen=True, eq=False)
class UrdfArm:
    """A chain of revolute joints; see :class:`limber.robot.interface.Arm`.

    A URDF does not describe the controller: only the virtual robot can move the arm until a driver
    is registered with an arm of its own. It states no payload either: none is refused.
    """

    name: str
    chain: Chain

    controller = "virtual"
    rate = 500.0
    measures_force = True
    payload = math.inf
    singularity_names = ("nearest",)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.chain.joints)

    @property
    def ros_joints(self) -> tuple[str, ...]:
        return self.joint_names

    @cached_property
    def joint_limits(self) -> np.ndarray:
        return np.array([joint.limits for joint in self.chain.joints])

    @cached_property
    def joint_speed(self) -> np.ndarray:
        return np.array([joint.speed for joint in self.chain.joints])

    @cached_property
    def home(self) -> np.ndarray:
        return self._starts[int(self._conditions(self._starts).argmax())]

    @cached_property
    def shoulder(self) -> np.ndarray:
        """On the first joint's axis, at the height of the second joint."""
        first, second = self.link_frames(np.zeros(len(self.chain.joints)))[:2]
        axis = first[:3, :3] @ self.chain.joints[0].axis
        return first[:3, 3] + axis * (axis @ (second[:3, 3] - first[:3, 3]))

    @cached_property
    def reach(self) -> float:
        """Upper bound: the distance of the last joint from the shoulder with all links in line."""
        positions = self.link_frames(np.zeros(len(self.chain.joints)))[1:-1, :3, 3]
        return float(np.linalg.norm(positions[0] - self.shoulder)
                     + np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())

    @property
    def link_radius(self) -> float:
        return _DRAWN * self.reach

    def forward(self, joints: np.ndarray) -> np.ndarray:
        return self.link_frames(joints)[..., -1, :, :]

    def link_frames(self, joints: np.ndarray) -> np.ndarray:
        """Return the frames of all joints and of the flange, shape [..., n + 1, 4, 4]."""
        joints = np.asarray(joints, float)
        count = joints.shape[-1]
        frames = chain_frames(self._origins, self._axes, for_kernels(joints.reshape(-1, count)))
        return frames.reshape(*joints.shape[:-1], count + 1, 4, 4)

    def jacobian(self, joints: np.ndarray) -> np.ndarray:
        frames = self.link_frames(joints)
        slopes = chain_jacobian(self._axes, for_kernels(frames.reshape(-1, *frames.shape[-3:])))
        return slopes.reshape(*frames.shape[:-3], 6, len(self._axes))

    def inverse(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return up to eight configurations for each of ``frames`` [..., 4, 4], or the one found
        from ``near`` [..., n]; see :class:`limber.robot.interface.Arm`.
        """
        frames = np.asarray(frames, float)
        count = len(self._axes)
        flat = for_kernels(frames.reshape(-1, 4, 4))
        begun = None if near is None else np.broadcast_to(
            np.asarray(near, float), (*frames.shape[:-2], count)).reshape(-1, count)
        found = np.full((len(flat), _MOST, count), np.nan)
        if begun is not None:
            found[:, 0] = self._solved(flat, begun)
        for number in np.flatnonzero(np.isnan(found[:, 0, 0])):
            kept = self._apart(self._solved(np.repeat(flat[number:number + 1], _STARTS, axis=0),
                                            self._starts))
            found[number, :len(kept)] = kept
        return found.reshape(*frames.shape[:-2], _MOST, count)

    def configurations(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        frames = np.asarray(frames, float)
        return np.array([self._solved(frames, start[None], is_path=True)
                         for start in self.inverse(frames[0], near)])

    def _solved(self, frames: np.ndarray, starts: np.ndarray, *, is_path: bool = False,
                ) -> np.ndarray:
        return solved(self._origins, self._axes, for_kernels(frames), for_kernels(starts), is_path)

    def singularity_distance(self, joints: np.ndarray) -> np.ndarray:
        """Return the ratio of the Jacobian's least to greatest singular value, lengths in reaches
        of the arm, as a fraction of its value in the arm's best pose, shape [..., 1].
        """
        return self._conditions(joints) / self._best_condition

    def _conditions(self, joints: np.ndarray) -> np.ndarray:
        slopes = self.jacobian(joints)
        slopes[..., :3, :] /= self.reach
        values = np.linalg.svd(slopes, compute_uv=False)
        return values[..., -1:] / values[..., :1]

    def rods(self, joints: np.ndarray) -> Rods:
        """Return the moving links: their simple shapes, or else thick lines between the joints.

        The link that moves with the first joint alone is omitted if it is such a line: it begins in
        the base's foot, and touches the mount.
        """
        frames = self.link_frames(joints)
        names: list[str] = []
        starts, ends, radii = [], [], []
        for number, name in enumerate(self.joint_names):
            own = [rod for rod in self.chain.rods if rod.joint == number]
            turn, position = frames[:, number, :3, :3], frames[:, number, :3, 3]
            for rod in own:
                names.append(rod.name)
                starts.append(turn @ rod.start + position)
                ends.append(turn @ rod.end + position)
                radii.append(rod.radius)
            if not own and number > 0:
                names.append(f"link behind {name}")
                starts.append(position)
                ends.append(frames[:, number + 1, :3, 3])
                radii.append(_THICK * self.reach)
        return Rods(tuple(names), np.stack(starts, axis=1), np.stack(ends, axis=1),
                    np.array(radii))

    @cached_property
    def _best_condition(self) -> float:
        return float(self._conditions(self.home)[0])

    @cached_property
    def _origins(self) -> np.ndarray:
        return np.array([*(joint.origin for joint in self.chain.joints), self.chain.flange])

    @cached_property
    def _axes(self) -> np.ndarray:
        return np.array([joint.axis for joint in self.chain.joints])

    @cached_property
    def _starts(self) -> np.ndarray:
        """Start angles of the search for configurations, always the same, shape [starts, n]."""
        low, high = np.clip(self.joint_limits, -np.pi, np.pi).T
        return np.random.default_rng(0).uniform(low, high, (_STARTS, len(low)))

    def _apart(self, found: np.ndarray) -> np.ndarray:
        """Return the solutions [k, n] that are different configurations, the best first: within the
        limits, and far from singularities.
        """
        found = found[np.isfinite(found).all(axis=1)]
        if not len(found):
            return found
        found = (found + np.pi) % (2 * np.pi) - np.pi
        low, high = self.joint_limits.T
        inside = ((found > low) & (found < high)).all(axis=1)
        best = np.lexsort((-self.singularity_distance(found)[:, 0], ~inside))
        kept: list[np.ndarray] = []
        for joints in found[best]:
            off = [np.abs((joints - other + np.pi) % (2 * np.pi) - np.pi).max() for other in kept]
            if min(off, default=np.inf) > _APART and len(kept) < _MOST:
                kept.append(joints)
        return np.array(kept)


def arm_of_file(name: str) -> UrdfArm:
    """Return the arm of a URDF file; its name is the file's.

    Raises:
        InputError: the file cannot be read, or does not describe a supported arm.
    """
    path = Path(name)
    try:
        stamp = path.stat()
    except OSError as error:
        raise InputError(f"Robot {name!r} cannot be read from its file ({error.strerror}).",
                         "It must describe the arm's links and "
                         "joints.", "Give the path of its URDF.",
                         ) from error
    return _read(name, stamp.st_mtime_ns, stamp.st_size)


@functools.lru_cache(maxsize=16)
def _read(name: str, _changed: int, _size: int) -> UrdfArm:
    """The arm of a file in its present state: a cell asks for its arm many times a second."""
    return UrdfArm(name, read_chain(Path(name)))
