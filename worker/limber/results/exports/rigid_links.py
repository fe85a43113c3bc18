"""A branch as rigid links with springs between them, for robot simulators.

The links follow the axes. A spring sits in the middle of each segment (rigid finite elements of
Hrennikoff and Wittbrodt), with bending stiffness E I / l and torsional stiffness G J / l. Sections
are integrated over the mesh itself, so mass and second moments equal those of our own finite
elements, including flattened and off-axis sections. Shear and the stiffening effect of forks are
left out; :func:`matched` corrects for both on average.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import InputError
from limber.core.numerics.rigid import any_normal
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import HungTwig
from limber.mechanics.materials.laws import MaterialLaw, is_hookean_at_rest
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel

# The material laws that can be exported to other programs.


def require_elastic(law: MaterialLaw, program: str, *, at_any_strain: bool = False) -> None:
    """Refuse a law that Young's modulus and Poisson's ratio alone do not describe to ``program``,
    or only at small strains if it computes with them ``at_any_strain``: an InputError."""
    if law.is_hookean or (not at_any_strain and is_hookean_at_rest(law)):
        return
    raise InputError(f"{program} does not support the material {law.name!r}.",
                     "The file can only state Young's modulus and Poisson's ratio, which do not "
                     "describe this law.",
                     "Export the branch with st_venant_kirchhoff.")


_SAMPLES_A_SEGMENT = 12
_SPLITS = 1
"""Each tetrahedron is split into eight several times, each with the four points of Gauss' rule.
Second moments are exact except for the assignment of points to links."""
_GAUSS = (0.58541019662496852, 0.1381966011250105)


@dataclass(frozen=True)
class RodTree:
    """Rigid links: link 0 is fixed, link k hangs on ``parent[k]`` by a spring at ``joint[k]`` [m],
    [n, 3], with stiffness [N m/rad] about ``axes``, the principal bending axes and the tangent as
    rows, [n, 3, 3]. Mass [kg], centre and end [m], [n, 3]; inertia about the centre along the
    branch's axes [kg m^2]; radius of a round section of the same area [m]; gravity [m/s^2], zero if
    the branch has no weight."""

    parent: np.ndarray
    joint: np.ndarray
    axes: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    end: np.ndarray
    radius: np.ndarray
    gravity: np.ndarray

    @property
    def count(self) -> int:
        return len(self.parent)

    @property
    def carried(self) -> np.ndarray:
        """Angles about its axes at which each spring is unstressed [rad], shape [n, 3]: they carry
        the weight beyond them, and the branch rests as it was scanned."""
        pull = self.mass[:, None] * self.gravity
        force, moment = pull.copy(), np.cross(self.centre, pull)
        for link in range(self.count - 1, 0, -1):
            force[self.parent[link]] += force[link]
            moment[self.parent[link]] += moment[link]
        about_joint = moment - np.cross(self.joint, force)
        torque = np.einsum("nij,nj->ni", self.axes, about_joint)
        return np.divide(-torque, self.stiffness, where=self.stiffness > 0,
                         out=np.zeros_like(torque))

    def link_at(self, point: Sequence[float]) -> int:
        """Return the link whose centre line is nearest to a point [m]."""
        start, vectors = self.joint, self.end - self.joint
        size = np.maximum((vectors**2).sum(axis=1), 1e-18)
        share = np.clip(((np.asarray(point) - start) * vectors).sum(axis=1) / size, 0.0, 1.0)
        return int(np.linalg.norm(start + share[:, None] * vectors - point, axis=1).argmin())


def matched(tree: RodTree, model: BranchModel, tip: int) -> tuple[RodTree, float]:
    """Return the links, springs scaled by one factor so that node ``tip`` is as compliant as in the
    mesh, and the factor: links leave out a few percent, mainly the stiffening of forks."""
    position = model.mesh.nodes[tip]
    compliance = np.zeros((3, 3))
    link = tree.link_at(position)
    while link > 0:
        arms = np.cross(tree.axes[link], position - tree.joint[link])
        compliance += (arms / tree.stiffness[link][:, None]).T @ arms
        link = int(tree.parent[link])
    bare = model.with_parameters(gravity=(0.0, 0.0, 0.0))
    factor = float(np.trace(compliance)) / tip_compliance(bare, tip)
    return replace(tree, stiffness=tree.stiffness * factor), factor


def tip_compliance(model: BranchModel, tip: int) -> float:
    """Return the compliance at node ``tip`` under a small force [m/N], summed over three axes."""
    still = np.zeros_like(model.mesh.nodes)
    tangent = model.equations(()).tangent(model, still)
    compliance = 0.0
    for axis in range(3):
        load = still.copy()
        load[tip, axis] = 1.0
        compliance += float(tangent.solve(load)[tip, axis])
    return compliance


@dataclass(frozen=True)
class _Segment:
    start: np.ndarray
    middle: np.ndarray
    end: np.ndarray
    tangent: np.ndarray
    length: float
    before: int  # the link at whose middle this one begins
    link: int


def rod_tree(model: BranchModel, skeleton: Skeleton, spacing: float) -> RodTree:
    """Return the links of a branch model (mesh, material, weight, attached masses) along the
    skeleton in the mesh's frame, ``spacing`` long [m] and cut at forks. InputError if one would
    contain no part of the mesh, or no springs exist for its material."""
    require_elastic(model.material, "A rod's spring")
    points, volume, tet = _sampled(model.mesh)
    wood = cKDTree(points)
    segments, samples, owner, before = _laid_out(skeleton, spacing, wood)
    nearest = cKDTree(samples).query(points)[1]
    # The segment a point belongs to, and its side of the segment's spring.
    of, link = owner[nearest], before[nearest]
    count = len(segments) + 1
    parent = np.full(count, -1)
    joint = np.tile(segments[0].start, (count, 1))
    end, axes = joint.copy(), np.tile(np.eye(3), (count, 1, 1))
    stiffness, radius = np.zeros((count, 3)), np.zeros(count)
    shear = model.young / (2 * (1 + model.poisson))
    for number, segment in enumerate(segments):
        own = of == number
        if not own.any():
            raise InputError(f"A link of {1e3 * segment.length:.2g} mm contains no part of the "
                             "mesh.",
                             "The mesh is too coarse for such short links.", "Use longer links.")
        axis, bending, twist = _section(points[own] - samples[nearest[own]], segment,
                                        volume[own], model.young[tet[own]], shear[tet[own]])
        k = segment.link
        parent[k], joint[k], axes[k] = segment.before, segment.middle, axis
        stiffness[k] = np.array([*bending, twist]) / segment.length
        radius[k] = np.sqrt(volume[own].sum() / segment.length / np.pi)
    for segment in segments:
        end[segment.before] = segment.middle
        end[segment.link] = segment.end
    radius[0] = radius[1]
    mass, centre, inertia = _masses(points, volume * model.density[tet], link, count, end)
    # Attached masses belong to the link that they are attached to.
    tree = RodTree(parent, joint, axes, stiffness, mass, centre, inertia, end, radius,
                   np.array(model.gravity, float))
    return _with_hung(tree, model)


def _laid_out(skeleton: Skeleton, spacing: float, wood: cKDTree,
              ) -> tuple[list[_Segment], np.ndarray, np.ndarray, np.ndarray]:
    """Segments in order, points along them, and the segment and link of each point."""
    children = skeleton.child_counts()
    segments: list[_Segment] = []
    samples: list[np.ndarray] = []
    owner: list[int] = []
    before: list[int] = []
    link_of = {0: 0}
    for nodes in _pieces(skeleton, children):
        positions = skeleton.nodes[nodes]
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        fork = nodes[0]
        if int(fork) not in link_of or not _is_meshed(positions, skeleton.radius[nodes], wood):
            continue  # a twig that the mesh omits: its mass hangs on the branch
        is_side = skeleton.branch[nodes[1]] != skeleton.branch[fork] and fork > 0
        # A side branch begins to bend where it leaves its parent axis's wood.
        first = _leaves_at(skeleton, int(fork), positions, along) if is_side else 0.0
        number = max(1, round((along[-1] - first) / spacing))
        cuts = np.linspace(first, along[-1], number + 1)
        current = link_of[int(fork)]
        for low, high in pairwise(cuts):
            line = np.linspace(low, high, 2 * (_SAMPLES_A_SEGMENT // 2) + 1)
            line = (line[1:] + line[:-1]) / 2
            points = np.column_stack([np.interp(line, along, positions[:, k]) for k in range(3)])
            start, middle, end = (np.array([np.interp(at, along, positions[:, k]) for k
                                            in range(3)])
                                  for at in (low, (low + high) / 2, high))
            tangent = (end - start) / np.linalg.norm(end - start)
            link = len(segments) + 1
            segments.append(_Segment(start, middle, end, tangent, float(high - low), current, link))
            half = len(points) // 2
            samples.append(points)
            owner += [len(segments) - 1] * len(points)
            before += [current] * half + [link] * (len(points) - half)
            current = link
        link_of[int(nodes[-1])] = current
    return segments, np.concatenate(samples), np.array(owner), np.array(before)


def _leaves_at(skeleton: Skeleton, fork: int, points: np.ndarray, along: np.ndarray) -> float:
    """Distance along a side branch at which its axis leaves the parent's wood [m]."""
    run = np.flatnonzero(skeleton.branch == skeleton.branch[fork])
    distance, nearest = cKDTree(skeleton.nodes[run]).query(points)
    outside = np.flatnonzero(distance > skeleton.radius[run][nearest])
    at = along[outside[0]] if len(outside) else along[-1]
    return float(min(at, 0.5 * along[-1]))


def _is_meshed(points: np.ndarray, radius: np.ndarray, wood: cKDTree) -> bool:
    """Whether the outer half of a piece of the axes runs inside the mesh."""
    half = len(points) // 2
    return bool(np.median(wood.query(points[half:])[0] / np.maximum(radius[half:], 1e-9)) < 1.0)


def _pieces(skeleton: Skeleton, children: np.ndarray) -> list[list[int]]:
    """Node indices between root, forks and tips, from the root outwards."""
    pieces = []
    next_of: dict[int, list[int]] = {}
    for node in range(1, skeleton.node_count):
        next_of.setdefault(int(skeleton.parent[node]), []).append(node)
    waiting = [0]
    while waiting:
        fork = waiting.pop(0)
        for node in next_of.get(fork, []):
            piece = [fork, node]
            while children[piece[-1]] == 1:
                piece.append(next_of[piece[-1]][0])
            pieces.append(piece)
            waiting.append(piece[-1])
    return pieces


def _sampled(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that represent equal parts of each tetrahedron, with their volumes and tetrahedra:
    their second-order sums equal those of the tetrahedra (Keast's four-point rule)."""
    corners = np.eye(4)[None]
    for _ in range(_SPLITS):
        corners = _split(corners)
    near, far = _GAUSS
    rule = np.full((4, 4), far) + (near - far) * np.eye(4)
    local = np.einsum("gc,scb->sgb", rule, corners).reshape(-1, 4)
    points = np.einsum("sc,tci->tsi", local, mesh.nodes[mesh.tets[:, :4]])
    share = np.abs(mesh.volumes) / len(local)
    return (points.reshape(-1, 3), np.repeat(share, len(local)),
            np.repeat(np.arange(mesh.tet_count), len(local)))


def _split(tets: np.ndarray) -> np.ndarray:
    """Eight tetrahedra of equal volume for each, corners in barycentric coordinates."""
    a, b, c, d = tets.transpose(1, 0, 2)
    ab, bc, ca, ad, bd, cd = ((a + b) / 2, (b + c) / 2, (c + a) / 2, (a + d) / 2, (b + d) / 2,
                              (c + d) / 2)
    parts = [(a, ab, ca, ad), (b, ab, bc, bd), (c, bc, ca, cd), (d, ad, bd, cd),
             (ad, ab, ca, cd), (ab, bc, ca, cd), (ab, bc, bd, cd), (ad, ab, bd, cd)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def _section(offset: np.ndarray, segment: _Segment, volume: np.ndarray, young: np.ndarray,
             shear: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Principal axes (rows, the tangent last), E I about them [N m^2] and G J of a segment."""
    tangent = segment.tangent
    first = any_normal(tangent)
    second = np.cross(tangent, first)
    flat = offset @ np.stack([first, second], axis=1)
    weight = volume * young
    flat = flat - weight @ flat / weight.sum()
    spread = (flat * weight[:, None]).T @ flat / segment.length
    values, vectors = np.linalg.eigh(spread)
    # Bending about one axis is resisted by the extent along the other.
    across = vectors.T @ np.stack([first, second])
    axes = np.stack([across[1], across[0], tangent])
    if np.linalg.det(axes) < 0:
        axes[0] = -axes[0]
    twist = float((volume * shear) @ (flat**2).sum(axis=1)) / segment.length
    return axes, np.array([values[0], values[1]]), twist


def _masses(points: np.ndarray, mass: np.ndarray, link: np.ndarray,
            count: int, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    total = np.bincount(link, mass, count)
    whole = np.maximum(total, 1e-300)
    centre = np.stack([np.bincount(link, mass * points[:, k], count) for k in range(3)],
                      axis=1) / whole[:, None]
    centre = np.where(total[:, None] > 0, centre, end)
    arm = points - centre[link]
    square = (arm**2).sum(axis=1)
    inertia = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(3):
            inertia[:, i, j] = np.bincount(
                link, mass * ((i == j) * square - arm[:, i] * arm[:, j]), count)
    return total, centre, inertia


def _with_hung(tree: RodTree, model: BranchModel) -> RodTree:
    mass, centre, inertia = tree.mass.copy(), tree.centre.copy(), tree.inertia.copy()
    for hung in model.point_masses:
        position = np.array(hung.position)
        link, own = tree.link_at(hung.position), np.zeros((3, 3))
        if isinstance(hung, HungTwig):
            link, own = tree.link_at(hung.attached), np.array(hung.inertia)
        joined = mass[link] + hung.mass
        middle = (mass[link] * centre[link] + hung.mass * position) / max(joined, 1e-300)
        inertia[link] += own + _about(mass[link], centre[link] - middle) + _about(
            hung.mass, position - middle)
        mass[link], centre[link] = joined, middle
    return RodTree(tree.parent, tree.joint, tree.axes, tree.stiffness, mass, centre, inertia,
                   tree.end, tree.radius, tree.gravity)


def _about(mass: float, arm: np.ndarray) -> np.ndarray:
    """Parallel-axis term of a mass at ``arm`` from the axis."""
    return mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


# MuJoCo's MJCF: rigid links on hinges with springs, hanging as the branch was scanned.

_TIMESTEP = 1e-3


def mjcf_text(tree: RodTree, damping: RayleighDamping, name: str,
              sites: Mapping[str, tuple[float, float, float]]) -> str:
    """Return an MJCF model of the links, at rest in its scanned shape: three hinges each but the
    fixed one, two for bending, one for torsion. Of Rayleigh damping MJCF supports the
    stiffness-proportional part alone. ``sites``: positions on the branch [m] to follow, by name."""
    root = ElementTree.Element("mujoco", model=name)
    root.append(ElementTree.Comment(
        f" Limber: m, kg, s. Damping: {damping.stiffness:.6g} s times the stiffness. The part of "
        f"{damping.mass:.6g} 1/s times the mass is omitted, because MJCF cannot express it. "))
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true")
    ElementTree.SubElement(root, "option", timestep=f"{_TIMESTEP:g}", integrator="implicitfast",
                           gravity=_numbers(tree.gravity))
    default = ElementTree.SubElement(root, "default")
    # The links of a branch do not collide with each other.
    ElementTree.SubElement(default, "geom", contype="0", conaffinity="1", mass="0",
                           rgba="0.45 0.33 0.22 1")
    world = ElementTree.SubElement(root, "worldbody")
    bodies: dict[int, ElementTree.Element] = {}
    slack = tree.carried
    for link in range(tree.count):
        parent = int(tree.parent[link])
        holder = world if parent < 0 else bodies[parent]
        origin = tree.joint[link] - (tree.joint[parent] if parent >= 0 else 0.0)
        body = ElementTree.SubElement(holder, "body", name=f"link{link}", pos=_numbers(origin))
        bodies[link] = body
        if parent >= 0:
            for axis in range(3):
                stiffness = float(tree.stiffness[link, axis])
                ElementTree.SubElement(
                    body, "joint", name=f"link{link}_{'bend1 bend2 twist'.split()[axis]}",
                    type="hinge", axis=_numbers(tree.axes[link, axis]),
                    stiffness=f"{stiffness:.9g}", springref=f"{slack[link, axis]:.9g}",
                    damping=f"{damping.stiffness * stiffness:.9g}")
        _add_mjcf_inertial(body, tree, link)
        vector = tree.end[link] - tree.joint[link]
        if np.linalg.norm(vector) > 1e-6:
            ElementTree.SubElement(body, "geom", type="capsule", size=f"{tree.radius[link]:.6g}",
                                   fromto=f"0 0 0 {_numbers(vector)}")
    for label, point in sites.items():
        link = tree.link_at(point)
        ElementTree.SubElement(bodies[link], "site", name=label, size="0.004",
                               pos=_numbers(np.asarray(point) - tree.joint[link]))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_mjcf_inertial(body: ElementTree.Element, tree: RodTree, link: int) -> None:
    inertia = tree.inertia[link]
    # MuJoCo does not accept a body whose mass rounds to zero.
    floor = 1e-12 * np.eye(3)
    i = inertia + floor
    ElementTree.SubElement(
        body, "inertial", mass=f"{max(tree.mass[link], 1e-9):.9g}",
        pos=_numbers(tree.centre[link] - tree.joint[link]),
        fullinertia=_numbers((i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2])))


def _numbers(values: np.ndarray | tuple[float, ...]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


# URDF: rigid links on revolute joints, with springs as Gazebo and related programs read them.

_LEAST_MASS, _LEAST_INERTIA = 1e-9, 1e-12
_AXES = ("bend1", "bend2", "twist")
_WIDEST = 1.5
"""Limit of a joint [rad], far beyond the rotation of any link of a branch."""


def urdf_text(tree: RodTree, damping: RayleighDamping, name: str) -> str:
    """Return a URDF model of the links; ``link0`` is held by ``world``. URDF has no springs:
    stiffness and unstressed angle are written in ``<gazebo>`` (springStiffness, springReference)
    and in ``<limber>``, for the user's programs, of damping the stiffness-proportional part. A
    joint rotates about one axis, so there are two links without size between neighbours."""
    root = ElementTree.Element("robot", name=name)
    ElementTree.SubElement(root, "link", name="world")
    slack = tree.carried
    for link in range(tree.count):
        _add_link(root, tree, link)
        parent = int(tree.parent[link])
        if parent < 0:
            joint = ElementTree.SubElement(root, "joint", name="base", type="fixed")
            _connect(joint, "world", "link0", tree.joint[0])
            continue
        holder, origin = f"link{parent}", tree.joint[link] - tree.joint[parent]
        for number, label in enumerate(_AXES):
            held = f"link{link}" if number == 2 else f"link{link}_{label}"
            if number < 2:
                _add_urdf_inertial(ElementTree.SubElement(root, "link", name=held), 0.0,
                                   np.zeros(3), np.zeros((3, 3)))
            _add_joint(root, f"joint{link}_{label}", holder, held, origin, tree.axes[link, number],
                       float(tree.stiffness[link, number]), float(slack[link, number]), damping)
            holder, origin = held, np.zeros(3)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_link(root: ElementTree.Element, tree: RodTree, link: int) -> None:
    element = ElementTree.SubElement(root, "link", name=f"link{link}")
    _add_urdf_inertial(element, float(tree.mass[link]), tree.centre[link] - tree.joint[link],
                       tree.inertia[link])
    vector = tree.end[link] - tree.joint[link]
    length = float(np.linalg.norm(vector))
    if length < 1e-6:
        return
    for kind in ("visual", "collision"):
        part = ElementTree.SubElement(element, kind)
        # A cylinder's axis is z through its centre.
        roll_pitch_yaw = (0.0, float(np.arccos(np.clip(vector[2] / length, -1.0, 1.0))),
                          float(np.arctan2(vector[1], vector[0])))
        ElementTree.SubElement(part, "origin", xyz=_numbers(vector / 2),
                               rpy=_numbers(roll_pitch_yaw))
        shape = ElementTree.SubElement(part, "geometry")
        ElementTree.SubElement(shape, "cylinder", radius=f"{tree.radius[link]:.6g}",
                               length=f"{length:.9g}")


def _add_urdf_inertial(element: ElementTree.Element, mass: float, centre: np.ndarray,
                       inertia: np.ndarray) -> None:
    part = ElementTree.SubElement(element, "inertial")
    ElementTree.SubElement(part, "origin", xyz=_numbers(centre), rpy="0 0 0")
    ElementTree.SubElement(part, "mass", value=f"{max(mass, _LEAST_MASS):.9g}")
    i = inertia + _LEAST_INERTIA * np.eye(3)
    ElementTree.SubElement(part, "inertia", ixx=f"{i[0, 0]:.9g}", iyy=f"{i[1, 1]:.9g}",
                           izz=f"{i[2, 2]:.9g}", ixy=f"{i[0, 1]:.9g}", ixz=f"{i[0, 2]:.9g}",
                           iyz=f"{i[1, 2]:.9g}")


def _add_joint(root: ElementTree.Element, name: str, parent: str, child: str, origin: np.ndarray,
               axis: np.ndarray, stiffness: float, slack: float, damping: RayleighDamping) -> None:
    joint = ElementTree.SubElement(root, "joint", name=name, type="revolute")
    _connect(joint, parent, child, origin)
    ElementTree.SubElement(joint, "axis", xyz=_numbers(axis))
    ElementTree.SubElement(joint, "limit", lower=f"{-_WIDEST}", upper=f"{_WIDEST}",
                           effort="1000", velocity="1000")
    ElementTree.SubElement(joint, "dynamics", damping=f"{damping.stiffness * stiffness:.9g}",
                           friction="0")
    spring = {"spring_stiffness": f"{stiffness:.9g}", "spring_reference": f"{slack:.9g}"}
    ElementTree.SubElement(joint, "limber", spring)
    gazebo = ElementTree.SubElement(root, "gazebo", reference=name)
    ElementTree.SubElement(gazebo, "springStiffness").text = spring["spring_stiffness"]
    ElementTree.SubElement(gazebo, "springReference").text = spring["spring_reference"]


def _connect(joint: ElementTree.Element, parent: str, child: str, origin: np.ndarray) -> None:
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=_numbers(origin), rpy="0 0 0")
