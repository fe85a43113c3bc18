"""A grasp (the patch of nodes that a gripper holds) and its poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from limber.core.errors import InputError
from limber.core.numerics.rigid import (
    closest_rotation,
    principal_axes,
    rotation_matrix,
    rotation_vector,
)
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.elements.shape_functions import node_weights

# The piece of a branch inside a clamping gripper, on any mesh.
#
# A branch does not bend inside the gripper, and the length of that piece matters: held over 5 mm
# less, a branch is softer by several percent, and by a half if the piece between gripper and the
# next point is short. On a mesh the held nodes end up to an element short of the gripper's end; if
# force and torque drive the pull, no node is held at all. The tetrahedra in the gripper are
# therefore made stiffer: of a tetrahedron with the fraction p of its length along the branch
# inside, only the remainder bends, in series with it. Its compliance is 1 - p of the material's.

STIFFEST = 100.0
"""Stiffness factor of elements that are entirely inside: a hundredth of their length bends."""
_NEAR_RADII, _NEAR_NODES = 4.0, 30
"""Distance in half lengths, and fewest nodes, that define the branch's axis there."""
_OFF_THE_PIECE = 3.0
"""Distance from the axis, relative to the mean of the neighbours, above which a node belongs to a
twig.
"""


def parts_between(mesh: TetMesh, point: np.ndarray, half_length: float) -> np.ndarray:
    """Return the fraction [tet_count] of each tetrahedron's length in a gripper that holds
    ``half_length`` [m] to both sides of ``point`` [m], along the branch."""
    along, is_beside = _placed(mesh, point, half_length)
    corners = mesh.tets[:, :4]
    first, last = along[corners].min(axis=1), along[corners].max(axis=1)
    inside = np.minimum(last, half_length) - np.maximum(first, -half_length)
    parts = np.clip(inside / np.maximum(last - first, 1e-300), 0.0, 1.0)
    parts[is_beside[corners].any(axis=1)] = 0.0
    return parts


def nodes_between(mesh: TetMesh, point: np.ndarray, half_length: float) -> np.ndarray:
    """Return the nodes that a gripper holds, see :func:`parts_between`. Nodes between corners that
    are not all inside would hold too much of a cut tetrahedron; they are left out."""
    along, is_beside = _placed(mesh, point, half_length)
    held = (np.abs(along) <= half_length) & ~is_beside
    corners = held[mesh.tets[:, :4]]
    for number, parents in enumerate(mesh.element.parents):
        cut = ~corners[:, list(parents)].all(axis=1)
        held[mesh.tets[cut, 4 + number]] = False
    return np.flatnonzero(held)


def _placed(mesh: TetMesh, point: np.ndarray, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions of nodes along the branch's axis at a point [m], and which nodes belong to another
    branch."""
    away = mesh.nodes - np.asarray(point, float)
    distance = np.linalg.norm(away, axis=1)
    reach = max(_NEAR_RADII * half_length, np.sort(distance)[min(
        _NEAR_NODES, mesh.node_count) - 1])
    near = distance <= reach
    axis = principal_axes(away[near])[0]
    along = away @ axis
    beside = np.linalg.norm(away - along[:, None] * axis, axis=1)
    return along, beside > max(2 * half_length, _OFF_THE_PIECE * beside[near].mean())


def stiffening(parts: np.ndarray) -> np.ndarray:
    """Return the stiffness factors of tetrahedra with these fractions in a gripper."""
    return 1.0 / np.maximum(1.0 - parts, 1.0 / STIFFEST)


RADIAN = 0.3
"""Distance that a rotation by one radian counts as between poses, as a fraction of the branch's
extent. Chosen, not measured.
"""

_REACHED = 0.95
"""Fraction of a patch's extent within which its centre may be moved; beyond it, weights become
negative.
"""
_FEWEST_HELD = 3
"""Fewest nodes that fix a rotation."""
_WIDER_CLAMP = 1.3
"""Distance from the gripper's middle, in half lengths, up to which a ring of nodes is held if none
is nearer.
"""
_WIDER, _WIDEST = 1.25, 4.0
"""Factor by which a patch is widened at a time, and at most."""


@dataclass(frozen=True)
class Grasp:
    """A patch of nodes held by a gripper.

    A grasp is a position on the branch. The nodes within its radius, and so the centre of the
    patch, differ from mesh to mesh, and a few millimetres along a branch change its stiffness by
    percents. If the position is known, the weights are therefore corrected as little as possible
    until their centre is that position.

    Attributes:
        nodes: Indices of the patch's nodes, sorted.
        weights: Fractions of a force on the nodes, shape [k]; they sum to 1. The position of a
            pinned grasp is the mean of the nodes with these weights, so that force and position are
            work-conjugate.
        centre: Position of the pose at rest [m], shape [3]: the patch's weighted centre, or the
            middle of a gripper that holds a piece of the branch, which may lie beside it.
        mode: ``rigid``: the patch moves as a rigid body with the pose. ``point``: its mean
            position follows the pose, its rotation is free.
        held: Fraction of each tetrahedron inside a clamping gripper, shape [tet_count], if known;
            the model must then be :meth:`limber.mechanics.model.BranchModel.gripped`.
    """

    nodes: np.ndarray
    weights: np.ndarray
    centre: np.ndarray
    mode: Literal["rigid", "point"] = "rigid"
    held: np.ndarray | None = None

    @property
    def rest_pose(self) -> np.ndarray:
        """Pose [m, rad] of the undeformed branch, shape [6]: the centre without rotation."""
        return np.concatenate([self.centre, np.zeros(3)])

    @classmethod
    def at(cls, mesh: TetMesh, point: np.ndarray, radius: float,
           mode: Literal["rigid", "point"] = "rigid") -> "Grasp":
        """Return the grasp of all nodes within ``radius`` [m] of ``point`` [m], centred on it.

        A radius of 0 takes the nearest node. A pinned patch is widened if the mesh is so coarse
        that its nodes do not surround the position.

        Raises:
            InputError: no node is within the radius (and the radius is not 0), or the patch touches
                the fixed base.
        """
        distance = np.linalg.norm(mesh.nodes - np.asarray(point, float), axis=1)
        nodes = np.flatnonzero(distance <= radius) if radius > 0 else distance.argmin()[None]
        if not len(nodes):
            raise InputError(
                f"No node lies within {radius:g} m of ({', '.join(f'{x:.4g}' for x in point)}) m;"
                f" the nearest is {distance.min():.4g} m away.",
                "The gripper would not hold any node.",
                "Move the point onto the branch or widen the radius; check the units (metres)."
            ).at(point)
        grasp = cls.of_nodes(mesh, nodes, mode, point if radius > 0 else None)
        wider = radius
        while mode == "point" and wider < _WIDEST * radius and (
                np.linalg.norm(grasp.centre - point) > 1e-6 * radius):
            # A coarse mesh may have nodes on one side of the position only.
            wider *= _WIDER
            nodes = np.flatnonzero(distance <= wider)
            if mesh.point_data.get("fixed", np.zeros(mesh.node_count))[nodes].any():
                break
            grasp = cls.of_nodes(mesh, nodes, mode, point)
        if mode == "point" and radius > 0 and np.linalg.norm(grasp.centre - point) > 1e-6 * radius:
            nodes = np.flatnonzero(distance <= radius)
            weights = _on_edge(_patch_weights(mesh, nodes), mesh.nodes[nodes] - point)
            if weights is not None:
                return cls(nodes, weights, weights @ mesh.nodes[nodes], mode)
        return grasp

    @classmethod
    def gripping(cls, mesh: TetMesh, point: np.ndarray, half_length: float,
                 least: int = 1) -> "Grasp":
        """Return the clamped grasp of a gripper that holds a piece of given length, not only nodes.

        It works on coarse meshes: the part of the length without nodes is in ``held``.

        Args:
            point: Centre of the gripper [m], on the branch.
            half_length: Half the length of the piece [m].
            least: Fewest nodes to hold; the nearest ones are taken if fewer are within.

        Raises:
            InputError: as :meth:`at`.
        """
        point = np.asarray(point, float)
        distance = np.sort(np.linalg.norm(mesh.nodes - point, axis=1))
        reach = half_length
        if least > 1:
            reach = max(half_length, distance[min(least, len(distance)) - 1] * (1 + 1e-9))
        if distance[0] > reach:
            # It is refused there.
            return cls.at(mesh, point, reach)
        for wider in (half_length, _WIDER_CLAMP * half_length):
            nodes = nodes_between(mesh, point, wider)
            if len(nodes) >= _FEWEST_HELD:
                grasp = cls.of_nodes(mesh, nodes, point=point)
                break
        else:
            grasp = cls.at(mesh, point, reach)
        return replace(grasp.holding(mesh, point, half_length), centre=point.copy())

    @classmethod
    def from_mesh(cls, mesh: TetMesh, mode: Literal["rigid", "point"] = "rigid",
                  point: np.ndarray | Sequence[float] | None = None) -> "Grasp":
        """Return the grasp marked in the mesh's point data ``grasp``.

        Args:
            point: Position of the grasp [m]; None: the patch's own centre.

        Raises:
            InputError: none is marked.
        """
        nodes = np.flatnonzero(mesh.point_data.get("grasp", np.zeros(mesh.node_count)))
        if not len(nodes):
            raise InputError("The mesh does not mark a grasp.",
                             "Point data `grasp` is missing or 0.",
                             "Reconstruct again, or give a grasp point.")
        return cls.of_nodes(mesh, nodes, mode, point)

    @classmethod
    def of_nodes(cls, mesh: TetMesh, nodes: np.ndarray,
                 mode: Literal["rigid", "point"] = "rigid",
                 point: np.ndarray | Sequence[float] | None = None) -> "Grasp":
        """Return the grasp of the given nodes.

        Args:
            point: Position of the grasp [m]; None: the patch's own centre.

        Raises:
            InputError: the mode is unknown, or a node is fixed.
        """
        if mode not in ("rigid", "point"):
            raise InputError(f"Grasp mode {mode!r} is unknown.",
                             "A grasp holds position and rotation, or position only.",
                             "Use 'rigid' or 'point'.")
        nodes = np.unique(np.asarray(nodes, np.int64))
        fixed = mesh.point_data.get("fixed")
        if fixed is not None and np.any(fixed[nodes]):
            raise InputError("The grasp lies in the fixed base.",
                             f"{np.count_nonzero(fixed[nodes])} of its {len(nodes)} nodes cannot"
                             " move.", "Grasp farther from the base, or use a smaller radius.")
        weights = _patch_weights(mesh, nodes)
        if point is not None:
            weights = _centred(weights, mesh.nodes[nodes] - np.asarray(point, float))
        return cls(nodes, weights, weights @ mesh.nodes[nodes], mode)

    def holding(self, mesh: TetMesh, point: np.ndarray, half_length: float) -> "Grasp":
        """Return the grasp of the same nodes by a gripper that holds a piece of this length.

        Arguments as for :meth:`gripping`.
        """
        return replace(self, held=parts_between(mesh, point, half_length))

    def elsewhere(self, mesh: TetMesh, point: np.ndarray) -> "Grasp":
        """Return the grasp of the same nodes at other positions, about the same point."""
        grasp = Grasp.of_nodes(mesh, self.nodes, self.mode, point)
        # The fraction of each tetrahedron inside hardly changes.
        return grasp if self.held is None else replace(grasp, held=self.held,
                                                       centre=np.array(point, float))

    def key(self) -> tuple[str, bytes, bytes]:
        """Return a key that distinguishes the constraints of different grasps."""
        return self.mode, self.nodes.tobytes(), self.weights.tobytes()

    def displacement(self, rest: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the displacement [m] of the patch's nodes at ``pose``, shape [k, 3].

        Args:
            rest: Rest positions of all nodes [m], shape [node_count, 3].
            pose: Position [m] and rotation vector [rad] of the grasp, shape [6].
        """
        arm = rest[self.nodes] - self.centre
        return pose[:3] + arm @ rotation_matrix(pose[3:]).T - rest[self.nodes]

    def pose_of(self, rest: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Return the pose [m, rad] that fits a displaced patch best, shape [6].

        Args:
            rest, displacement: Values for all nodes [m], shape [node_count, 3].
        """
        arm = rest[self.nodes] - self.centre
        positions = rest[self.nodes] + displacement[self.nodes]
        mean = self.weights @ positions
        if len(self.nodes) < 3:
            return np.concatenate([mean, np.zeros(3)])
        turned = closest_rotation((self.weights[:, None] * (positions - mean)).T @ arm)
        if self.held is not None:
            mean = mean - turned @ (self.weights @ arm)
        return np.concatenate([mean, rotation_vector(turned)])

    def position_rows(self, rest: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Return the derivative of the pose's position to the patch's displacements, [3, k, 3].

        Args:
            rest, displacement: Values for all nodes [m], shape [node_count, 3].
        """
        rows = np.einsum("k,ij->ikj", self.weights, np.eye(3))
        if self.held is None:
            return rows
        positions = rest[self.nodes] + displacement[self.nodes]
        middle = self.weights @ positions
        arms = positions - middle
        squares = np.einsum("k,ki,kj->ij", self.weights, arms, arms)
        turning = np.linalg.pinv(np.trace(squares) * np.eye(3) - squares, rcond=1e-9)
        # Row i of the first is e_i x lever, so that turns x lever = -(lever x turns).
        lever = np.cross(np.eye(3), self.pose_of(rest, displacement)[:3] - middle)
        spins = np.einsum("k,kij->kij", self.weights, np.cross(arms[:, None], np.eye(3)))
        return rows + np.einsum("ai,ab,kjb->ikj", lever, turning, spins)

    def position_slopes(self, rest: np.ndarray, displacement: np.ndarray, changes: np.ndarray,
                        ) -> np.ndarray:
        """Return the change of the pose's position with p changes of the displacement, shape [3,
        p].

        Args:
            rest, displacement: Values for all nodes [m], shape [node_count, 3].
            changes: Shape [node_count, 3, p].
        """
        return np.einsum("ikj,kjp->ip", self.position_rows(rest, displacement),
                         changes[self.nodes])


def check_pose(pose: np.ndarray) -> np.ndarray:
    """Return a pose as a float array of shape [6]. InputError if the shape is wrong, or a value is
    not finite."""
    pose = np.asarray(pose, float)
    if pose.shape != (6,) or not np.isfinite(pose).all():
        raise InputError(f"The pose has shape {pose.shape} or values that are not finite.",
                         "A pose is x, y, z [m] and a rotation vector [rad].",
                         "Give six numbers.")
    return pose


def _centred(weights: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return weights that sum to 1 and whose centre is the grasp, ``offset`` [k, 3] [m] from it. In
    directions in which the patch is not on both sides of it, the centre stays."""
    centre = weights @ offset
    arm = offset - centre
    # The change of the weights is linear in the position, so their sum stays 1.
    variance, axes = np.linalg.eigh((weights[:, None] * arm).T @ arm)
    along = arm @ axes
    intercept = -centre @ axes
    reached = (intercept > _REACHED * along.min(axis=0)) & (intercept < _REACHED
                                                            * along.max(axis=0))
    slope = np.where(reached, intercept / np.where(reached, variance, 1.0), 0.0)
    return weights * (1.0 + along @ slope)


def _on_edge(weights: np.ndarray, offset: np.ndarray) -> np.ndarray | None:
    """Return weights, none negative, of a grasp on a body's edge, ``offset`` [k, 3] [m] from it:
    only nodes of the edge have some. None if fewer than three would, or none are around it."""
    while True:
        arm = offset - weights @ offset
        inverse = np.linalg.pinv((weights[:, None] * arm).T @ arm, 1e-9, hermitian=True)
        found = weights * (1.0 - arm @ (inverse @ (weights @ offset)))
        if found.min() > -1e-9:
            # Points are stored in single precision, or to nanometres.
            is_there = np.abs(found @ offset).max() < 1e-5 * np.abs(offset).max()
            return found if is_there and np.sum(found > 0) >= _FEWEST_HELD else None
        weights = np.where(found > 0, found, 0.0) / found[found > 0].sum()


def _patch_weights(mesh: TetMesh, nodes: np.ndarray) -> np.ndarray:
    touching = np.isin(mesh.tets, nodes).any(axis=1)
    part = TetMesh(mesh.nodes, mesh.tets[touching])
    volume = np.zeros(mesh.node_count)
    np.add.at(volume, part.tets, node_weights(part)[1])
    return volume[nodes] / volume[nodes].sum()
