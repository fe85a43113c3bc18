"""URDF files: the chain of revolute joints from an arm's base to its flange, and its links' shapes.

Read with the standard library: only links, joints and simple shapes of a URDF are needed, so Limber
needs no robot parser. A document type is refused, and with it every entity.
"""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_text
from limber.core.numerics.rigid_kernels import inverse_of

_BASE = "base"
_FLANGES = ("tool0", "flange")
"""Names of links in ROS-Industrial (REP 199): the controller's base frame and its flange."""
_FEWEST = 6
Element = ElementTree.Element


@dataclass(frozen=True)
class Joint:
    """A revolute joint.

    Attributes:
        name: Name in the file.
        origin: Its frame at angle 0 in that of the previous joint, shape [4, 4].
        axis: Axis of rotation, its frame, unit length, shape [3].
        limits: Least and greatest angle [rad], infinite for an endless joint.
        speed: Greatest [rad/s].
    """

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
    """An arm as its file describes it.

    Attributes:
        joints: Joints from the base on.
        flange: Its frame in the last joint's, shape [4, 4].
        rods: Shapes of the moving links, as far as the file has cylinders, spheres and boxes.
    """

    joints: tuple[Joint, ...]
    flange: np.ndarray
    rods: tuple[Rod, ...]


class _WithoutDoctype(ElementTree.TreeBuilder):
    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ElementTree.ParseError("it declares a document type, which is not allowed because "
                                     "it can define entities")


def read_chain(path: Path) -> Chain:
    """Read the arm of a URDF file.

    It runs from the link ``base`` (else the root) to ``tool0``, ``flange``, or else the end of the
    only chain with six or more joints.

    Raises:
        InputError: the file cannot be read, or is not an arm of six or more revolute joints.
    """
    try:
        # Entities need a document type, which is refused.
        root = ElementTree.XML(read_text(path, "the description of an arm (URDF)"),
                               ElementTree.XMLParser(target=_WithoutDoctype()))  # noqa: S314
        return _Robot(root).chain()
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
        self._links = {_said(link, "name"): link for link in root.findall("link")}
        self._above = {_said(_part(joint, "child"), "link"): joint
                       for joint in root.findall("joint")}

    def chain(self) -> Chain:
        """The joints from the base to the flange."""
        base = self._joints_to(_BASE) if _BASE in self._links else []
        if any(_turns(joint) for joint in base):
            raise ValueError(f"its link {_BASE!r} is not fixed to the root")
        frame = np.eye(4)
        for joint in base:
            frame = frame @ _origin(joint)
        frame = inverse_of(frame)
        joints: list[Joint] = []
        rods: list[Rod] = []
        for element in self._joints_to(self._flange()):
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
            if name in self._links:
                return name
        parents = {_said(_part(joint, "parent"), "link") for joint in self._above.values()}
        ends = [name for name in self._links if name not in parents
                and sum(map(_turns, self._joints_to(name))) >= _FEWEST]
        if len(ends) != 1:
            raise ValueError(f"it has no link {' or '.join(map(repr, _FLANGES))}, and {len(ends)} "
                             f"chains of {_FEWEST} or more revolute joints")
        return ends[0]

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
                         "joint; only revolute, continuous and fixed joints are supported")
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
