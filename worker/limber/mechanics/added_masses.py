"""Masses on a branch that are not meshed: point masses, and rigid twigs with their own inertia.

A twig outside the mesh moves and rotates with the section that carries it: a point p of it moves to
x(c) + F (p - c), with c the centre of an element there and F its mean deformation
gradient. This is exact for a rotation of any size, and linear in the nodes' displacements. The
weight of the twig is therefore a constant load (with the moment of its arm), and its inertia a
constant part of the mass matrix, both the same in each axis. The twig is distributed over the
elements around its foot, so that it couples no nodes that the stiffness does not couple.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from limber.core.errors import InputError
from limber.core.numerics.rigid import closest_rotation
from limber.geometry.tets.tet_mesh import TetMesh

Place = tuple[float, float, float]


@dataclass(frozen=True)
class PointMass:
    """A point mass on the branch (a fruit, a flower).

    Attributes:
        position: Position [m]; the mass is tied to the nearest node.
        mass: [kg].
    """

    position: Place
    mass: float

    def heavier(self, factor: float) -> "PointMass":
        """Return the mass times ``factor``."""
        return replace(self, mass=factor * self.mass)


@dataclass(frozen=True)
class HungTwig(PointMass):
    """A twig that is not meshed: a rigid body that moves with the section it grows from.

    Attributes:
        position: Centre of mass [m].
        attached: Point [m] where it grows from the branch.
        inertia: Inertia about its centre of mass [kg m^2], three rows.
    """

    attached: Place
    inertia: tuple[Place, Place, Place]

    def heavier(self, factor: float) -> "HungTwig":
        """Return the twig with its density times ``factor``."""
        x, y, z = (_scaled(row, factor) for row in self.inertia)
        return replace(self, mass=factor * self.mass, inertia=(x, y, z))


def _scaled(row: Place, factor: float) -> Place:
    x, y, z = row
    return factor * x, factor * y, factor * z


@dataclass(frozen=True)
class Tied:
    """An added mass on ``nodes`` [t, a] of t elements (or one node), each with ``share`` [t] of it:
    the nodes' weights in its centre's displacement [t, a] and in the gradient [1/m] [t, 3, a]."""

    added: PointMass
    nodes: np.ndarray
    share: np.ndarray
    centre: np.ndarray
    slopes: np.ndarray

    def entries(self) -> np.ndarray:
        """Contribution to the mass matrix of each axis [kg], over ``nodes``, shape [t, a, a]."""
        blocks = self.added.mass * np.einsum("ta,tb->tab", self.centre, self.centre)
        if isinstance(self.added, HungTwig):
            inertia = np.array(self.added.inertia)
            second = np.trace(inertia) / 2 * np.eye(3) - inertia
            blocks += np.einsum("tia,ij,tjb->tab", self.slopes, second, self.slopes)
        return self.share[:, None, None] * blocks

    def moved(self, displacement: np.ndarray) -> PointMass:
        """Return the mass moved by a displacement of the nodes [m], shape [node_count, 3]."""
        local = displacement[self.nodes]
        shift = np.einsum("t,ta,taj->j", self.share, self.centre, local)
        position = np.array(self.added.position) + shift
        if not isinstance(self.added, HungTwig):
            return replace(self.added, position=tuple(position))
        turn = closest_rotation(
            np.eye(3) + np.einsum("t,tia,taj->ji", self.share, self.slopes, local))
        arm = np.array(self.added.position) - np.array(self.added.attached)
        x, y, z = map(tuple, turn @ np.array(self.added.inertia) @ turn.T)
        return replace(self.added, position=tuple(position),
                       attached=tuple(position - turn @ arm),
                       inertia=(x, y, z))


def tied(mesh: TetMesh, added: Iterable[PointMass], gradients: np.ndarray, weights: np.ndarray,
         volume_weights: np.ndarray) -> list[Tied]:
    """Tie masses by a mesh's shape functions' gradients [1/m] [tet_count, q, 3, a], quadrature
    weights [m^3] and integrals [m^3] [tet_count, a]. InputError if a mass is negative or not
    finite."""
    found = []
    for one in added:
        if not (np.isfinite(one.mass) and one.mass >= 0):
            raise InputError(f"An added mass is {one.mass} kg.", "It must be 0 or more.",
                             "Give the mass in kilograms.")
        if not isinstance(one, HungTwig):
            distance = np.linalg.norm(mesh.nodes - np.asarray(one.position), axis=1)
            found.append(Tied(one, np.array([[distance.argmin()]]), np.ones(1), np.ones((1, 1)),
                              np.zeros((1, 3, 1))))
            continue
        tets = _around(mesh, np.array(one.attached))
        volume = weights[tets].sum(axis=1)
        slopes = np.einsum("tq,tqia->tia", weights[tets], gradients[tets]) / volume[:, None, None]
        mean = volume_weights[tets] / volume[:, None]
        middle = np.einsum("ta,taj->tj", mean, mesh.nodes[mesh.tets[tets]])
        centre = mean + np.einsum("ti,tia->ta", np.array(one.position) - middle, slopes)
        found.append(Tied(one, mesh.tets[tets], volume / volume.sum(), centre, slopes))
    return found


def nodal_masses(ties: Iterable[Tied], count: int) -> np.ndarray:
    """Return the mass that gravity acts on at each node [kg], shape [count]. The weight of twigs
    includes its moment about their base, so some nodes have a negative mass."""
    total = np.zeros(count)
    for one in ties:
        np.add.at(total, one.nodes, one.added.mass * one.share[:, None] * one.centre)
    return total


def mass_entries(ties: Iterable[Tied], count: int) -> sp.csr_matrix:
    """Return the contribution to the mass matrix of each axis [kg], shape [count, count]."""
    total = sp.csr_matrix((count, count))
    for one in ties:
        width = one.nodes.shape[1]
        rows, columns = np.repeat(one.nodes, width, axis=1), np.tile(one.nodes, (1, width))
        total = total + sp.csr_matrix(
            (one.entries().ravel(), (rows.ravel(), columns.ravel())), (count, count))
    return total


def _around(mesh: TetMesh, foot: np.ndarray) -> np.ndarray:
    """Elements of the section around a twig's base: within an edge length, at least the nearest
    one."""
    distance = np.linalg.norm(mesh.centroids - foot, axis=1)
    nearest = int(distance.argmin())
    corners = mesh.nodes[mesh.tets[nearest, :4]]
    edges = np.linalg.norm(corners[:, None] - corners, axis=2)[np.triu_indices(4, 1)]
    near = distance <= edges.mean()
    near[nearest] = True
    return np.flatnonzero(near)
