"""States of the branch at poses of its grasp: one record for samples, paths and checks."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from limber.mechanics import StaticResult
from limber.mechanics.statics.result import Status
from limber.planning.field.grasp_model import GraspModel

LOADS = ("strain", "stress", "axial_force", "torque", "closeness")
"""Loads of a pose besides energy and force: largest strain and stress [Pa] by magnitude; the
gripper's force along the branch [N], outward positive, and its torque [Nm]; closeness of the branch
to an obstacle, 1 where it touches one. A plan's constraints may add more.
"""
Known = Any
"""An array, or None where it is not known."""


@dataclass(frozen=True)
class States:
    """Accepted states of the branch at ``m`` poses; of a field's samples the rest pose first.

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
        solved: Whether the full model was solved there, bool [m], or an earlier solution was
            corrected (:mod:`limber.planning.field.other_modulus`); not known: it was.
        displacements: Of all nodes [m], shape [m, node_count, 3]; in no file.
        added: Quantities of a plan's constraints, by their names, shape [m] each; in no file.
    """

    poses: np.ndarray
    energies: np.ndarray
    forces: np.ndarray
    tips: np.ndarray
    min_det_f: np.ndarray
    rejected_poses: np.ndarray = field(default_factory=lambda: np.empty((0, 6)))
    strains: Known = None
    targets: Known = None
    torques: Known = None
    strain_places: Known = None
    stresses: Known = None
    shape_slopes: Known = None
    axial_forces: Known = None
    solved: Known = None
    displacements: Known = None
    added: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, grasp_model: GraspModel, results: Sequence[StaticResult], *, sloped: bool = False,
           ) -> "States":
        """Return the states of solutions, with slopes if ``sloped``; none are pulled at rest."""
        moved = [one.displacement for one in results]
        held = np.array([one is not grasp_model.rest for one in results])
        forces = held[:, None] * [one.reaction_force for one in results]
        strains, places, stresses = zip(*map(grasp_model.peak_load, moved), strict=True)
        return cls(
            np.array([grasp_model.pose(u) for u in moved]),
            np.where(held, [grasp_model.energy(one) for one in results], 0.0), forces,
            np.array([grasp_model.tip(u) for u in moved]),
            np.array([float(one.min_det_f) for one in results]), strains=np.array(strains),
            targets=np.array([grasp_model.branch.target_positions(u) for u in moved]),
            torques=held[:, None] * [one.reaction_torque for one in results],
            strain_places=np.array(places), stresses=np.array(stresses),
            shape_slopes=np.array([grasp_model.shape_slopes(u) for u in moved]) if sloped else None,
            axial_forces=np.array([grasp_model.axial_force(u, force)
                                   for u, force in zip(moved, forces, strict=True)]),
            solved=held | True, displacements=np.array(moved))

    @property
    def positions(self) -> np.ndarray:
        return self.poses[:, :3]

    @property
    def shape(self) -> np.ndarray:
        """Natural rotation, tip and targets, shape [m, 6 + 3 targets]."""
        known = [self.poses[:, 3:], self.tips]
        if self.targets is not None:
            known.append(self.targets.reshape(len(self.poses), 3 * self.targets.shape[1]))
        return np.hstack(known)

    @property
    def force_sizes(self) -> np.ndarray:
        """Magnitude of the gripper's force [N], shape [m]."""
        return np.linalg.norm(self.forces, axis=1)

    @property
    def loads(self) -> dict[str, Known]:
        """Loads by the names of ``LOADS`` and of added ones, shape [m] each; None if not known."""
        torque = None if self.torques is None else np.linalg.norm(self.torques, axis=1)
        known = (self.strains, self.stresses, self.axial_forces, torque, None)
        return dict(zip(LOADS, known, strict=True)) | self.added

    @property
    def sizes(self) -> dict[str, np.ndarray]:
        """The quantities that may have limits, by name, as far as known, shape [m] each."""
        return {"energy": self.energies, "force": self.force_sizes,
                **{name: np.abs(one) for name, one in self.loads.items() if one is not None}}

    @property
    def load_table(self) -> np.ndarray:
        """The loads as columns, shape [m, loads]; 0 if not known."""
        nothing = np.zeros(len(self.poses))
        return np.column_stack([nothing if one is None else one for one in self.loads.values()])

    def joined(self, *others: "States") -> "States":
        """Return these states followed by those of ``others``, with what all of them have."""
        every = (self, *others)

        def column(values: list) -> Any:
            return None if any(one is None for one in values) else np.concatenate(values)

        return States(added={name: column([one.added[name] for one in every])
                             for name in self.added}, **{
            name: column([getattr(one, name) for one in every])
            for name in vars(self) if name != "added"})

    def take(self, index: np.ndarray) -> "States":
        """Return the states of ``index``, in its order; rejected poses stay."""
        added = {name: values[index] for name, values in self.added.items()}
        return replace(self, added=added, **{
            name: values[index] for name, values in vars(self).items()
            if name not in ("added", "rejected_poses") and values is not None})


class Solution(NamedTuple):
    """The one ``state`` found at the pose asked as number ``target``; ``trouble`` is why not to
    trust it."""

    target: int
    trouble: Status | None
    state: States
