"""An arm of a URDF file: like any other, with iterative inverse kinematics.

Of the file only the chain of revolute joints from base to flange and the links' simple shapes are
needed, so Limber needs no robot parser. A document type is refused, and with it every entity.
"""

import functools
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from limber.cell.arm import Rods
from limber.core.errors import InputError
from limber.core.files.reading import read_text
from limber.geometry.rigid_kernels import inverse_of
from limber.kernels import Kernel, for_kernels

_BASE = "base"
_FLANGES = ("tool0", "flange")
"""Names of links in ROS-Industrial (REP 199): the controller's base frame and its flange."""
_FEWEST = 6
Element = ElementTree.Element


@dataclass(frozen=True)
class Joint:
    """A revolute joint: its frame at angle 0 in the previous joint's, [4, 4], unit axis in its own,
    [3], least and greatest angle [rad], infinite for an endless one, and greatest speed [rad/s]."""

    name: str
    origin: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float]
    speed: float


@dataclass(frozen=True)
class Rod:
    """A capsule around a link's simple shape, in the frame of joint number ``joint`` [m]."""

    joint: int
    name: str
    start: np.ndarray
    end: np.ndarray
    radius: float


@dataclass(frozen=True)
class Chain:
    """An arm as its file describes it: joints from the base on, the flange's frame in the last
    one's, [4, 4], and the moving links' cylinders, spheres and boxes."""

    joints: tuple[Joint, ...]
    flange: np.ndarray
    rods: tuple[Rod, ...]


class _WithoutDoctype(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ElementTree.ParseError("it declares a document type, which is not allowed because "
                                     "it can define entities")


def read_chain(path: Path, tip: str = "") -> Chain:
    """Read the arm of a URDF file, from the link ``base`` (else the root) to ``tip``, or else to
    ``tool0``, ``flange``, each also with a prefix, or the first end of its one chain of six or more
    joints; fingers are no part of it. InputError if it is unreadable, or no such arm."""
    try:
        # Entities need a document type, which is refused.
        root = ElementTree.XML(read_text(path, "the description of an arm (URDF)"),
                               ElementTree.XMLParser(target=_WithoutDoctype()))  # noqa: S314
        return _Robot(root).chain(tip)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"Robot {str(path)!r} does not describe a supported arm: {error}.",
                         "Limber supports serial arms with six or more revolute joints.",
                         "Correct the URDF file. If it is a xacro file, convert it with xacro "
                         "first.") from error


class _Robot:
    """The tree of a URDF file. Its methods raise ValueError if it does not describe an arm."""

    def __init__(self, root: Element):
        if root.tag != "robot":
            raise ValueError(f"its root is <{root.tag}>, not <robot>")
        if any("wiki/xacro" in str(element.tag) for element in root):
            raise ValueError("it is a xacro file")
        self._links = {_said(link, "name"): link for link in root.findall("link")}
        self._above = {_said(_part(joint, "child"), "link"): joint
                       for joint in root.findall("joint")}

        # Fingers slide, follow another joint, or are the joint that others follow.
        followed = {mimic.get("joint") for mimic in root.iterfind("joint/mimic")}
        self._fingers = {joint for joint in self._above.values() if joint.get("type") == "prismatic"
                         or joint.find("mimic") is not None or joint.get("name") in followed}

    def chain(self, tip: str) -> Chain:
        """The joints from the base to the flange; both names may have a prefix."""
        tip = tip or self._flange()
        usual = next((name for name in _FLANGES if tip.endswith(name)), tip)
        name = tip.removesuffix(usual) + _BASE
        base = self._joints_to(name) if name in self._links else []
        if any(_turns(joint) for joint in base):
            raise ValueError(f"its link {name!r} is not fixed to the root")
        frame = inverse_of(functools.reduce(np.matmul, map(_origin, base), np.eye(4)))
        joints: list[Joint] = []
        rods: list[Rod] = []
        for element in self._joints_to(tip):
            frame = frame @ _origin(element)
            if _turns(element):
                joints.append(_joint(element, frame))
                frame = np.eye(4)
            if joints:
                link = _said(_part(element, "child"), "link")
                rods += _rods(self._links[link], link, frame, len(joints) - 1)
        if len(joints) < _FEWEST:
            raise ValueError(f"it has only {len(joints)} revolute joints between base and flange")
        return Chain(tuple(joints), frame, tuple(rods))

    def _flange(self) -> str:
        for name in _FLANGES:
            # Of one arm alone, its prefix may stand before it: left_tool0.
            found = [link for link in self._links if link.endswith(f"_{name}")]
            if name in self._links or len(found) == 1:
                return name if name in self._links else found[0]
        parents = {_said(_part(joint, "parent"), "link") for joint in self._above.values()
                   if joint not in self._fingers}
        paths = {name: self._joints_to(name) for name in self._links if name not in parents}
        # Of several ends of one chain, the first.
        ends = {turning[-1]: name for name, path in reversed(paths.items())
                if self._fingers.isdisjoint(path) and len(
                    turning := [joint for joint in path if _turns(joint)]) >= _FEWEST}
        if len(ends) != 1:
            ways = "".join(f"; one to arm.urdf#{name}" for name in ends.values())
            raise ValueError(f"it has no link {' or '.join(map(repr, _FLANGES))}, and {len(ends)} "
                             f"chains of {_FEWEST} or more revolute joints{ways}")
        return next(iter(ends.values()))

    def _joints_to(self, link: str) -> list[Element]:
        """The joints from the root to a link."""
        found: list[Element] = []
        while link in self._above:
            found.append(self._above[link])
            link = _said(_part(found[-1], "parent"), "link")
            if len(found) > len(self._above):
                raise ValueError(f"its links form a loop at {link!r}")
        if link not in self._links:
            raise ValueError(f"a joint refers to the link {link!r}, which does not exist")
        return found[::-1]


def _turns(joint: Element) -> bool:
    kind = _said(joint, "type")
    if kind == "fixed":
        return False
    if kind not in ("revolute", "continuous") or joint.find("mimic") is not None:
        raise ValueError(f"its joint {joint.get('name')!r} has type {kind!r} or mimics another "
                         "joint; an arm's own are revolute, continuous or fixed")
    return True


def _joint(element: Element, origin: np.ndarray) -> Joint:
    name, limit = _said(element, "name"), element.find("limit")
    speed = None if limit is None else limit.get("velocity")
    if limit is None or speed is None or not float(speed) > 0.0:
        raise ValueError(f"its joint {name!r} states no velocity limit")
    limits = (-np.inf, np.inf)
    if _said(element, "type") == "revolute":
        limits = float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0))
        if not limits[0] < limits[1]:
            raise ValueError(f"the lower limit of its joint {name!r} is not below the upper limit")
    element_axis = element.find("axis")
    axis = _vector((1.0, 0.0, 0.0) if element_axis is None else _said(element_axis, "xyz").split())
    if not np.linalg.norm(axis) > 0.0:
        raise ValueError(f"the axis of its joint {name!r} is zero")
    return Joint(name, origin, axis / np.linalg.norm(axis), limits, float(speed))


def _rods(link: Element, name: str, frame: np.ndarray, joint: int) -> list[Rod]:
    """The simple shapes of a link, each enclosed in a rod; meshes are omitted."""
    found = []
    for collision in link.findall("collision"):
        shape = _part(_part(collision, "geometry"), "*")
        along, radius = _axis_and_radius(shape)
        if radius > 0.0:
            transform = frame @ _origin(collision)
            half = transform[:3, :3] @ (0.5 * along)
            found.append(Rod(joint, name, transform[:3, 3] - half, transform[:3, 3] + half, radius))
    return found


def _axis_and_radius(shape: Element) -> tuple[np.ndarray, float]:
    """A shape's longest axis [m, 3] and its greatest distance from it [m]; 0 for a mesh."""
    if shape.tag == "sphere":
        return np.zeros(3), float(_said(shape, "radius"))
    if shape.tag == "cylinder":
        return np.array([0.0, 0.0, float(_said(shape, "length"))]), float(_said(shape, "radius"))
    if shape.tag == "box":
        size = _vector(_said(shape, "size").split())
        longest = np.eye(3)[int(size.argmax())]
        return size * longest, 0.5 * float(np.linalg.norm(size * (1.0 - longest)))
    return np.zeros(3), 0.0


def _origin(element: Element) -> np.ndarray:
    """The frame of an element in its parent's: roll, pitch and yaw about fixed axes."""
    from scipy.spatial.transform import Rotation

    frame, origin = np.eye(4), element.find("origin")
    if origin is not None:
        frame[:3, :3] = Rotation.from_euler(
            "xyz", _vector(origin.get("rpy", "0 0 0").split())).as_matrix()
        frame[:3, 3] = _vector(origin.get("xyz", "0 0 0").split())
    return frame


def _vector(parts: object) -> np.ndarray:
    vector = np.array(parts, float)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{parts} is not a list of three finite numbers")
    return vector


def _part(element: Element, tag: str) -> Element:
    part = element.find(tag)
    if part is None:
        raise ValueError(f"its <{element.tag}> {element.get('name', '')!r} has no <{tag}>")
    return part


def _said(element: Element, key: str) -> str:
    value = element.get(key)
    if value is None:
        raise ValueError(f"one of its <{element.tag}> elements has no attribute {key!r}")
    return value


_AXES = "axes float64[joints, 3]"
_chain_frames = Kernel("chain_frames", "origins float64[links, 4, 4]", _AXES,
                       "angles float64[poses, joints]", "out frames float64[poses, links, 4, 4]")
_chain_jacobian = Kernel("chain_jacobian", _AXES, "frames float64[poses, links, 4, 4]",
                         "out slopes float64[poses, 6, joints]")
_chain_solved = Kernel(
    "chain_solved", "origins float64[links, 4, 4]", _AXES, "frames float64[targets, 4, 4]",
    "starts float64[starts, joints]", "out found float64[targets, joints]", "is_path int")

_STARTS = 96
_MOST = 8  # stored configurations
_APART = 0.2  # rad between two configurations
_THICK = 0.07  # radius of a link without a simple shape over the arm's reach, rounded up
_DRAWN = 0.05  # the same for drawn links


@dataclass(frozen=True, eq=False)
class UrdfArm:
    """A chain of revolute joints; see :class:`limber.cell.arm.Arm`.

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
        joints = for_kernels(joints)
        count = joints.shape[-1]
        frames = np.empty((*joints.shape[:-1], count + 1, 4, 4))
        _chain_frames(self._origins, self._axes, joints.reshape(-1, count),
                      frames.reshape(-1, count + 1, 4, 4))
        return frames

    def jacobian(self, joints: np.ndarray) -> np.ndarray:
        frames, count = self.link_frames(joints), len(self._axes)
        slopes = np.empty((*frames.shape[:-3], 6, count))
        _chain_jacobian(self._axes, frames.reshape(-1, count + 1, 4, 4),
                        slopes.reshape(-1, 6, count))
        return slopes

    def inverse(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return up to eight configurations for each of ``frames`` [..., 4, 4], or the one found
        from ``near`` [..., n]; see :class:`limber.cell.arm.Arm`.
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
        """Return the angles that bring the flange to ``frames`` [k, 4, 4] from ``starts``, [k, n];
        NaN where none are found. ``is_path``: each is sought from the one before, the first from
        the only start."""
        found = np.empty((len(frames), len(self._axes)))
        _chain_solved(self._origins, self._axes, for_kernels(frames), for_kernels(starts), found,
                      is_path)
        return found

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
        """Return the moving links: their simple shapes, or else thick lines between the joints, but
        no such line of the first joint's link alone: it begins in the base's foot, and touches the
        mount."""
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


def is_file(name: str) -> bool:
    """Return whether a robot's name is that of a file: ``arm.urdf``, or ``arm.urdf#LINK``."""
    return name.partition("#")[0].lower().endswith((".urdf", ".xacro"))


def arm_of_file(name: str) -> UrdfArm:
    """Return the arm of a URDF file up to its flange, which may be named behind its path (``#``),
    named as the file; InputError if it cannot be read, or is no supported arm."""
    path = Path(name.partition("#")[0])
    return _read(name, path, path.stat().st_mtime_ns if path.is_file() else 0)


@functools.lru_cache(maxsize=16)
def _read(name: str, path: Path, _changed: int) -> UrdfArm:
    """The arm of a file in its present state: a cell asks for its arm many times a second."""
    return UrdfArm(name, read_chain(path, name.partition("#")[2]))
