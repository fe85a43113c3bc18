"""The subspace of a reduced model: grasp lifts, and modes of full solutions around them.

A displacement is u = lifts a + modes y. The grasp coordinates a are known functions of the pose:
the patch moves exactly as the gripper does, and the modes vanish on it (on its weighted mean, for
a pinned grasp), so no constraint is left to solve for. The modes are a proper orthogonal
decomposition in the H1 seminorm: what makes a reduced branch too stiff are strains that the
basis cannot let go, so errors of the gradient count, not of the position.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from limber.core.errors import InputError
from limber.core.numerics.rigid import rotation_matrix, rotation_vector
from limber.mechanics.grasp import RADIAN, Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.strain import gradient_metric
from limber.reduced.training import Snapshots

# Shares and steps weigh what a basis is made of against each other: chosen, not measured one by
# one; the errors that come out are (scripts/bench mechanics, rows of the reduced model).
TANGENT_SHARE = 0.25
"""Weight of tangents relative to states; a tangent represents the change by the steps below."""
SWING_SHARE = 0.1
"""Weight of swung states beside those at rest: they are for motion, which is less exact."""
SWING_STRAIN_SHARE = 0.05
"""The same among the strain fields."""
MOVE_STEP = 0.05
"""Step of a tangent in position, as a fraction of the extent."""
TURN_STEP = 0.15
"""Step of a tangent to the rotation [rad]."""
VIBRATION_STEP = 0.03
"""Amplitude of a vibration among the strain fields, as a fraction of the extent. It is large
because free ends have hardly any strain in the states and would flutter without strain fields of
their own.
"""


@dataclass(frozen=True)
class GraspCoordinates:
    """The coordinates a of a grasp: its translation t and, if clamped, its rotation matrix R less
    1. A clamped patch moves by t + (R - 1) arm: linear in these 12 numbers."""

    grasp: Grasp

    @property
    def count(self) -> int:
        return 12 if self.grasp.mode == "rigid" else 3

    def at(self, pose: np.ndarray) -> np.ndarray:
        """Return a at a pose [m, rad], shape [count]."""
        move = pose[:3] - self.grasp.centre
        if self.grasp.mode == "point":
            return move
        return np.concatenate([move, (rotation_matrix(pose[3:]) - np.eye(3)).ravel()])

    def by_pose(self, pose: np.ndarray) -> np.ndarray:
        """Return the change of a per translation [m] and turn [rad], shape [count, 3 or 6]. The
        turn is about the pose's own position: work-conjugate to the torque there."""
        if self.grasp.mode == "point":
            return np.eye(3)
        result = np.zeros((12, 6))
        result[:3, :3] = np.eye(3)
        rotation = rotation_matrix(pose[3:])
        for axis in range(3):
            result[3:, 3 + axis] = np.cross(np.eye(3)[axis], rotation.T).T.ravel()
        return result

    def fields(self, rest: np.ndarray) -> np.ndarray:
        """Return the patch's motion per coordinate, shape [count, k, 3] (clamped only)."""
        arm = rest[self.grasp.nodes] - self.grasp.centre
        result = np.zeros((12, len(arm), 3))
        for i in range(3):
            result[i, :, i] = 1.0
            for j in range(3):
                result[3 + 3 * i + j, :, i] = arm[:, j]
        return result


@dataclass(frozen=True)
class Basis:
    """Columns of the subspace and the training states in it.

    Attributes:
        columns: Lifts, then modes, shape [size, node_count, 3].
        states: Coordinates of the training states, shape [s, size].
        captured: Fraction of the snapshots' H1 energy that the basis contains.
        reach: Largest size of each coordinate in training, swung states included, shape [size].
    """

    columns: np.ndarray
    lift_count: int
    states: np.ndarray
    captured: float
    reach: np.ndarray

    @property
    def size(self) -> int:
        return len(self.columns)


def make_basis(model: BranchModel, grasp: Grasp, snapshots: Snapshots, size: int,
               vibration_count: int = 0) -> Basis:
    """Return a basis of ``size`` columns: lifts, modes of the states and their tangents, and of
    vibrations, which get ``vibration_count`` to themselves, as statics does without them. Fewer
    where the snapshots hold fewer. InputError if that is too few, or there are no snapshots."""
    coordinates = GraspCoordinates(grasp)
    count = coordinates.count
    if size <= count:
        raise InputError(f"The reduced model has {size} coordinates.",
                         f"The grasp alone needs {count}.", "Use 30 to 90.")
    metric = gradient_metric(model)
    held = np.array([coordinates.at(pose) for pose in snapshots.poses])
    lifts = elastic_lifts(model, coordinates)
    lifts = lifts + _regressed(held, snapshots.displacement - _span(lifts, held))
    rest = snapshots.displacement - _span(lifts, held)
    swung = SWING_SHARE * (snapshots.swings - _span(lifts, held[snapshots.swing_states]))
    columns = np.concatenate([rest, *_tangent_columns(model, coordinates, snapshots, lifts),
                              swung])
    columns = _let_go(grasp, lifts, columns)
    heavy = _apply(metric, columns)
    gram = columns.reshape(len(columns), -1) @ heavy.reshape(len(columns), -1).T
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    values, vectors = values[::-1], vectors[:, ::-1]
    available = int(np.count_nonzero(values > 1e-12 * values[0]))
    count_left = min(size - count - vibration_count, available)
    if count_left <= 0:
        raise InputError(f"The reduced model has {size} coordinates.",
                         f"The grasp needs {count} of them and vibrations need {vibration_count}; "
                         f"{len(snapshots)} snapshots provide {available}.",
                         "Use more training grasps, or a larger model.")
    modes = np.tensordot(vectors[:, :count_left] / np.sqrt(values[:count_left]), columns, (0, 0))
    own = heavy[:len(rest)].reshape(len(rest), -1) @ modes.reshape(count_left, -1).T
    vibrations = _let_go(grasp, lifts, snapshots.vibrations.astype(float))
    beside = _beside(metric, modes, vibrations, vibration_count)
    states = np.hstack([held, own, np.zeros((len(held), len(beside)))])
    flat = heavy.reshape(len(columns), -1)[len(columns) - len(swung):]
    swinging = flat @ modes.reshape(count_left, -1).T / SWING_SHARE
    reach = np.abs(states).max(axis=0)
    reach[count:count + count_left] = np.abs(np.vstack([own, swinging])).max(axis=0)
    return Basis(np.concatenate([lifts, modes, beside]), count, states,
                 float(values[:count_left].sum() / values[values > 0].sum()), reach)


def _let_go(grasp: Grasp, lifts: np.ndarray, fields: np.ndarray) -> np.ndarray:
    """Take out what single precision has left of motion at the grasp."""
    if grasp.mode == "point":
        return fields - np.tensordot(np.einsum("k,fki->fi", grasp.weights,
                                               fields[:, grasp.nodes]), lifts, 1)
    fields[:, grasp.nodes] = 0.0
    return fields


def _beside(metric: sp.csr_matrix, modes: np.ndarray, fields: np.ndarray,
            count: int) -> np.ndarray:
    """Return the leading ``count`` modes of what ``fields`` have beside ``modes``."""
    if not len(fields) or not count:
        return fields[:0]
    heavy = _apply(metric, fields).reshape(len(fields), -1)
    rest = fields - np.tensordot(heavy @ modes.reshape(len(modes), -1).T, modes, 1)
    gram = rest.reshape(len(rest), -1) @ _apply(metric, rest).reshape(len(rest), -1).T
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    keep = np.flatnonzero(values > 1e-10 * values[-1])[::-1][:count]
    return np.tensordot(vectors[:, keep] / np.sqrt(values[keep]), rest, (0, 0))


def elastic_lifts(model: BranchModel, coordinates: GraspCoordinates) -> np.ndarray:
    """Return the linear elastic displacement per grasp coordinate, shape [count, n, 3]."""
    grasp, zero = coordinates.grasp, np.zeros((model.mesh.node_count, 3))
    tangent = model.equations([grasp]).tangent(model, zero)
    if grasp.mode == "point":
        return np.array([tangent.solve(zero, unit[None]) for unit in np.eye(3)])
    lifts = []
    for patch in coordinates.fields(model.mesh.nodes):
        held = zero.copy()
        held[grasp.nodes] = patch
        lifts.append(held + tangent.solve(-model.tangent_times(zero, held)))
    return np.array(lifts)


def tangent_steps(model: BranchModel, snapshots: Snapshots) -> np.ndarray:
    """Return the steps that the pose tangents represent [m and rad], shape [3 or 6]."""
    count = snapshots.pose_tangents.shape[1]
    return np.array(3 * [MOVE_STEP * model.extent] + (count - 3) * [TURN_STEP])


def _tangent_columns(model: BranchModel, coordinates: GraspCoordinates, snapshots: Snapshots,
                     lifts: np.ndarray) -> list[np.ndarray]:
    steps = tangent_steps(model, snapshots)
    shape = (-1, *lifts.shape[1:])
    change = np.array([coordinates.by_pose(pose).T for pose in snapshots.poses])
    by_pose = snapshots.pose_tangents - np.tensordot(change, lifts, 1)
    columns = [TANGENT_SHARE * (by_pose * steps[:, None, None]).reshape(shape)]
    if snapshots.young_tangents.size:
        columns.append(TANGENT_SHARE * snapshots.young_tangents.reshape(shape))
    return columns


def _regressed(held: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return what the states have in common per grasp coordinate (ridge regression)."""
    gram = held.T @ held
    ridge = 1e-4 * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.tensordot(np.linalg.solve(gram + ridge, held.T), rest, 1)


def _span(columns: np.ndarray, coordinates: np.ndarray) -> np.ndarray:
    return np.tensordot(coordinates, columns, 1)


def _apply(metric: sp.csr_matrix, fields: np.ndarray) -> np.ndarray:
    return np.array([metric @ field for field in fields])


# The distance of a pose from the training poses of a reduced model.


class TrainingPoses:
    """Poses to which distances are measured."""

    def __init__(self, poses: np.ndarray, extent: float):
        self.positions = np.atleast_2d(poses)[:, :3]
        self.rotations = rotation_matrix(np.atleast_2d(poses)[:, 3:])
        self.extent = extent

    def distance(self, pose: np.ndarray) -> np.ndarray:
        """Return the distance of each pose to one [m], shape [s]."""
        away = self.rotations - rotation_matrix(pose[3:])
        # |R1 - R2| is sqrt(2) times the angle between them, where that is small.
        turns = np.sqrt(0.5 * np.einsum("sij,sij->s", away, away))
        return np.linalg.norm(self.positions - pose[:3], axis=1) + RADIAN * self.extent * turns

    def spacing(self) -> float:
        """Return the 90th percentile of the distance to the nearest other pose [m]."""
        if len(self.positions) < 3:
            return self.extent
        vectors = rotation_vector(self.rotations)
        nearest = [np.partition(self.distance(np.concatenate([position, vector])), 1)[1]
                   for position, vector in zip(self.positions, vectors, strict=True)]
        return float(np.percentile(nearest, 90))
