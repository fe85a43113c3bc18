"""The stored state of the branch at one grasp position, and samples from such states."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from limber.mechanics import StaticResult
from limber.mechanics.statics.result import Status
from limber.planning.field.grasp_model import GraspModel, refusal

# What the branch model found at grasp poses: the samples of an energy field.

LOADS = ("strain", "stress", "axial_force", "torque", "closeness")
"""Loads of a pose besides energy and force: largest strain and stress [Pa] by magnitude; the
gripper's force along the branch [N], outward positive, and its torque [Nm]; closeness of the branch
to an obstacle, 1 where it touches one. A plan's constraints may add more.
"""


@dataclass(frozen=True)
class GraspSamples:
    """Results of the branch model at ``m`` accepted grasp poses, rest pose first.

    Attributes:
        poses: Position [m] and natural rotation vector of the grasped piece [rad], [m, 6].
        energies: Potential of strain and weight above the hanging state [J], shape [m].
        forces: Force that the gripper exerts on the branch [N], shape [m, 3].
        tips: Position of the branch's tip [m], shape [m, 3].
        min_det_f: Least determinant of the deformation gradient, shape [m].
        rejected_poses: Poses without an acceptable solution, shape [q, 6].
        strains: Largest principal Green-Lagrange strain by magnitude, shape [m].
        targets: Positions of the named targets [m], shape [m, targets, 3].
        torques: Torque that the gripper exerts about the pose's position [Nm], shape [m, 3].
        strain_places: Position of that strain in the rest shape [m], shape [m, 3].
        stresses: Largest principal Cauchy stress by magnitude [Pa], shape [m].
        shape_slopes: Slopes of natural rotation, tip and targets to the grasp's position, shape
            [m, 3, 6 + 3 targets].
        axial_forces: Component of the force along the branch at the grasp, outward [N], shape [m].
        added: Quantities of a plan's constraints, by their names, shape [m] each; in no file.
    """

    poses: np.ndarray
    energies: np.ndarray
    forces: np.ndarray
    tips: np.ndarray
    min_det_f: np.ndarray
    rejected_poses: np.ndarray
    strains: np.ndarray | None
    targets: np.ndarray | None = None
    torques: np.ndarray | None = None
    strain_places: np.ndarray | None = None
    stresses: np.ndarray | None = None
    shape_slopes: np.ndarray | None = None
    axial_forces: np.ndarray | None = None
    added: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def positions(self) -> np.ndarray:
        return self.poses[:, :3]

    @property
    def shape(self) -> np.ndarray:
        """Natural rotation, tip and targets, shape [m, 6 + 3 targets]."""
        known = [self.poses[:, 3:], self.tips]
        if self.targets is not None:
            known.append(self.targets.reshape(len(self.poses), -1))
        return np.hstack(known)

    @property
    def loads(self) -> dict[str, np.ndarray | None]:
        """Loads by the names of ``LOADS`` and of added ones, shape [m] each; None if not known."""
        torque = None if self.torques is None else np.linalg.norm(self.torques, axis=1)
        known = (self.strains, self.stresses, self.axial_forces, torque, None)
        return dict(zip(LOADS, known, strict=True)) | self.added

    @property
    def load_table(self) -> np.ndarray:
        """The same as columns, shape [m, loads]; 0 if not known."""
        nothing = np.zeros(len(self.poses))
        return np.column_stack([nothing if one is None else one for one in self.loads.values()])

    def joined(self, other: "GraspSamples") -> "GraspSamples":
        """Return these samples followed by those of ``other``."""
        added = {name: np.concatenate([values, other.added[name]])
                 for name, values in self.added.items()}
        return replace(self, added=added, **{
            name: np.concatenate([values, getattr(other, name)])
            for name, values in vars(self).items()
            if name != "added" and values is not None and getattr(other, name) is not None})

    def take(self, index: np.ndarray) -> "GraspSamples":
        """Return the samples of ``index``; rejected poses stay."""
        added = {name: values[index] for name, values in self.added.items()}
        return replace(self, added=added, **{
            name: values[index] for name, values in vars(self).items()
            if name not in ("added", "rejected_poses") and values is not None})


@dataclass(frozen=True)
class Solved:
    """A solution as a sample of :class:`~.energy_field.GraspSamples`, asked at number ``target``
    (-1: none). ``trouble`` is why not to trust it."""

    target: int
    pose: np.ndarray
    energy: float
    force: np.ndarray
    tip: np.ndarray
    min_det_f: float
    trouble: Status | None
    targets: np.ndarray
    torque: np.ndarray
    strain: float
    strain_place: np.ndarray
    stress: float
    shape_slopes: np.ndarray
    axial_force: float
    displacement: np.ndarray

    @property
    def shape(self) -> np.ndarray:
        """Natural rotation [rad], tip and targets [m] in one row, [6 + 3 targets]."""
        return np.concatenate([self.pose[3:], self.tip, self.targets.ravel()])


def taken(grasp_model: GraspModel, result: StaticResult, target: int = -1) -> Solved:
    """Return the stored state of a solution."""
    moved, at_rest = result.displacement, result is grasp_model.rest
    strain, position, stress = grasp_model.peak_load(moved)
    force = np.zeros(3) if at_rest else result.reaction_force
    return Solved(
        target, grasp_model.pose(moved), 0.0 if at_rest else grasp_model.energy(result),
        force, grasp_model.tip(moved),
        float(result.min_det_f), refusal(result), grasp_model.branch.target_positions(moved),
        np.zeros(3) if at_rest else result.reaction_torque, strain, position, stress,
        grasp_model.shape_slopes(moved), grasp_model.axial_force(moved, force), moved)


_OF_SOLUTIONS = {
    "poses": "pose", "energies": "energy", "forces": "force", "tips": "tip",
    "min_det_f": "min_det_f", "strains": "strain", "targets": "targets", "torques": "torque",
    "strain_places": "strain_place", "stresses": "stress", "shape_slopes": "shape_slopes",
    "axial_forces": "axial_force"}


def samples_of(good: Sequence[Solved], rejected: np.ndarray) -> GraspSamples:
    """Return samples of solutions, the rest state first; ``rejected`` positions [m], [q, 3]."""
    columns: dict[str, Any] = {name: np.array([getattr(one, own) for one in good])
                               for name, own in _OF_SOLUTIONS.items()}
    return GraspSamples(rejected_poses=np.hstack([rejected, np.zeros_like(rejected)]), **columns)
